//! Splat files that lie: each is answered by one clear error, without a panic, without
//! memory or time that the file's size does not justify.

use subsplat_test_support::splat_scene;

use splat_scene::*;
use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use subsplat::files::splats::glb::parse_glb;
use subsplat::files::splats::ksplat::parse_ksplat;
use subsplat::files::splats::ply::parse_ply;
use subsplat::files::splats::sog::parse_sog;
use subsplat::files::splats::splat::parse_splat;
use subsplat::files::splats::spz::parse_spz;
use subsplat::files::{Result, SaveOptions, load_splats, save_splats, splat_info};
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::ShBasis;

type Parse = fn(&[u8], PathBuf) -> Result<Splats>;

const READERS: [(&str, Parse); 6] = [
    ("ply", parse_ply),
    ("splat", parse_splat),
    ("spz", parse_spz),
    ("sog", parse_sog),
    ("ksplat", parse_ksplat),
    ("glb", parse_glb),
];

/// The reader's result for `bytes`, within bounds of time; the message names the file.
fn answer(ending: &str, parse: Parse, bytes: &[u8]) -> std::result::Result<Splats, String> {
    let name = format!("hostile.{ending}");
    let start = Instant::now();
    let result = parse(bytes, PathBuf::from(&name));
    assert!(start.elapsed() < Duration::from_secs(5), "{name} took {:?}", start.elapsed());
    match result {
        Ok(s) => {
            // Accepted splats must be finite, and have a rotation.
            assert!(s.rows().iter().chain(s.sh()).all(|v| v.is_finite()));
            assert!((0..s.len()).all(|i| s.quat_wxyz(i) != [0.0; 4]));
            Ok(s)
        }
        Err(e) => {
            let e = e.to_string();
            assert!(e.starts_with(&name) && e.len() < 600 && !e.contains('\n'), "{e}");
            assert!(e.contains("expected ") && e.contains(", got "), "{e}");
            Err(e)
        }
    }
}

fn refused(ending: &str, bytes: &[u8], what: &str) {
    let (_, parse) = READERS.into_iter().find(|(e, _)| *e == ending).unwrap();
    match answer(ending, parse, bytes) {
        Ok(s) => panic!("{what}: {ending} was read as {} Gaussians", s.len()),
        Err(e) => assert!(e.contains(what), "{ending}: {what} is not in: {e}"),
    }
}

pub fn small(degree: usize) -> Splats {
    let basis = ShBasis::Standard;
    scene(1, Kind { parents: 9, children: 1, degree, gain_channels: 0, basis })
}

pub fn written(name: &str, splats: &Splats) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    save_splats(&path, splats, &SaveOptions::default()).unwrap();
    std::fs::read(path).unwrap()
}

fn zstd_raw(data: &[u8]) -> Vec<u8> {
    let mut out = vec![0x28, 0xb5, 0x2f, 0xfd, 0xa0];
    out.extend((data.len() as u32).to_le_bytes());
    out.extend(&((data.len() as u32) << 3 | 1).to_le_bytes()[..3]);
    out.extend(data);
    out
}

/// A frame with a checksum.
fn zstd(data: &[u8]) -> Vec<u8> {
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};
    compress_to_vec(data, CompressionLevel::Uncompressed)
}

fn inflated(gzip: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(gzip), &mut body).unwrap();
    body
}

/// Version 4 from the body of version 3, each stream packed by `pack`.
fn spz4(splats: &Splats, pack: fn(&[u8]) -> Vec<u8>) -> Vec<u8> {
    let body = inflated(&written("a.spz", splats));
    let n = splats.len();
    let sh = 3 * (splats.sh_coefficients() - 1);
    let (mut at, mut table, mut data) = (16, Vec::new(), Vec::new());
    for size in [9, 1, 3, 3, 4, sh].into_iter().filter(|s| *s > 0) {
        let stream = pack(&body[at..at + n * size]);
        table.extend((stream.len() as u64).to_le_bytes());
        table.extend((n as u64 * size as u64).to_le_bytes());
        data.extend(stream);
        at += n * size;
    }
    let mut out = body[..16].to_vec();
    out[4] = 4;
    out[15] = (table.len() / 16) as u8;
    out.extend(32u32.to_le_bytes());
    out.extend([0; 12]);
    out.extend(table);
    out.extend(data);
    out
}

