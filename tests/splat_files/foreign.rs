//! Dialects of other programs: half floats, discs of 2DGS, groups by degree, bytes after the rows,
//! .spz version 4 and .spz within glTF.

use crate::hostile_splats::{small, written};
use half::f16;
use serde_json::{Value, json};
use subsplat::files::splats::glb::parse_glb;
use subsplat::files::splats::ply::parse_ply;
use subsplat::files::splats::spz::{SpzVersion, parse_spz};
use subsplat::files::{
    SaveOptions, SplatFile, SplatFormat, encode_splats, load_splat_file, splat_info,
};

const NAMES: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
];

/// Numbers of Gaussian `i`, exact in f16.
fn row(i: usize) -> Vec<f32> {
    let t = i as f32;
    let mut row = vec![t, -0.5 * t, 2.0, 0.25, 0.5 - t, -0.125, 0.75, -3.5, -4.25, -5.0 - t];
    row.extend([1.0, 0.5, -0.25, 0.125 * t]);
    row
}

/// Name, number of rows, and properties as name and type.
type Element<'a> = (&'a str, usize, Vec<(&'a str, String)>);

fn header(format: &str, elements: &[Element<'_>]) -> Vec<u8> {
    let mut text = format!("ply\nformat {format} 1.0\n");
    for (name, count, properties) in elements {
        text += &format!("element {name} {count}\n");
        for (kind, name) in properties {
            text += &format!("property {kind} {name}\n");
        }
    }
    (text + "end_header\n").into_bytes()
}

fn typed(kind: &'static str) -> Vec<(&'static str, String)> {
    NAMES.map(|name| (kind, name.to_owned())).into()
}

/// A file of three Gaussians with all properties of `kind`, and the rows by `put`.
fn file(kind: &'static str, format: &str, put: impl Fn(f32) -> Vec<u8>) -> Vec<u8> {
    let mut bytes = header(format, &[("vertex", 3, typed(kind))]);
    for i in 0..3 {
        row(i).into_iter().for_each(|v| bytes.extend(put(v)));
    }
    bytes
}

/// Reads `bytes` from a file of this name. `info` must agree with the loader.
fn read(name: &str, bytes: &[u8]) -> SplatFile {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let file = load_splat_file(&path).unwrap();
    assert_eq!(splat_info(&path).unwrap().notes, file.notes);
    file
}

#[test]
fn every_number_type_gives_the_same_splats() {
    let plain = file("float", "binary_little_endian", |v| v.to_le_bytes().into());
    let expected = parse_ply(&plain, "a.ply").unwrap();
    let little = "binary_little_endian";
    let big = "binary_big_endian";
    let half = |v: f32| f16::from_f32(v).to_bits();
    for (what, bytes, notes) in [
        ("double", file("double", little, |v| f64::from(v).to_le_bytes().into()), 0),
        ("double, big", file("float64", big, |v| f64::from(v).to_be_bytes().into()), 0),
        ("half", file("half", little, |v| half(v).to_le_bytes().into()), 0),
        ("half, big", file("float16", big, |v| half(v).to_be_bytes().into()), 0),
        // The bits of halves, as plyfile writes them.
        ("short", file("short", little, |v| half(v).to_le_bytes().into()), 1),
        ("ushort", file("ushort", little, |v| half(v).to_le_bytes().into()), 1),
        ("int16, big", file("int16", big, |v| half(v).to_be_bytes().into()), 1),
    ] {
        let got = read("a.ply", &bytes);
        assert!(got.splats == expected, "{what}: {:?}", got.splats.row(1));
        assert_eq!(got.notes.len(), notes, "{what}: {:?}", got.notes);
        assert!(got.notes.iter().all(|n| n.contains("half-precision")), "{:?}", got.notes);
    }
    // Cut within the last row.
    let e = parse_ply(&plain[..plain.len() - 1], "a.ply").unwrap_err().to_string();
    assert!(e.contains("3 rows of `vertex`, at least 168 bytes") && e.contains("got 167"), "{e}");
}

/// Integers of a shape that is not all 16 bits wide are values, and a note names them.
#[test]
fn integers_that_may_be_codes_are_named() {
    let mut properties = typed("float");
    properties[3].0 = "uchar";
    properties[4].0 = "uchar";
    let mut bytes = header("binary_little_endian", &[("vertex", 1, properties)]);
    for (i, v) in row(2).into_iter().enumerate() {
        if i == 3 || i == 4 { bytes.push(200) } else { bytes.extend(v.to_le_bytes()) }
    }
    let got = read("a.ply", &bytes);
    assert_eq!(got.splats.sh_of(0), [200.0, 200.0, -0.125]);
    let [note] = &got.notes[..] else { panic!("{:?}", got.notes) };
    assert!(note.contains("f_dc_0 and 1 more") && note.contains("codes"), "{note}");
}

#[test]
fn discs_without_scale_2_are_thin() {
    let mut properties = typed("float");
    properties.remove(9);
    let mut bytes = header("binary_little_endian", &[("vertex", 3, properties)]);
    for i in 0..3 {
        let mut row = row(i);
        row.remove(9);
        if i == 2 {
            // Smaller than the thickness of the others.
            row[7] = 1e-8f32.ln();
        }
        row.into_iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    }
    let got = read("a.ply", &bytes);
    let plain = file("float", "binary_little_endian", |v| v.to_le_bytes().into());
    let solid = parse_ply(&plain, "a.ply").unwrap();
    for i in 0..2 {
        assert_eq!(got.splats.scale(i)[..2], solid.scale(i)[..2]);
        assert_eq!(got.splats.scale(i)[2], 1e-6);
        assert_eq!(got.splats.quat_wxyz(i), solid.quat_wxyz(i));
    }
    let [a, _, c] = got.splats.scale(2);
    assert_eq!(a, c);
    let [note] = &got.notes[..] else { panic!("{:?}", got.notes) };
    assert!(note.contains("2DGS") && note.contains("0.000001"), "{note}");
    // Without scale_1 it is no splat file.
    let bytes = header("ascii", &[("vertex", 0, typed("float").drain(..8).collect())]);
    let e = parse_ply(&bytes, "a.ply").unwrap_err().to_string();
    assert!(e.contains("without scale_1, rot_0"), "{e}");
}

/// reduced-3dgs: an element for each degree, the numbers as halves in shorts.
#[test]
fn groups_by_degree_are_one_scene() {
    let degrees = [0usize, 2, 1];
    let half = |v: f32| f16::from_f32(v).to_bits().to_le_bytes();
    let rests = |d: usize| 3 * ((d + 1) * (d + 1) - 1);
    let elements: Vec<(String, usize)> =
        degrees.iter().map(|d| (format!("vertex_{d}"), *d)).collect();
    let elements: Vec<Element<'_>> = elements
        .iter()
        .map(|(name, d)| {
            let rest = (0..rests(*d)).map(|i| ("short", format!("f_rest_{i}")));
            (name.as_str(), 2, typed("short").into_iter().chain(rest).collect())
        })
        .collect();
    let mut bytes = header("binary_little_endian", &elements);
    for d in degrees {
        for i in 0..2 {
            row(i).into_iter().for_each(|v| bytes.extend(half(v)));
            (0..rests(d)).for_each(|k| bytes.extend(half(k as f32 / 4.0 + 1.0)));
        }
    }
    let got = read("a.ply", &bytes);
    assert_eq!((got.splats.len(), got.splats.sh_degree()), (6, 2));
    assert_eq!(got.notes.len(), 1, "{:?}", got.notes);
    for (i, d) in [0, 0, 2, 2, 1, 1].into_iter().enumerate() {
        let per_channel = rests(d) / 3;
        for k in 1..9 {
            for c in 0..3 {
                let expected = match k <= per_channel {
                    true => (c * per_channel + k - 1) as f32 / 4.0 + 1.0,
                    false => 0.0,
                };
                assert_eq!(got.splats.sh_of(i)[3 * k + c], expected, "{i} {k} {c}");
            }
        }
        assert_eq!(got.splats.mean(i), [(i % 2) as f32, -0.5 * (i % 2) as f32, 2.0]);
    }
    // Indices into codebooks are no numbers.
    let codes = ("codebook_centers", 256, vec![("float", "opacity".to_owned())]);
    let group = ("vertex_0", 1, typed("uchar"));
    let bytes = header("binary_little_endian", &[group, codes]);
    let e = parse_ply(&bytes, "a.ply").unwrap_err().to_string();
    assert!(e.contains("codebook_centers") && e.contains("without quantisation"), "{e}");
}

#[test]
fn bytes_after_the_last_row_are_counted() {
    let plain = file("float", "binary_little_endian", |v| v.to_le_bytes().into());
    let expected = parse_ply(&plain, "a.ply").unwrap();
    for more in [1, 55, 56, 5000] {
        let got = read("a.ply", &[&plain[..], &vec![b'\n'; more]].concat());
        assert!(got.splats == expected);
        let [note] = &got.notes[..] else { panic!("{:?}", got.notes) };
        assert!(note.starts_with(&format!("{more} bytes after the last row")), "{note}");
    }
    let mut text = header("ascii", &[("vertex", 1, typed("float"))]);
    let words: Vec<String> = row(1).iter().map(f32::to_string).collect();
    text.extend((words.join(" ") + "\r\n \n\n").bytes());
    assert!(read("a.ply", &text).notes.is_empty());
    text.extend(b"1 2 3\n\n4");
    let got = read("a.ply", &text);
    assert_eq!((got.splats.len(), got.notes.len()), (1, 1));
    assert!(got.notes[0].starts_with("8 bytes after"), "{:?}", got.notes);
}

fn v4() -> SaveOptions {
    SaveOptions { spz_version: SpzVersion::V4, ..Default::default() }
}

#[test]
fn both_versions_of_spz_hold_the_same_numbers() {
    for degree in [0, 1, 3] {
        let splats = small(degree);
        let three = parse_spz(&written("a.spz", &splats), "a.spz").unwrap();
        let bytes = encode_splats(SplatFormat::Spz, &splats, &v4()).unwrap();
        assert_eq!(bytes[..8], *b"NGSP\x04\0\0\0");
        assert!(parse_spz(&bytes, "b.spz").unwrap() == three, "degree {degree}");
        let got = read("b.spz", &bytes);
        assert!(got.splats == three && got.notes.is_empty());
        // The table: compressed and whole sizes that fill the file.
        let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let streams = usize::from(bytes[15]);
        assert_eq!((streams, bytes[16]), (if degree == 0 { 5 } else { 6 }, 32));
        let end = (0..streams).map(|i| word(32 + 16 * i)).sum::<u64>() + 32 + 16 * streams as u64;
        assert_eq!(end, bytes.len() as u64);
        assert_eq!(word(32 + 8), 9 * splats.len() as u64);
    }
}

/// A .glb whose primitive holds `spz` by `extensions`, under a node turned by `node`.
fn glb(spz: &[u8], extensions: &Value, node: &Value) -> Vec<u8> {
    let mut binary = vec![0u8; 8];
    binary.extend(spz);
    binary.resize(binary.len().next_multiple_of(4), 0);
    let document = json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{
            "attributes": { "POSITION": 0 }, "mode": 0, "extensions": extensions
        }] }],
        "accessors": [{ "componentType": 5126, "count": 9, "type": "VEC3" }],
        "bufferViews": [{ "buffer": 0, "byteOffset": 8, "byteLength": spz.len() }],
        "buffers": [{ "byteLength": 8 + spz.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    for v in [2, 28 + text.len() + binary.len(), text.len(), 0x4E4F_534A] {
        bytes.extend((v as u32).to_le_bytes());
    }
    bytes.extend(text);
    bytes.extend((binary.len() as u32).to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend(binary);
    bytes
}

#[test]
fn an_spz_within_gltf_is_read() {
    let spz = written("a.spz", &small(2));
    let expected = parse_spz(&spz, "a.spz").unwrap();
    let view = json!({ "bufferView": 0 });
    let plain = json!({ "mesh": 0 });
    let name = "KHR_gaussian_splatting_compression_spz";
    for extensions in [
        json!({ "KHR_gaussian_splatting": { "extensions": { (format!("{name}_2")): view } } }),
        json!({ "KHR_gaussian_splatting": { "extensions": { name: view } } }),
        json!({ "KHR_gaussian_splatting": {}, name: view }),
        json!({ "KHR_spz_gaussian_splats_compression": view }),
    ] {
        let got = read("a.glb", &glb(&spz, &extensions, &plain));
        assert!(got.splats == expected, "{extensions}");
        assert!(got.notes.is_empty());
    }
    let extensions =
        json!({ "KHR_gaussian_splatting": { "extensions": { (format!("{name}_2")): view } } });
    let four = encode_splats(SplatFormat::Spz, &small(2), &v4()).unwrap();
    assert!(parse_glb(&glb(&four, &extensions, &plain), "a.glb").unwrap() == expected);
    // The node moves them, up is +y there.
    let node = json!({ "mesh": 0, "translation": [0, 5, 0], "scale": [2, 2, 2] });
    let moved = parse_glb(&glb(&spz, &extensions, &node), "a.glb").unwrap();
    for i in 0..moved.len() {
        let [x, y, z] = expected.mean(i);
        let got = moved.mean(i);
        for (got, expected) in got.into_iter().zip([2.0 * x, 2.0 * y - 5.0, 2.0 * z]) {
            assert!((got - expected).abs() < 1e-5, "{got} {expected}");
        }
    }
    let refused = |bytes: &[u8], what: &str| {
        let e = parse_glb(bytes, "a.glb").unwrap_err().to_string();
        assert!(e.starts_with("a.glb") && e.contains(what), "{what}: {e}");
    };
    refused(&glb(&spz[..spz.len() - 1], &extensions, &plain), "the .spz within");
    refused(&glb(b"NGSP", &extensions, &plain), "the .spz within");
    let wrong = json!({ "KHR_gaussian_splatting": { "extensions": { name: {} } } });
    refused(&glb(&spz, &wrong, &plain), "a bufferView of");
    let wrong =
        json!({ "KHR_gaussian_splatting": { "extensions": { name: { "bufferView": 1 } } } });
    refused(&glb(&spz, &wrong, &plain), "bufferView 0 to 1");
    let wrong = json!({ "KHR_gaussian_splatting": { "extensions": { "KHR_other": view } } });
    refused(&glb(&spz, &wrong, &plain), "attributes without compression");
    let good = glb(&spz, &extensions, &plain);
    for cut in 0..good.len() {
        assert!(parse_glb(&good[..cut], "a.glb").is_err());
    }
}
