//! SOG files: round trips, a real scene's pictures, version 1 and hand-made archives, hostile ones.

use subsplat_test_support::{shared, splat_scene};

use flate2::Crc;
use glam::{DMat3, DVec3};
use image::ExtendedColorType;
use image::codecs::webp::WebPEncoder;
use serde_json::{Value, json};
use splat_scene::*;
use std::io::{Read, Write};
use std::path::Path;
use subsplat::files::poses::scene::load_scene;
use subsplat::files::splats::sog::parse_sog;
use subsplat::files::splats::spz::SpzVersion;
use subsplat::files::{
    SaveOptions, SplatFormat, Up, encode_splats, is_splat_file, load_splat_file, load_splats,
    save_splats, splat_info,
};
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::Renderer;
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};

/// Half a step of each field of a scene of `splat_scene::scene`, with a margin.
const SOG: Tolerance = Tolerance {
    // 16 bits of a logarithm of ±ln 5, times 5.
    mean: 1.3e-4,
    // ln σ by 256 codes of about 6/256; rotation to 1/360.
    covariance: 0.05,
    opacity: 0.51 / 255.0,
    // Some 256 codes of ±2, times Σ|Y| ≤ 4.23.
    colour: 0.06,
};

/// The Gaussian of `before` at each place of `after`, by the nearest mean.
fn matched(before: &Splats, after: &Splats, turn: DMat3) -> Vec<usize> {
    let mean = |s: &Splats, i: usize| DVec3::from_array(s.mean(i).map(f64::from));
    let nearest = |j: usize| {
        let far = |i: &usize| (turn * mean(before, *i) - mean(after, j)).length_squared();
        (0..before.len()).min_by(|a, b| far(a).total_cmp(&far(b))).unwrap()
    };
    let order: Vec<usize> = (0..after.len()).map(nearest).collect();
    let mut sorted = order.clone();
    sorted.sort_unstable();
    assert!(sorted.into_iter().eq(0..before.len()), "each Gaussian once");
    order
}

fn small(degree: usize) -> Splats {
    let basis = ShBasis::Standard;
    scene(1, Kind { parents: 9, children: 1, degree, gain_channels: 0, basis })
}

fn encoded(splats: &Splats) -> Vec<u8> {
    encode_splats(SplatFormat::Sog, splats, &SaveOptions::default()).unwrap()
}

#[test]
fn round_trips_within_its_steps() {
    let y = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let mut seed = 500;
    for basis in [ShBasis::Standard, ShBasis::Mvsplat] {
        for degree in 0..=4 {
            for (children, gain_channels) in [(1, 0), (4, 1), (9, 4)] {
                let kind = Kind { parents: 23, children, degree, gain_channels, basis };
                seed += 1;
                let before = scene(seed, kind);
                for (up, turn) in [(Up::Keep, DMat3::IDENTITY), (Up::Y, y)] {
                    let options = SaveOptions { up, ..Default::default() };
                    let bytes = encode_splats(SplatFormat::Sog, &before, &options).unwrap();
                    let after = parse_sog(&bytes, "a.sog").unwrap();
                    let kept = degree.min(3);
                    assert_eq!(after.sh_degree(), kept);
                    let order = matched(&before, &after, turn);
                    assert_same(&before, &after, &order, turn, kept, SOG);
                    // The same bytes again.
                    assert!(bytes == encode_splats(SplatFormat::Sog, &before, &options).unwrap());
                }
            }
        }
    }
}

#[test]
fn one_gaussian_and_one_plane_are_written() {
    let mut parts = small(1).into_parts();
    parts.rows.chunks_exact_mut(11).for_each(|row| row[2] = 3.0);
    let flat = Splats::try_from(parts).unwrap();
    let after = parse_sog(&encoded(&flat), "a.sog").unwrap();
    assert!((0..9).all(|i| (after.mean(i)[2] - 3.0).abs() < 1e-6));
    let one = flat.selected(&[4]);
    let after = parse_sog(&encoded(&one), "a.sog").unwrap();
    assert_same(&one, &after, &[0], DMat3::IDENTITY, 1, Tolerance { mean: 1e-6, ..SOG });
}