/// One section of level `level`, buckets as it needs them.
pub fn ksplat(level: u16) -> Vec<u8> {
    let stride = if level == 0 { 44 } else { 24 };
    let n = 5u32;
    let mut b = vec![0u8; 4096 + 1024];
    let mut put = |at: usize, v: &[u8]| b[at..at + v.len()].copy_from_slice(v);
    put(1, &[1]);
    for (at, v) in [(4, 1), (8, 1), (12, n), (16, n)] {
        put(at, &v.to_le_bytes());
    }
    put(20, &level.to_le_bytes());
    for (at, v) in [(0, n), (4, n), (8, 2), (12, 3), (24, 100), (32, 2), (36, 1)] {
        put(4096 + at, &u32::to_le_bytes(v));
    }
    put(4096 + 16, &4.0f32.to_le_bytes());
    put(4096 + 20, &12u16.to_le_bytes());
    b.extend(1u32.to_le_bytes());
    b.extend([0; 36]);
    b.extend((0..n * stride).map(|i| (i % 50) as u8));
    b
}

/// A packed .ply of two chunks, degree 1.
pub fn compressed_ply() -> Vec<u8> {
    let n = 300;
    let mut head = "ply\nformat binary_little_endian 1.0\nelement chunk 2\n".to_owned();
    for name in [
        "min_x",
        "min_y",
        "min_z",
        "max_x",
        "max_y",
        "max_z",
        "min_scale_x",
        "min_scale_y",
        "min_scale_z",
        "max_scale_x",
        "max_scale_y",
        "max_scale_z",
    ] {
        head += &format!("property float {name}\n");
    }
    head += &format!("element vertex {n}\n");
    for name in ["position", "rotation", "scale", "color"] {
        head += &format!("property uint packed_{name}\n");
    }
    head += &format!("element sh {n}\n");
    (0..9).for_each(|i| head += &format!("property uchar f_rest_{i}\n"));
    let mut b = (head + "end_header\n").into_bytes();
    for i in 0..24 {
        b.extend((i as f32 / 8.0 - 1.0).to_le_bytes());
    }
    let mut random = Random(3);
    (0..n * 16 + n * 9).for_each(|_| b.push(random.word() as u8));
    b
}

fn ascii_ply() -> Vec<u8> {
    let mut text = "ply\nformat ascii 1.0\nelement note 1\nproperty list uchar int k\n\
        element vertex 3\n"
        .to_owned();
    for name in [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3",
    ] {
        text += &format!("property float {name}\n");
    }
    text += "end_header\n2 7 8\n";
    for i in 0..3 {
        text += &format!("{i} 0 1 0.1 0.2 0.3 -1 -2 -3 -4 1 0 0.5 0\n");
    }
    text.into_bytes()
}

/// Valid files of every kind and flavour.
fn seeds() -> Vec<(&'static str, Parse, Vec<u8>)> {
    let find = |e: &str| READERS.into_iter().find(|(n, _)| *n == e).unwrap();
    let mut seeds = Vec::new();
    let mut add = |ending: &str, bytes: Vec<u8>| {
        let (name, parse) = find(ending);
        seeds.push((name, parse, bytes));
    };
    for degree in [0, 3] {
        for ending in ["ply", "spz", "sog", "glb"] {
            add(ending, written(&format!("a.{ending}"), &small(degree)));
        }
        add("spz", spz4(&small(degree), zstd_raw));
        add("spz", spz4(&small(degree), zstd));
    }
    add("splat", written("a.splat", &small(0)));
    (0..3).for_each(|level| add("ksplat", ksplat(level)));
    add("ply", compressed_ply());
    add("ply", ascii_ply());
    seeds
}

#[test]
fn the_seeds_are_valid() {
    for (ending, parse, bytes) in seeds() {
        if let Err(e) = answer(ending, parse, &bytes) {
            panic!("{e}");
        }
    }
}

/// Cuts each seed at every byte. Only a `.splat` may end anywhere that a record ends: it has
/// neither a header nor a count.
#[test]
fn every_truncation_is_an_error() {
    for (ending, parse, bytes) in seeds() {
        for cut in 0..bytes.len() {
            match answer(ending, parse, &bytes[..cut]) {
                Err(_) => {}
                Ok(s) if ending == "splat" => assert_eq!(s.len() * 32, cut),
                Ok(_) => panic!("{ending} of {} bytes was read at {cut}", bytes.len()),
            }
        }
    }
}

