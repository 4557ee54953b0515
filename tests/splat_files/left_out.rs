//! What a reader applies, leaves out or does not read, and the notes on it.

use crate::hostile_splats::{compressed_ply, ksplat, small, written};
use subsplat::files::splats::splat::parse_splat;
use subsplat::files::{SaveOptions, SplatFile, load_splat_file, save_splats, splat_info};
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::SPLAT_STRIDE;

/// Properties of a vertex, in the order of [`row`].
const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];

/// A Gaussian of other numbers for each `i`.
fn row(i: usize) -> Vec<f64> {
    let t = i as f64;
    let mut row = vec![t, -t, 0.5 * t + 1.0, 0.0, 0.0, 0.0, 0.1 * t, 0.2, 0.3];
    row.extend([0.3 * t - 1.0, -4.0 + 0.3 * t, -3.0, -5.0, 1.0, 0.1 * t, 0.2, -0.3]);
    row
}

/// An ascii .ply of `rows`, with properties after those of [`PROPERTIES`].
fn ply(more: &[&str], rows: &[Vec<f64>]) -> Vec<u8> {
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", rows.len());
    for name in PROPERTIES.iter().chain(more) {
        text += &format!("property double {name}\n");
    }
    text += "end_header\n";
    for row in rows {
        let words: Vec<String> = row.iter().map(f64::to_string).collect();
        text += &(words.join(" ") + "\n");
    }
    text.into_bytes()
}

/// Reads `bytes` as a file of this name. `info` must agree with the loader.
fn read(name: &str, bytes: &[u8]) -> SplatFile {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let file = load_splat_file(&path).unwrap();
    let info = splat_info(&path).unwrap();
    assert_eq!((info.count, &info.notes), (file.splats.len(), &file.notes), "{name}");
    let left_out = info.zero_rows + info.non_finite;
    assert_eq!(file.notes.iter().any(|n| n.starts_with("left out: ")), left_out > 0, "{name}");
    file
}

/// Both readers refuse `bytes` with `what`.
fn refused(name: &str, bytes: &[u8], what: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    for e in [load_splat_file(&path).map(drop), splat_info(&path).map(drop)] {
        let e = e.unwrap_err().to_string();
        assert!(e.contains(name) && e.contains(what), "{e}");
    }
}

fn near(what: &str, got: f32, expected: f64) {
    let got = f64::from(got);
    assert!((got - expected).abs() <= 1e-6 * expected.abs(), "{what}: {expected} is {got}");
}

/// Every number of `got` is that of the Gaussians `kept` of `all`.
fn assert_kept(all: &Splats, kept: &[usize], got: &Splats) {
    assert_eq!(got.len(), kept.len());
    for (i, &k) in kept.iter().enumerate() {
        assert_eq!(got.row(i), all.row(k), "row {k}");
        assert_eq!(got.sh_of(i), all.sh_of(k), "SH set {k}");
    }
}

/// Mip-Splatting: σ' = √(σ² + f²), opacity by √(det Σ / det Σ'), once, in any place of the row.
#[test]
fn filter_3d_is_applied_once() {
    let filters = [0.02, 0.0, 0.5, -0.01, 1e-9];
    let mut rows: Vec<Vec<f64>> = (0..filters.len()).map(row).collect();
    let plain = read("plain.ply", &ply(&[], &rows));
    assert!(plain.notes.is_empty(), "{:?}", plain.notes);
    rows.iter_mut().zip(filters).for_each(|(row, f)| row.push(f));
    let file = read("raw.ply", &ply(&["filter_3D"], &rows));
    let [note] = &file.notes[..] else { panic!("{:?}", file.notes) };
    assert!(note.contains("filter_3D") && note.contains("applied"), "{note}");
    for (i, f) in filters.into_iter().enumerate() {
        let before: Vec<f64> = rows[i][10..13].iter().map(|l| l.exp()).collect();
        let after: Vec<f64> = before.iter().map(|s| (s * s + f * f).sqrt()).collect();
        let ratio = before.iter().product::<f64>() / after.iter().product::<f64>();
        for (got, expected) in file.splats.scale(i).into_iter().zip(after) {
            near("σ", got, expected);
        }
        near("opacity", file.splats.opacity(i), ratio / (1.0 + (-rows[i][9]).exp()));
        assert_eq!(file.splats.mean(i), plain.splats.mean(i));
        assert_eq!(file.splats.sh_of(i), plain.splats.sh_of(i));
    }
    // A filter of zero keeps every bit.
    assert_eq!(file.splats.row(1), plain.splats.row(1));

    // A copy holds the applied numbers and no filter: reading it changes them no further.
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.ply");
    save_splats(&copy, &file.splats, &SaveOptions::default()).unwrap();
    let again = load_splat_file(&copy).unwrap();
    assert!(again.notes.is_empty(), "{:?}", again.notes);
    for i in 0..filters.len() {
        for (copy, first) in again.splats.scale(i).into_iter().zip(file.splats.scale(i)) {
            near("σ of the copy", copy, f64::from(first));
        }
        let (a, b) = (file.splats.opacity(i), again.splats.opacity(i));
        assert!((a - b).abs() < 1e-6, "opacity {a} is {b} in the copy");
    }
    // σ = 0 on an axis: the integral is zero, and no number is 0/0.
    rows[0][10] = f64::NEG_INFINITY;
    let file = read("flat.ply", &ply(&["filter_3D"], &rows[..1]));
    assert_eq!(file.splats.opacity(0), 0.0);
    near("σ", file.splats.scale(0)[0], 0.02);
    rows[1][10] = f64::NEG_INFINITY;
    let file = read("flat.ply", &ply(&["filter_3D"], &rows[1..2]));
    assert_eq!(file.splats.opacity(0), plain.splats.opacity(1));
    // A filter that is no number leaves its Gaussian out.
    *rows[2].last_mut().unwrap() = f64::NAN;
    let file = read("nan.ply", &ply(&["filter_3D"], &rows));
    assert_eq!(file.splats.len(), filters.len() - 1);
    assert!(file.notes[1].contains("splat 2 (scale NaN)"), "{:?}", file.notes);
}