#[test]
fn comments_and_least_opacity_are_those_of_the_options() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.SOG");
    let comments = vec!["subsplat render: near=1".to_owned()];
    let options = SaveOptions { comments, min_opacity: 0.4, ..Default::default() };
    let splats = small(2);
    let report = save_splats(&path, &splats, &options).unwrap();
    let kept = (0..9).filter(|&i| splats.opacity(i) >= 0.4).count();
    assert_eq!((report.format, report.count, report.sh_degree), (SplatFormat::Sog, kept, 2));
    let info = splat_info(&path).unwrap();
    assert_eq!((info.format, info.count, info.flavour.as_str()), (SplatFormat::Sog, kept, "sog 2"));
    assert_eq!(info.bytes, std::fs::metadata(&path).unwrap().len());
    assert!(info.comments.contains(&options.comments[0]), "{:?}", info.comments);
    assert!(info.notes.is_empty(), "{:?}", info.notes);
}

/// The pictures of a real scene of degree 3, drawn before and after.
#[test]
fn a_real_scene_looks_the_same() {
    let Some(folder) = shared("photos/re10k_5aca87f95a9412c6") else { return };
    let splats = load_splats(folder.join("5aca87f95a9412c6.globalsplat16k.ply")).unwrap();
    let camera = load_scene(&folder).unwrap().frames[4].camera;
    let options = RasterOptions::new(Convention::Standard);
    let mut renderer = Renderer::default();
    let mut picture = |s: &Splats| renderer.render(s, &camera, &options);
    let before = picture(&splats);
    let v4 = SaveOptions { spz_version: SpzVersion::V4, ..Default::default() };
    let mut found = Vec::new();
    for (format, options) in [
        (SplatFormat::Sog, SaveOptions::default()),
        (SplatFormat::Spz, SaveOptions::default()),
        (SplatFormat::Spz, v4),
    ] {
        let bytes = encode_splats(format, &splats, &options).unwrap();
        let (after, _) = subsplat::files::parse_splats(&bytes, "a").unwrap();
        let after = picture(&after);
        let db = psnr(&before.rgb, &after.rgb, before.width, before.height).unwrap();
        eprintln!("{format:?} {:?}: {} bytes", options.spz_version, bytes.len());
        found.push((bytes.len(), db));
    }
    assert!(found[0].1 > 40.0 && found[0].0 < found[1].0, "{found:?}");
    // Both versions of .spz hold the same numbers, turned to y up, which this picture does not show upright.
    assert_eq!(found[1].1, found[2].1);
}

/// A zip of `(name, content, deflated)`, by the layout alone.
fn archive(entries: &[(&str, Vec<u8>, bool)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, content, deflated) in entries {
        let mut crc = Crc::new();
        crc.update(content);
        let mut packed = content.clone();
        if *deflated {
            let level = flate2::Compression::default();
            let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), level);
            encoder.write_all(content).unwrap();
            packed = encoder.finish().unwrap();
        }
        let mut fields = Vec::new();
        for v in [20, 0, 8 * u16::from(*deflated), 0, 33] {
            fields.extend(u16::to_le_bytes(v));
        }
        for v in [crc.sum(), packed.len() as u32, content.len() as u32] {
            fields.extend(v.to_le_bytes());
        }
        fields.extend((name.len() as u16).to_le_bytes());
        let offset = out.len() as u32;
        out.extend(b"PK\x03\x04");
        out.extend(&fields);
        out.extend([0, 0]);
        out.extend(name.bytes());
        out.extend(packed);
        directory.extend(b"PK\x01\x02\x14\0");
        directory.extend(&fields);
        directory.extend([0; 12]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.bytes());
    }
    let (at, size) = (out.len() as u32, directory.len() as u32);
    out.extend(directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    for _ in 0..2 {
        out.extend((entries.len() as u16).to_le_bytes());
    }
    out.extend(size.to_le_bytes());
    out.extend(at.to_le_bytes());
    out.extend([0, 0]);
    out
}

fn webp(width: u32, height: u32, rgba: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder = WebPEncoder::new_lossless(&mut bytes);
    encoder.encode(rgba, width, height, ExtendedColorType::Rgba8).unwrap();
    bytes
}