/// Appends bytes to each seed. A .ply is read without them, and a zip ends where its directory says.
#[test]
fn bytes_after_the_end_are_an_error_or_are_not_read() {
    for (ending, parse, bytes) in seeds() {
        let good = answer(ending, parse, &bytes).unwrap();
        // The last one is a whole second file.
        for more in [&b"\0"[..], b"\n", b"\xff", &[0; 31], &bytes] {
            let longer = [&bytes[..], more].concat();
            if ending == "ply" {
                assert!(answer(ending, parse, &longer).unwrap() == good);
            } else if ending == "sog" {
                assert!(answer(ending, parse, &longer).is_ok_and(|s| s == good));
            } else if ending == "splat" && more.len().is_multiple_of(32) {
                assert_eq!(answer(ending, parse, &longer).unwrap().len(), 18);
            } else {
                let n = more.len();
                assert!(answer(ending, parse, &longer).is_err(), "{ending} took {n} bytes more");
            }
        }
    }
}

/// Flips every bit of the compressed data and of the checksums. A flip that is accepted
/// changes no number: padding of a stored deflate block, or the window size and the two
/// unused bits in the header of a zstd frame.
#[test]
fn wrong_checksums_are_an_error() {
    for (name, bytes, from, most) in [
        // Decoders ignore the bits before each of eight stored blocks, up to a whole byte.
        ("gzip", written("a.spz", &small(1)), 10, 12 + 8 * 7),
        ("zstd", spz4(&small(1), zstd), 32 + 6 * 16, 6 * 10),
    ] {
        let good = answer("spz", parse_spz, &bytes).unwrap();
        let mut accepted = 0;
        for at in from..bytes.len() {
            for bit in 0..8 {
                let mut b = bytes.clone();
                b[at] ^= 1 << bit;
                if let Ok(splats) = answer("spz", parse_spz, &b) {
                    assert!(splats == good, "{name}: bit {bit} of byte {at} changes the splats");
                    accepted += 1;
                }
            }
        }
        assert!(accepted <= most, "{name}: {accepted} flips are accepted");
    }
}

/// Versions 1 to 3 end as the count requires, or carry extension records that the flags
/// announce (nianticlabs/spz, extensions/README.md).
#[test]
fn extensions_of_spz_are_announced_and_whole() {
    let plain = inflated(&written("a.spz", &small(1)));
    let record = [&0xadbe_0002u32.to_le_bytes()[..], &5u32.to_le_bytes(), b"12345"].concat();
    let file = |flags: u8, more: &[u8]| {
        let mut b = [&plain[..], more].concat();
        b[14] = flags;
        b
    };
    for pack in [gzip as fn(&[u8]) -> Vec<u8>, <[u8]>::to_vec] {
        for (flags, more) in [(0, &b""[..]), (1, b""), (2, b""), (2, &record), (3, &record)] {
            assert!(answer("spz", parse_spz, &pack(&file(flags, more))).is_ok());
        }
        assert!(answer("spz", parse_spz, &pack(&file(2, &record.repeat(2)))).is_ok());
        refused("spz", &pack(&file(0, &record)), "the end of the data");
        refused("spz", &pack(&file(1, b"x")), "the end of the data");
        for cut in 1..record.len() {
            refused("spz", &pack(&file(2, &record[..cut])), "extension");
        }
        refused("spz", &pack(&file(2, &[0xff; 8])), "extension");
    }
    // Version 4 has them between header and table.
    let four = spz4(&small(0), zstd_raw);
    let file = |flags: u8, more: &[u8]| {
        let mut b = [&four[..32], more, &four[32..]].concat();
        b[14] = flags;
        b[16..20].copy_from_slice(&(32 + more.len() as u32).to_le_bytes());
        b
    };
    assert!(answer("spz", parse_spz, &file(2, b"")).is_ok());
    assert!(answer("spz", parse_spz, &file(2, &record.repeat(2))).is_ok());
    refused("spz", &file(0, &record), "the stream table at byte 32");
    refused("spz", &file(2, &record[..12]), "extension");
}

#[test]
fn empty_and_foreign_content_is_refused_by_every_reader() {
    let png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR and so on, and so forth".to_vec();
    let mut random = Random(2);
    let noise: Vec<u8> = (0..8191).map(|_| random.word() as u8).collect();
    for (ending, parse) in READERS {
        for bytes in [&b""[..], b"\0", &png, &noise, &[0u8; 31], &[0xff; 5000]] {
            assert!(answer(ending, parse, bytes).is_err(), "{ending} took {} bytes", bytes.len());
        }
        // Each other's files.
        for (other, _, bytes) in seeds() {
            // 32-byte records have no magic; the numbers give most of them away.
            if other != ending && ending != "splat" {
                assert!(answer(ending, parse, &bytes).is_err(), "{ending} took a .{other}");
            }
        }
    }
}