/// Rows that were never written and rows with NaN are left out with their numbers, and the others
/// keep their order and their SH sets.
#[test]
fn rows_that_no_writer_means_are_left_out_of_a_ply() {
    let mut rows: Vec<Vec<f64>> = (0..9).map(row).collect();
    let all = read("all.ply", &ply(&[], &rows)).splats;
    for i in [1, 7, 8] {
        rows[i].fill(0.0);
    }
    // A row that ends within its numbers, as where a trainer stopped.
    rows[6][12..].fill(0.0);
    rows[2][0] = f64::NAN;
    rows[3][7] = f64::INFINITY;
    // e¹⁰⁰ exceeds an f32.
    rows[5][11] = 100.0;
    let file = read("holes.ply", &ply(&[], &rows));
    assert_kept(&all, &[0, 4], &file.splats);
    assert_eq!(
        file.notes,
        [
            "left out: 4 of 9 splats, whose rotation is 0 0 0 0 (rows that were never written?); the \
             first is splat 1",
            "left out: 3 of 9 splats, which hold numbers that are NaN or infinite; the first is splat 2 \
             (mean NaN)",
        ]
    );
    let zeros = [rows[1].clone(), rows[1].clone()];
    refused("zeros.ply", &ply(&[], &zeros), "only 2 of 2 splats, whose rotation is 0 0 0 0");
    let both = [rows[1].clone(), rows[3].clone()];
    refused("both.ply", &ply(&[], &both), "the first is splat 1 (SH coefficient inf)");
    // A file of no rows is a scene of nothing, as before.
    assert!(read("none.ply", &ply(&[], &[])).splats.is_empty());

    // The SH sets of a higher degree move with their rows.
    let splats = small(3);
    let mut bytes = written("a.ply", &splats);
    let all = read("a.ply", &bytes).splats;
    let stride = 4 * (17 + 45);
    let first = bytes.len() - 9 * stride;
    bytes[first + 3 * stride..first + 4 * stride].fill(0);
    let at = first + 5 * stride + 4 * 30;
    bytes[at..at + 4].copy_from_slice(&f32::NEG_INFINITY.to_le_bytes());
    let file = read("a.ply", &bytes);
    assert_kept(&all, &[0, 1, 2, 4, 6, 7, 8], &file.splats);
    assert!(file.notes[1].contains("splat 5 (SH coefficient -inf)"), "{:?}", file.notes);
}