/// Files of a scene of two Gaussians of degree 1, in the form of `version`.
fn hand_made(version: u64) -> (Value, Vec<(&'static str, Vec<u8>)>) {
    let mut centroids = vec![0u8; 4 * 192];
    // Row 1 of the palette: coefficients (k, c) of codes 10·k + c.
    for k in 0..3u8 {
        for c in 0..3u8 {
            centroids[4 * (3 + usize::from(k)) + usize::from(c)] = 10 * k + c;
        }
    }
    let planes = vec![
        ("l.webp", webp(2, 1, &[0, 0, 0, 255, 0xff, 0x34, 0xff, 255])),
        ("u.webp", webp(2, 1, &[0, 0, 0, 255, 0xff, 0x12, 0xff, 255])),
        ("q.webp", webp(2, 1, &[128, 128, 128, 252, 255, 128, 128, 255])),
        ("s.webp", webp(2, 1, &[0, 128, 255, 255, 1, 2, 3, 255])),
        ("c.webp", webp(2, 1, &[0, 100, 255, 51, 7, 8, 9, 255])),
        ("p.webp", webp(192, 1, &centroids)),
        ("n.webp", webp(2, 1, &[0, 0, 0, 255, 1, 0, 0, 255])),
    ];
    // Code i stands for i/16 − 10 and so on.
    let book = |scale: f64, shift: f64| (0..256).map(|i| f64::from(i) * scale + shift).collect();
    let [log_scales, colours, sh]: [Vec<f64>; 3] =
        [book(1.0 / 16.0, -10.0), book(1.0 / 64.0, -2.0), book(1.0 / 128.0, -1.0)];
    let ends = |book: &[f64], n: usize| (vec![book[0]; n], vec![book[255]; n]);
    let mut meta = json!({
        "means": { "mins": [-1.0, 0.0, 2.0], "maxs": [1.0, 1.0, 3.0], "files": ["l.webp", "u.webp"] },
        "quats": { "files": ["q.webp"] },
    });
    if version == 2 {
        meta["version"] = json!(2);
        meta["count"] = json!(2);
        meta["scales"] = json!({ "codebook": log_scales, "files": ["s.webp"] });
        meta["sh0"] = json!({ "codebook": colours, "files": ["c.webp"] });
        meta["shN"] = json!({
            "count": 2, "bands": 1, "codebook": sh, "files": ["p.webp", "n.webp"]
        });
    } else {
        meta["means"]["shape"] = json!([2, 3]);
        let (mins, maxs) = ends(&log_scales, 3);
        meta["scales"] = json!({ "mins": mins, "maxs": maxs, "files": ["s.webp"] });
        let (mut mins, mut maxs) = ends(&colours, 3);
        mins.push(-5.0);
        maxs.push(5.0);
        meta["sh0"] = json!({ "mins": mins, "maxs": maxs, "files": ["c.webp"] });
        meta["shN"] = json!({ "mins": sh[0], "maxs": sh[255], "files": ["p.webp", "n.webp"] });
    }
    (meta, planes)
}

fn packed(meta: &Value, planes: &[(&str, Vec<u8>)], prefix: &str, deflated: bool) -> Vec<u8> {
    let meta_name = format!("{prefix}meta.json");
    let names: Vec<String> = planes.iter().map(|(name, _)| format!("{prefix}{name}")).collect();
    let mut entries: Vec<(&str, Vec<u8>, bool)> = names
        .iter()
        .zip(planes)
        .map(|(name, (_, bytes))| (name.as_str(), bytes.clone(), deflated))
        .collect();
    entries.push((meta_name.as_str(), meta.to_string().into_bytes(), deflated));
    archive(&entries)
}

fn assert_hand_made(s: &Splats, version: u64) {
    let near = |what: &str, got: f32, expected: f64| {
        let off = (f64::from(got) - expected).abs();
        assert!(off <= 1e-5 * expected.abs().max(1.0), "{what} of {version}: {got} {expected}");
    };
    assert_eq!((s.len(), s.sh_degree()), (2, 1));
    let e = std::f64::consts::E;
    for (got, expected) in s.mean(0).into_iter().zip([1.0 - e, 0.0, e.powi(2) - 1.0]) {
        near("mean", got, expected);
    }
    let step = f64::from(0x1234) / 65535.0;
    for (got, expected) in s.mean(1).into_iter().zip([e - 1.0, step.exp() - 1.0, e.powi(3) - 1.0]) {
        near("mean", got, expected);
    }
    // 252 is w, the first of wxyz; 255 is z.
    let middle = (128.0 / 255.0 * 2.0 - 1.0) / 2f64.sqrt();
    let largest = |others: [f64; 3]| (1.0 - others.iter().map(|v| v * v).sum::<f64>()).sqrt();
    let half = 0.5f64.sqrt();
    for (i, expected) in [
        (0, [largest([middle; 3]), middle, middle, middle]),
        (1, [half, middle, middle, largest([half, middle, middle])]),
    ] {
        for (got, expected) in s.quat_wxyz(i).into_iter().zip(expected) {
            near("quaternion", got, expected);
        }
    }
    for (got, code) in s.scale(0).into_iter().zip([0.0, 128.0, 255.0]) {
        near("ln σ", got.ln(), code / 16.0 - 10.0);
    }
    for (got, code) in s.sh_of(0).iter().zip([0.0, 100.0, 255.0]) {
        near("dc", *got, code / 64.0 - 2.0);
    }
    let opacity = if version == 2 { 0.2 } else { 1.0 / (1.0 + 3f64.exp()) };
    near("opacity", s.opacity(0), opacity);
    for k in 0..3 {
        for c in 0..3 {
            near("SH", s.sh_of(0)[3 * (1 + k) + c], -1.0);
            near("SH", s.sh_of(1)[3 * (1 + k) + c], (10 * k + c) as f64 / 128.0 - 1.0);
        }
    }
}

#[test]
fn both_versions_are_read_from_archives_and_folders() {
    for version in [1, 2] {
        let (meta, planes) = hand_made(version);
        for (prefix, deflated) in [("", false), ("", true), ("scene/", true)] {
            let bytes = packed(&meta, &planes, prefix, deflated);
            assert_hand_made(&parse_sog(&bytes, "a.sog").unwrap(), version);
        }
        let folder = tempfile::tempdir().unwrap();
        assert!(!is_splat_file(folder.path()));
        let path = folder.path().join("meta.json");
        std::fs::write(&path, "{\"fl_x\": 1}").unwrap();
        assert!(!is_splat_file(&path) && !is_splat_file(folder.path()));
        std::fs::write(&path, meta.to_string()).unwrap();
        planes.iter().for_each(|(n, b)| std::fs::write(folder.path().join(n), b).unwrap());
        for path in [folder.path(), &path] {
            assert!(is_splat_file(path));
            assert_hand_made(&load_splats(path).unwrap(), version);
            let info = splat_info(path).unwrap();
            assert_eq!(info.flavour, format!("sog {version}"));
            let sizes: u64 = planes.iter().map(|(_, b)| b.len() as u64).sum();
            assert_eq!(info.bytes, sizes + meta.to_string().len() as u64);
        }
        // A file that is missing is named.
        std::fs::remove_file(folder.path().join("q.webp")).unwrap();
        let e = load_splats(folder.path()).unwrap_err().to_string();
        assert!(e.contains("q.webp"), "{e}");
    }
}

#[test]
fn pictures_with_losses_are_named() {
    let (meta, mut planes) = hand_made(2);
    // The name of the chunk alone: the reader of pictures finds the damage where it is one.
    let mut lossy = planes[3].1.clone();
    lossy[12..16].copy_from_slice(b"VP8 ");
    planes[3].1 = lossy;
    let e = parse_sog(&packed(&meta, &planes, "", false), "a.sog").unwrap_err().to_string();
    assert!(e.contains("s.webp") && e.contains("a whole picture"), "{e}");
}

#[test]
fn lying_archives_are_refused_by_name() {
    let (good, planes) = hand_made(2);
    let edit = |pointer: &str, value: Value| {
        let mut meta = good.clone();
        *meta.pointer_mut(pointer).unwrap() = value;
        packed(&meta, &planes, "", false)
    };
    let exchange = |i: usize, bytes: Vec<u8>| {
        let mut planes = planes.clone();
        planes[i].1 = bytes;
        packed(&good, &planes, "", false)
    };
    let big = webp(9000, 2000, &vec![7; 9000 * 2000 * 4]);
    assert!(big.len() < 1 << 20);
    let mut bytes = packed(&good, &planes, "", false);
    // A byte of the first picture.
    bytes[30 + 6 + 20] ^= 1;
    for (bytes, what) in [
        (edit("/version", json!(3)), "SOG version 1 or 2"),
        (edit("/version", json!("two")), "the meta.json of a SOG"),
        (edit("/count", json!(3)), "3 pixels or more"),
        (edit("/count", json!(u64::MAX)), "pixels or more"),
        (edit("/count", json!(-1)), "the meta.json of a SOG"),
        (edit("/means/files/0", json!("../l.webp")), "a file beside meta.json"),
        (edit("/means/files/0", json!("/etc/passwd")), "a file beside meta.json"),
        (edit("/means/files/0", json!("")), "a file beside meta.json"),
        (edit("/means/files/0", json!("absent.webp")), "an entry of the archive"),
        (edit("/means/files/0", json!("meta.json")), "a whole picture"),
        (edit("/means/files", json!(["l.webp"])), "the meta.json of a SOG"),
        (edit("/means/mins", json!([0, 0])), "the meta.json of a SOG"),
        (edit("/scales/codebook", json!([])), "codebook (version 2)"),
        // Codes without a number give no finite Gaussian.
        (edit("/scales/codebook", json!([0])), "NaN"),
        (edit("/shN/bands", json!(2)), "192, 512 or 960"),
        (edit("/shN/bands", json!(4)), "192, 512 or 960"),
        (edit("/shN/count", json!(1)), "a label below 1"),
        (edit("/shN/codebook", json!([])), "of shN"),
        (exchange(2, webp(2, 1, &[128, 128, 128, 251, 0, 0, 0, 255])), "alpha of 252 to 255"),
        (exchange(0, webp(1, 1, &[0; 4])), "2 pixels or more"),
        (exchange(0, big), "decoded bytes"),
        (exchange(6, webp(2, 1, &[64, 0, 0, 255, 1, 0, 0, 255])), "a label below 2"),
        (exchange(5, webp(191, 1, &[0; 764])), "192, 512 or 960"),
        (exchange(1, b"GIF89a not one of these".to_vec()), "another format"),
        (bytes, "checksum"),
        (archive(&[("a.txt", b"hello".to_vec(), false)]), "meta.json in the archive"),
        (archive(&[("meta.json", b"{}".to_vec(), false)]), "the meta.json of a SOG"),
        (b"PK\x03\x04 and no directory".to_vec(), "a whole zip archive"),
    ] {
        let e = parse_sog(&bytes, "lies.sog").unwrap_err().to_string();
        assert!(e.starts_with("lies.sog") && e.contains(what), "{what}: {e}");
        assert!(e.contains("expected ") && e.contains(", got ") && !e.contains('\n'), "{e}");
    }
    // A size that the entry does not have.
    let mut bytes = archive(&[("meta.json", vec![b' '; 100], true)]);
    let at = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap() + 24;
    for size in [99u32, 101, u32::MAX - 1] {
        bytes[at..at + 4].copy_from_slice(&size.to_le_bytes());
        let e = parse_sog(&bytes, "lies.sog").unwrap_err().to_string();
        assert!(e.contains("bytes"), "{e}");
    }
}

/// A copy of every plane beside the written archive reads the same.
#[test]
fn an_unpacked_archive_reads_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    save_splats(&path, &small(3), &SaveOptions::default()).unwrap();
    unpack(&path, &folder.path().join("unpacked"));
    let [a, b] = [path, folder.path().join("unpacked")].map(|p| load_splat_file(p).unwrap());
    assert!(a == b);
}

fn unpack(archive: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    let mut zip = zip::ZipArchive::new(std::fs::File::open(archive).unwrap()).unwrap();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).unwrap();
        assert_eq!(entry.compression(), zip::CompressionMethod::Stored);
        let name = entry.name().unwrap().to_string();
        let mut content = Vec::new();
        entry.read_to_end(&mut content).unwrap();
        std::fs::write(to.join(name), content).unwrap();
    }
}