fn ply(header: &[&str], body: &[u8]) -> Vec<u8> {
    let mut b = header.join("\n").into_bytes();
    b.push(b'\n');
    b.extend(body);
    b
}

#[test]
fn lying_ply_headers() {
    let le = "format binary_little_endian 1.0";
    let fields = [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3",
    ];
    let splat_with = |count: &str, format: &str, extra: &[&str], body: &[u8]| {
        let mut lines =
            vec!["ply".to_owned(), format.to_owned(), format!("element vertex {count}")];
        lines.extend(fields.iter().map(|f| format!("property float {f}")));
        lines.extend(extra.iter().map(|e| (*e).to_owned()));
        lines.push("end_header".to_owned());
        ply(&lines.iter().map(String::as_str).collect::<Vec<_>>(), body)
    };
    let big = "1000000000000";
    let none = [0u8; 56];
    for (bytes, what) in [
        (splat_with(big, le, &[], &none), "1000000000000 rows"),
        (splat_with(big, "format ascii 1.0", &[], &none), "1000000000000 rows"),
        (splat_with(&u64::MAX.to_string(), le, &[], &none), "rows of `vertex`"),
        (splat_with("99999999999999999999999", le, &[], &none), "element NAME COUNT"),
        (splat_with("-5", le, &[], &none), "element NAME COUNT"),
        (splat_with("2", le, &[], &none), "2 rows"),
        (splat_with("1", "format binary_little_endian 2.0", &[], &none), "version 1.0"),
        (splat_with("1", "format utf-8 1.0", &[], &none), "ascii"),
        (splat_with("1", le, &["property float x"], &none), "each property once"),
        (splat_with("1", le, &["property quaternion q"], &none), "property TYPE NAME"),
        (splat_with("1", le, &["property list float int q"], &none), "integer type"),
        (splat_with("1", le, &["property float f_rest_0"], &none), "0, 9, 24, 45 or 72"),
        (splat_with("1", le, &["property float f_rest_5"], &none), "0, 9, 24, 45 or 72"),
        (splat_with("1", le, &["nonsense"], &none), "end_header"),
        (splat_with("1", "comment no format", &[], &none), "format"),
        (ply(&["ply", le, "property float x", "end_header"], b""), "before the first property"),
        (ply(&["ply", le, "end_header"], b""), "element `vertex`"),
        (ply(&["ply", le, "element face 0", "end_header"], b""), "element `vertex`"),
        (
            ply(
                &[
                    "ply",
                    le,
                    "element vertex 1",
                    "property float x",
                    "property float y",
                    "property float z",
                    "property uchar red",
                    "property uchar green",
                    "property uchar blue",
                    "end_header",
                ],
                &[0; 15],
            ),
            "not splats",
        ),
        (
            ply(
                &[
                    "ply",
                    le,
                    "element face 1000000000000",
                    "property list uchar int v",
                    "element vertex 0",
                    "end_header",
                ],
                &[0; 9],
            ),
            "rows of `face`",
        ),
        (
            ply(
                &[
                    "ply",
                    le,
                    "element face 3",
                    "property list uint double v",
                    "element vertex 0",
                    "end_header",
                ],
                &[0xff; 40],
            ),
            "cut short",
        ),
        (
            ply(
                &[
                    "ply",
                    le,
                    "element face 3",
                    "property list int int v",
                    "element vertex 0",
                    "end_header",
                ],
                &[0xff; 40],
            ),
            "a length",
        ),
        (
            ply(
                &[
                    "ply",
                    "format ascii 1.0",
                    "element face 1",
                    "property list int int v",
                    "element vertex 0",
                    "end_header",
                ],
                b"1e18 1 2 3\n",
            ),
            "`v`",
        ),
        (
            ply(
                &[
                    "ply",
                    "format ascii 1.0",
                    "element face 1",
                    "property list int int v",
                    "element vertex 0",
                    "end_header",
                ],
                b"nan 1 2 3\n",
            ),
            "a length",
        ),
        (
            splat_with("1", "format ascii 1.0", &[], b"1 2 3 4 five 6 7 8 9 10 11 12 13 14\n"),
            "a number for `f_dc_1`",
        ),
        (
            splat_with("1", "format ascii 1.0", &[], b"1 2 3 4 5 6 7 8 9 10 11 12 13 14 15\n"),
            "14 properties",
        ),
        (
            splat_with(
                "2",
                "format ascii 1.0",
                &[],
                b"1 2 3 4 5 6 7 8 9 10 11 12 13 14\n1 2 \xff 4 5 6 7 8 9 10 11 12 13 14\n",
            ),
            "numbers",
        ),
        (splat_with("1", le, &[], &[0xff; 56]), "splat 0 (mean NaN)"),
        (splat_with("1", le, &[], &none), "1 of 1 splats, whose rotation is 0 0 0 0"),
    ] {
        refused("ply", &bytes, what);
    }
    // A property whose name is not UTF-8; in a comment that does no harm.
    let mut bytes = splat_with("1", le, &["property float ?"], &[0; 60]);
    let at = bytes.iter().position(|b| *b == b'?').unwrap();
    bytes[at] = 0xff;
    refused("ply", &bytes, "UTF-8");
    let mut bytes = splat_with("1", le, &["comment ?"], &[0x3c; 56]);
    let at = bytes.iter().position(|b| *b == b'?').unwrap();
    bytes[at] = 0xff;
    assert!(answer("ply", parse_ply, &bytes).is_ok());
    // A line without end, a header without end, rows without end.
    let mut endless = b"ply\ncomment ".to_vec();
    endless.resize(3 << 20, b'a');
    refused("ply", &endless, "a line of more than");
    let endless = [b"ply\n".to_vec(), b"comment a\n".repeat(300_000)].concat();
    refused("ply", &endless, "no `end_header`");
    let mut blank = splat_with("1", "format ascii 1.0", &[], b"");
    blank.resize(3 << 20, b'\n');
    refused("ply", &blank, "a row of numbers");
}