#[test]
fn rows_that_no_writer_means_are_left_out_of_every_format() {
    let nan = f32::NAN.to_le_bytes();
    // .splat: a record of zeros, a rotation whose bytes mean zero, a NaN.
    let good = written("a.splat", &small(0));
    let all = parse_splat(&good, "a.splat").unwrap();
    let mut bytes = good;
    bytes[2 * 32..3 * 32].fill(0);
    bytes[4 * 32 + 28..5 * 32].fill(128);
    bytes[6 * 32..6 * 32 + 4].copy_from_slice(&nan);
    let file = read("a.splat", &bytes);
    assert_kept(&all, &[0, 1, 3, 5, 7, 8], &file.splats);
    assert_eq!(file.notes.len(), 2, "{:?}", file.notes);

    // .ksplat: a record of zeros (level 0: 44 bytes), and the centre of the first bucket of two.
    let mut bytes = ksplat(0);
    let all = read("a.ksplat", &bytes).splats;
    let data = bytes.len() - 5 * 44;
    bytes[data + 44..data + 88].fill(0);
    let file = read("a.ksplat", &bytes);
    assert_kept(&all, &[0, 2, 3, 4], &file.splats);
    assert!(file.notes[0].contains("1 of 5 splats, whose rotation"), "{:?}", file.notes);
    let mut bytes = ksplat(1);
    let all = read("a.ksplat", &bytes).splats;
    bytes[5124..5128].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let file = read("a.ksplat", &bytes);
    assert_kept(&all, &[2, 3, 4], &file.splats);
    assert!(file.notes[0].contains("splat 0 (mean inf)"), "{:?}", file.notes);

    // .glb under a node that turns it: means, rotations, then others, 9 of each.
    let mut bytes = written("a.glb", &small(0));
    let all = read("a.glb", &bytes).splats;
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let binary = 20 + word(12) + 8;
    bytes[binary..binary + 4].copy_from_slice(&nan);
    let rotation = binary + 9 * 12 + 7 * 16;
    bytes[rotation..rotation + 16].fill(0);
    let file = read("a.glb", &bytes);
    assert_kept(&all, &[1, 2, 3, 4, 5, 6, 8], &file.splats);
    assert!(file.notes[0].contains("the first is splat 7"), "{:?}", file.notes);
    assert!(file.notes[1].contains("the first is splat 0"), "{:?}", file.notes);

    // .compressed.ply: the bounds of the first chunk of 256 of 300.
    let mut bytes = compressed_ply();
    let all = read("a.compressed.ply", &bytes).splats;
    let chunks = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    bytes[chunks..chunks + 4].copy_from_slice(&nan);
    let file = read("a.compressed.ply", &bytes);
    assert_kept(&all, &(256..300).collect::<Vec<_>>(), &file.splats);
    assert!(file.notes[0].contains("256 of 300 splats"), "{:?}", file.notes);
    assert_eq!(file.splats.rows().len(), 44 * SPLAT_STRIDE);

    // .spz 1: a mean in half floats.
    let body = |mean: u16| {
        let mut b = b"NGSP".to_vec();
        b.extend([1u32, 2].map(u32::to_le_bytes).concat());
        b.extend([0, 8, 0, 0]);
        b.extend([0, 0, 0, mean, 0, 0].map(u16::to_le_bytes).concat());
        b.extend([[200, 200].as_slice(), &[128; 6], &[100; 6], &[128; 6]].concat());
        b
    };
    let all = read("a.spz", &body(0)).splats;
    let file = read("a.spz", &body(0x7e00));
    assert_kept(&all, &[0], &file.splats);
    assert!(file.notes[0].contains("splat 1 (mean NaN)"), "{:?}", file.notes);
}

/// Properties that carry something that is not read are named, once and within bounds; normals and
/// colours beside `f_dc` are not.
#[test]
fn vertex_properties_that_are_not_read_are_named() {
    let notes = |more: &[&str]| {
        let mut row = row(1);
        row.extend(more.iter().map(|_| 0.5));
        read("more.ply", &ply(more, &[row.clone(), row])).notes
    };
    assert_eq!(notes(&["red", "green", "blue", "alpha"]), [""; 0]);
    let expected = ["vertex properties that are not read: label, motion_0, rot_4"];
    assert_eq!(notes(&["label", "red", "motion_0", "rot_4"]), expected);
    let long = "a".repeat(1000);
    let [note] = &notes(&[&long, "b\u{1b}[2J"])[..] else { panic!("one note") };
    assert!(note.ends_with(&format!(": {}, b\\u{{1b}}[2J", &long[..40])), "{note}");
    let many: Vec<String> = (0..100).map(|i| format!("p{i}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    let [note] = &notes(&many)[..] else { panic!("one note") };
    assert!(note.contains(": p0, p1, ") && note.ends_with(", p11 and 88 more"), "{note}");
    // Colours that stand in place of `f_dc` are read; what is left of `f_dc` is not.
    let text =
        String::from_utf8(ply(&["red", "green", "blue"], &[[row(1), vec![1.0; 3]].concat()]));
    let text = text.unwrap().replace("f_dc_0", "other");
    let expected = ["vertex properties that are not read: other, f_dc_1, f_dc_2"];
    assert_eq!(read("colours.ply", text.as_bytes()).notes, expected);
    // A packed file.
    let packed = compressed_ply();
    assert_eq!(read("a.compressed.ply", &packed).notes, [""; 0]);
    let with = |from: &str, to: &str, bytes: &[u8]| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    let (from, to) = ("uint packed_color\n", "uint packed_color\nproperty uchar label\n");
    let header = packed.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let (chunks, vertices) = (header + 2 * 48, header + 2 * 48 + 300 * 16);
    let mut longer = packed[..chunks].to_vec();
    for vertex in packed[chunks..vertices].chunks_exact(16) {
        longer.extend(vertex);
        longer.push(7);
    }
    longer.extend(&packed[vertices..]);
    let expected = ["vertex properties that are not read: label"];
    assert_eq!(read("a.compressed.ply", &with(from, to, &longer)).notes, expected);
}