#[test]
fn lying_compressed_plys() {
    let good = compressed_ply();
    let edit = |from: &str, to: &str| {
        let text = good.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        [&good[..text], to.as_bytes(), &good[text + from.len()..]].concat()
    };
    for (bytes, what) in [
        (edit("element vertex 300", "element vertex 1000000000000"), "rows of `vertex`"),
        (edit("element vertex 300", "element vertex 299"), "as many rows of `sh`"),
        (edit("element chunk 2", "element chunk 1"), "2 chunks before"),
        (edit("element chunk 2", "element chunk 99999999999"), "rows of `chunk`"),
        (edit("element sh 300", "element sh 99999999999"), "rows of `sh`"),
        (edit("float min_x", "float sin_x"), "`min_x`"),
        (edit("uint packed_scale", "float packed_scale"), "`packed_scale`"),
        (edit("uchar f_rest_3", "uchar g_rest_3"), "0, 9, 24, 45 or 72"),
        (edit("uchar f_rest_3", "float f_rest_3"), "`sh`"),
    ] {
        refused("ply", &bytes, what);
    }
    let mut nan = good.clone();
    let chunks = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    for chunk in 0..2 {
        let at = chunks + 48 * chunk;
        nan[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    }
    refused("ply", &nan, "mean NaN");
}

fn gzip(body: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(body).unwrap();
    encoder.finish().unwrap()
}

fn spz_head(version: u32, count: u32, rest: [u8; 4]) -> Vec<u8> {
    let mut head = b"NGSP".to_vec();
    head.extend(version.to_le_bytes());
    head.extend(count.to_le_bytes());
    head.extend(rest);
    head
}

#[test]
fn lying_spz_files() {
    for (head, what) in [
        (spz_head(0, 1, [0, 12, 0, 0]), "version 1 to 4"),
        (spz_head(5, 1, [0, 12, 0, 0]), "version 1 to 4"),
        (spz_head(3, u32::MAX, [0, 12, 0, 0]), "at most 10000000"),
        (spz_head(3, 1, [5, 12, 0, 0]), "SH degree 0 to 4"),
        (spz_head(3, 1, [0, 60, 0, 0]), "fractional bits"),
        (spz_head(3, 9_999_999, [4, 12, 0, 0]), ""),
    ] {
        refused("spz", &head, what);
        refused("spz", &gzip(&head), what);
    }
    refused("spz", &gzip(&spz_head(4, 1, [0, 12, 0, 0])), "inside gzip");
    refused("spz", &gzip(b"NGS"), "at least 16 bytes");
    refused("spz", &gzip(b"JUNKJUNKJUNKJUNKJUNK"), "magic NGSP");
    let good = spz4(&small(0), zstd_raw);
    for (at, bytes, what) in [
        (15, &[4u8][..], "5 streams"),
        (16, &[0xff, 0xff, 0xff, 0xff], "stream table"),
        (16, &[0, 0, 0, 0], "stream table"),
        (16, &[33, 0, 0, 0], "stream table"),
        (32, &[0xff; 8], "at byte"),
        (40, &[0xff; 8], "as the count demands"),
        (112, &[0; 4], "zstd"),
    ] {
        let mut b = good.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        refused("spz", &b, what);
    }
    // A frame with a smaller size, one with a larger size, and an unknown dictionary.
    let mut b = good.clone();
    b[8] = 10;
    refused("spz", &b, "as the count demands");
    let mut b = good;
    b[112 + 4] = 0xa1;
    refused("spz", &b, "zstd");
}

#[test]
fn decompression_bombs_stay_small() {
    // 256 MiB of zeros after four Gaussians: a few bytes of them are inflated. The file
    // itself is built once, about a megabyte.
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(&spz_head(3, 4, [0, 12, 0, 0])).unwrap();
    let zeros = vec![0u8; 1 << 20];
    (0..256).for_each(|_| encoder.write_all(&zeros).unwrap());
    let bomb = encoder.finish().unwrap();
    assert!(bomb.len() < 4 << 20);
    let start = Instant::now();
    refused("spz", &bomb, "the end of the data");
    assert!(start.elapsed() < Duration::from_millis(200), "{:?}", start.elapsed());
    // The same with a count that owns all of it.
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(&spz_head(3, 9_000_000, [0, 12, 0, 0])).unwrap();
    (0..200).for_each(|_| encoder.write_all(&zeros).unwrap());
    let bomb = encoder.finish().unwrap();
    refused("spz", &bomb, "decompression bomb");
    // And with zstd: one RLE block would make a byte into 128 KiB, again and again.
    let mut b = spz_head(4, 9_000_000, [0, 12, 0, 5]);
    b.extend(32u32.to_le_bytes());
    b.extend([0; 12]);
    let mut stream = vec![0x28, 0xb5, 0x2f, 0xfd, 0xa0];
    stream.extend(81_000_000u32.to_le_bytes());
    for i in 0..618 {
        let size: u32 = if i == 617 { 81_000_000 - 617 * 131_072 } else { 131_072 };
        stream.extend(&(size << 3 | 2 | u32::from(i == 617)).to_le_bytes()[..3]);
        stream.push(0);
    }
    for size in [9u64, 1, 3, 3, 4] {
        b.extend((stream.len() as u64).to_le_bytes());
        b.extend((size * 9_000_000).to_le_bytes());
    }
    (0..5).for_each(|_| b.extend(&stream));
    refused("spz", &b, "decompression bomb");
}

#[test]
fn lying_ksplats() {
    let good = ksplat(1);
    for (at, bytes, what) in [
        (0, &[1u8][..], "version 0.1"),
        (1, &[0], "version 0.1"),
        (20, &[3], "level 0, 1 or 2"),
        (4, &[0xff; 4], "section headers"),
        (4, &[2], "section headers"),
        (4, &[0], "Gaussians in the sections"),
        (16, &[0xff; 4], "Gaussians in the sections"),
        (4096, &[0xff; 4], "section 0"),
        (4096, &[6], "section 0"),
        (4100, &[4], "at most 4"),
        (4108, &[0xff; 4], "section 0"),
        (4108, &[1, 0, 0, 0], "5256 bytes"),
        (4116, &[0, 0], "5244 bytes"),
        (4120 + 12, &[0xff; 4], "section 0"),
        (4136, &[4, 0], "SH degree 0 to 3"),
        (4112, &f32::NAN.to_le_bytes(), "5 of 5 splats, which hold numbers that are NaN"),
    ] {
        let mut b = good.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        refused("ksplat", &b, what);
    }
    // Centres that are missing from header and data alike.
    for (at, bytes, gone) in [(4108, &[1u8, 0, 0, 0][..], 24), (4116, &[0, 0], 36)] {
        let mut b = good.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        b.drain(5124..5124 + gone);
        refused("ksplat", &b, "bucket centre");
    }
}

#[test]
fn lying_splats() {
    let good = written("a.splat", &small(0));
    refused("splat", &good[..good.len() - 1], "records of 32 bytes");
    refused("splat", &[0; 96], "3 of 3 splats, whose rotation is 0 0 0 0");
    let mut b = good;
    b[64 + 12..64 + 16].copy_from_slice(&(-1.0f32).to_le_bytes());
    refused("splat", &b, "scales of 0 or more");
}

/// A .glb of `json` and `binary`.
fn glb(json: &str, binary: &[u8]) -> Vec<u8> {
    let mut json = json.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut b = b"glTF".to_vec();
    for v in [2, 28 + json.len() + binary.len(), json.len(), 0x4E4F_534A] {
        b.extend((v as u32).to_le_bytes());
    }
    b.extend(json);
    b.extend((binary.len() as u32).to_le_bytes());
    b.extend(b"BIN\0");
    b.extend(binary);
    b
}

#[test]
fn lying_glbs() {
    let good = written("a.glb", &small(0));
    let word = |at: usize| u32::from_le_bytes(good[at..at + 4].try_into().unwrap()) as usize;
    let end = 20 + word(12);
    let json = std::str::from_utf8(&good[20..end]).unwrap();
    let binary = &good[end + 8..];
    assert!(answer("glb", parse_glb, &glb(json, binary)).is_ok());
    for (at, bytes, what) in [
        (4, &[1u8][..], "version 2"),
        (8, &[0xff; 4], "cut short"),
        (12, &[0xff; 4], "cut short"),
        (16, b"NOSJ", "a JSON chunk"),
        (end, &[0xff; 4], "cut short"),
        (end + 4, b"BAN\0", "a BIN chunk"),
        (20, b"[", "glTF 2.0 document"),
        (21, b"\xff", "glTF 2.0 document"),
    ] {
        let mut b = good.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        refused("glb", &b, what);
    }
    let prefix = "KHR_gaussian_splatting";
    for (from, to, what) in [
        ("\"version\":\"2.0\"", "\"version\":\"1.0\"", "glTF version 2"),
        ("\"count\":9", "\"count\":1000000000000", "elements of"),
        ("\"count\":9", "\"count\":18446744073709551615", "elements of"),
        ("\"count\":9", "\"count\":-9", "glTF 2.0 document"),
        ("\"count\":9", "\"count\":1e400", "glTF 2.0 document"),
        ("\"count\":9", "\"count\":0", "elements of"),
        ("\"byteOffset\":0", "\"byteOffset\":18446744073709551615", "elements of"),
        ("\"byteLength\":", "\"byteStride\":0,\"byteLength\":", "stride 0"),
        ("\"byteLength\":", "\"byteStride\":18446744073709551615,\"byteLength\":", "elements of"),
        ("\"type\":\"VEC3\"", "\"type\":\"MAT4\"", "accessor of VEC3"),
        ("\"componentType\":5126", "\"componentType\":5125", "floats, or bytes"),
        ("\"bufferView\":0", "\"bufferView\":99", "bufferView 0 to"),
        ("\"buffer\":0", "\"buffer\":1", "buffer 0 to"),
        ("\"mode\":0", "\"mode\":4", "primitive of points"),
        ("\"scene\":0", "\"scene\":3", "scene 0 to"),
        ("\"mesh\":0", "\"mesh\":3", "mesh 0 to"),
        ("\"mesh\":0", "\"mesh\":0,\"children\":[0]", "tree of nodes"),
        ("\"nodes\":[0]", "\"nodes\":[0,0]", "tree of nodes"),
        ("\"nodes\":[0]", "\"nodes\":[]", "in the scene"),
        (&format!("{prefix}:SCALE"), &format!("{prefix}:SKALE"), "SCALE"),
        ("SH_DEGREE_0_COEF_0", "SH_DEGREE_1_COEF_0", "SH_DEGREE_0_COEF_0"),
        ("SH_DEGREE_0_COEF_0", "SH_DEGREE_0_COEF_1", "SH_DEGREE_0_COEF_0"),
        ("\"buffers\":[{", "\"buffers\":[{\"uri\":\"http://example.org/a.bin\",", "own BIN chunk"),
        ("\"kernel\"", "\"extensions\":{\"KHR_x_compression\":{}},\"kernel\"", "compression"),
        ("\"rotation\":[1.0,", "\"rotation\":[1e300,", "a unit quaternion"),
        ("\"rotation\":[1.0,", "\"rotation\":[0.0,", "a unit quaternion"),
    ] {
        assert!(json.contains(from), "{from} in {json}");
        refused("glb", &glb(&json.replacen(from, to, 1), binary), what);
    }
    refused("glb", &glb(json, &binary[..binary.len() - 4]), "in the BIN chunk");
    refused("glb", &glb(json, &vec![0xff; binary.len()]), "splat 0");
    refused("glb", &glb(&"[".repeat(1 << 16), b""), "glTF 2.0 document");
    refused("glb", &glb(&" ".repeat(17 << 20), b""), "bytes of JSON");
    // Scales as logarithms, which early drafts had.
    let mut b = binary.to_vec();
    b[9 * 28..9 * 28 + 4].copy_from_slice(&(-3.0f32).to_le_bytes());
    refused("glb", &glb(json, &b), "logarithms");
    // A million nodes that all show the same mesh.
    let nodes = vec!["{\"mesh\":0}"; 200_000].join(",");
    let list: Vec<String> = (0..200_000).map(|i| i.to_string()).collect();
    let many =
        json.replacen("\"nodes\":[0]", &format!("\"nodes\":[{}]", list.join(",")), 1).replacen(
            "\"nodes\":[{\"mesh\":0,\"name\":\"splats\",\"rotation\":[1.0,0.0,0.0,0.0]}]",
            &format!("\"nodes\":[{nodes}]"),
            1,
        );
    assert!(many.len() > 3_000_000);
    if let Ok(s) = answer("glb", parse_glb, &glb(&many, binary)) {
        assert!(s.len() <= many.len() + binary.len() + 100);
    }
}

/// Some thousand damaged copies of each seed through the entries that the fuzz targets
/// use: each returns quickly, with a result or an error.
#[test]
fn damaged_files_never_panic() {
    let mut accepted = [0usize; 2];
    for (k, (ending, parse, seed)) in seeds().into_iter().enumerate() {
        let mut random = Random(1000 + k as u64);
        for _ in 0..1500 {
            let mut b = seed.clone();
            for _ in 0..1 + random.below(6) {
                damage(&mut b, &mut random);
            }
            accepted[usize::from(answer(ending, parse, &b).is_ok())] += 1;
        }
    }
    assert!(accepted[0] > 3000 && accepted[1] > 300, "refused, accepted: {accepted:?}");
}

fn damage(b: &mut Vec<u8>, random: &mut Random) {
    const WORDS: [u32; 8] =
        [0, 1, 0x7f, 0x8000_0000, 0x7fff_ffff, u32::MAX, 0x7f80_0000, 0x7fc0_0000];
    if b.is_empty() {
        return;
    }
    // Half of all damage goes to the headers, which state sizes and counts.
    let reach = if random.below(2) == 0 { b.len() } else { b.len().min(400) };
    let at = random.below(reach);
    match random.below(7) {
        0 => b[at] ^= 1 << random.below(8),
        1 => b[at] = random.word() as u8,
        2 => {
            let word = WORDS[random.below(8)].to_le_bytes();
            let n = word.len().min(b.len() - at);
            b[at..at + n].copy_from_slice(&word[..n]);
        }
        3 => b.truncate(at),
        4 => {
            let n = random.below(64).min(b.len() - at);
            let piece = b[at..at + n].to_vec();
            let to = random.below(b.len());
            b.splice(to..to, piece);
        }
        5 => {
            let n = random.below(64).min(b.len() - at);
            b.drain(at..at + n);
        }
        // A digit of a text header.
        _ => {
            let digits: Vec<usize> = (0..reach).filter(|i| b[*i].is_ascii_digit()).collect();
            if let Some(&i) = digits.get(random.below(digits.len().max(1))) {
                b[i] = b'0' + random.below(10) as u8;
            }
        }
    }
}

#[test]
fn missing_files_and_folders_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("nowhere.ply");
    for e in [load_splats(&path).map(drop), splat_info(&path).map(drop)] {
        assert!(e.unwrap_err().to_string().contains("nowhere.ply"));
    }
    assert!(load_splats(folder.path()).is_err());
    for name in ["empty.ply", "empty.glb", "empty.spz", "empty.splat", "empty.ksplat", "empty"] {
        let path = folder.path().join(name);
        std::fs::write(&path, b"").unwrap();
        let e = load_splats(&path).unwrap_err().to_string();
        assert!(e.contains(name), "{e}");
    }
}
