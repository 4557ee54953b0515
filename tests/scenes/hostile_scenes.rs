//! Tests of invalid scenes, pose files and pictures: each gives one error that names the file and
//! the expected content, without a panic and without unbounded memory.

use subsplat_test_support::colmap_files;
use subsplat_test_support::made_up;
use subsplat_test_support::noise;

use made_up::made_up;
use serde_json::{Value, json};
use std::path::Path;
use subsplat::files::photos::image;
use subsplat::files::poses::cameras_json::{CameraFile, save_cameras_json};
use subsplat::files::poses::colmap::{
    Cameras, ColmapImage, parse_cameras_bin, parse_cameras_txt, parse_images_bin, parse_images_txt,
    parse_points_bin, parse_points_txt,
};
use subsplat::files::poses::protocol::{load_index, load_protocol};
use subsplat::files::poses::re10k;
use subsplat::files::poses::scene::{Units, load_scene};
use subsplat_kernels::layout::random;

/// Asserts an error of one line that contains all of `words`.
fn check(case: &str, result: Result<(), subsplat::files::Error>, words: &[&str]) {
    let error = match result {
        Ok(()) => panic!("{case}: was accepted"),
        Err(e) => e.to_string(),
    };
    eprintln!("{case}: {error}");
    assert_eq!(error.lines().count(), 1, "{case}: {error}");
    assert!(error.len() < 700, "{case}: {error}");
    for word in words {
        assert!(error.contains(word), "{case}: `{word}` is not in `{error}`");
    }
}

/// Loads a scene. An entry that is left out counts as an error with the text of its warning.
fn load(path: &Path) -> Result<(), subsplat::files::Error> {
    let scene = load_scene(path)?;
    match scene.warnings.iter().find(|line| line.contains("are left out")) {
        Some(line) => Err(subsplat::files::Error::format(path, "all entries", line)),
        None => Ok(()),
    }
}

/// Loads a valid scene with `file` replaced by `bytes`.
fn with(file: &str, bytes: &[u8]) -> Result<(), subsplat::files::Error> {
    let (folder, _) = made_up(3);
    let path = folder.path().join(file);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, bytes).unwrap();
    load(folder.path())
}

/// Returns a valid `transforms.json` of the synthetic pictures, modified by `change`.
fn transforms(change: impl Fn(&mut Value)) -> Vec<u8> {
    let eye = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
    let frame =
        |i: usize| json!({"file_path": format!("images/{i:03}.png"), "transform_matrix": eye});
    let mut value = json!({"fl_x": 70.0, "frames": [frame(0), frame(1), frame(2)]});
    change(&mut value);
    value.to_string().into_bytes()
}

/// Returns a valid `cameras.json` of the synthetic pictures, modified by `change`.
fn cameras_json(change: impl Fn(&mut Value)) -> Vec<u8> {
    let (folder, cameras) = made_up(3);
    let path = folder.path().join("cameras.json");
    save_cameras_json(
        &path,
        &CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() },
    )
    .unwrap();
    let mut value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    change(&mut value);
    value.to_string().into_bytes()
}

#[test]
fn the_unchanged_files_are_accepted() {
    with("transforms.json", &transforms(|_| ())).unwrap();
    with("cameras.json", &cameras_json(|_| ())).unwrap();
    with("a.txt", RE10K.as_bytes()).unwrap();
    with("poses.txt", b"").unwrap_err();
}

#[test]
fn bad_transforms_json() {
    let cases: Vec<(&str, Vec<u8>, &[&str])> = vec![
        ("empty", vec![], &["transforms.json", "EOF"]),
        ("not UTF-8", vec![b'{', b'"', 0xff, b'"'], &["transforms.json:1", "expected"]),
        ("a list", b"[1, 2]".to_vec(), &["transforms.json", "frames"]),
        ("a string", b"\"frames\"".to_vec(), &["expected"]),
        ("cut", transforms(|_| ())[..60].to_vec(), &["transforms.json:1"]),
        ("deep", [&b"{\"a\": "[..], &b"[".repeat(100_000)].concat(), &["recursion"]),
        ("no frames", transforms(|v| v["frames"] = json!([])), &["at least one frame"]),
        ("frames of numbers", transforms(|v| v["frames"] = json!([1])), &["invalid type"]),
        (
            "a word in the matrix",
            transforms(|v| v["frames"][1]["transform_matrix"][0][0] = json!("x")),
            &["invalid type", "f64"],
        ),
        ("NaN", b"{\"fl_x\": NaN, \"frames\": []}".to_vec(), &["transforms.json", "one frame"]),
        (
            "out of range",
            b"{\"fl_x\": 1e999, \"frames\": []}".to_vec(),
            &["transforms.json:1", "out of range"],
        ),
        (
            "3x3 matrix",
            transforms(|v| {
                v["frames"][1]["transform_matrix"] = json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
            }),
            &["frame 1", "4x4", "[3, 3, 3]"],
        ),
        (
            "scaled pose",
            transforms(|v| v["frames"][2]["transform_matrix"][0][0] = json!(2.0)),
            &["frame 2", "rigid"],
        ),
        (
            "mirrored pose",
            transforms(|v| v["frames"][2]["transform_matrix"][0][0] = json!(-1.0)),
            &["frame 2", "determinant -1"],
        ),
        (
            "overflowing pose",
            transforms(|v| v["frames"][0]["transform_matrix"][0][3] = json!(1e300)),
            &["frame 0", "finite"],
        ),
        ("zero focal", transforms(|v| v["fl_x"] = json!(0)), &["frame 0", "fx > 0"]),
        (
            "no focal",
            transforms(|v| {
                v.as_object_mut().unwrap().remove("fl_x");
            }),
            &["frame 0", "fl_x"],
        ),
        (
            "angle of a turn",
            transforms(|v| {
                v.as_object_mut().unwrap().remove("fl_x");
                v["camera_angle_x"] = json!(6.3);
            }),
            &["camera_angle_x", "6.3"],
        ),
        (
            "unknown model",
            transforms(|v| v["camera_model"] = json!("ORTHOPHOTO")),
            &["ORTHOPHOTO", "OPENCV"],
        ),
        (
            "half a pixel",
            transforms(|v| {
                v["w"] = json!(64.5);
                v["h"] = json!(48);
            }),
            &["whole pixels", "64.5"],
        ),
        (
            "negative size",
            transforms(|v| {
                v["w"] = json!(-64);
                v["h"] = json!(48);
            }),
            &["whole pixels"],
        ),
        (
            "another shape",
            transforms(|v| {
                v["w"] = json!(48);
                v["h"] = json!(64);
            }),
            &["frame 0", "48x64", "64x48"],
        ),
        ("huge distortion", transforms(|v| v["k1"] = json!(1e308)), &[]),
        (
            "no picture",
            transforms(|v| {
                for f in v["frames"].as_array_mut().unwrap() {
                    f["file_path"] = json!("gone.png")
                }
            }),
            &["pictures on disk", "gone.png"],
        ),
        (
            "a folder as picture",
            transforms(|v| v["frames"][0]["file_path"] = json!("images")),
            &["directory"],
        ),
        (
            "an empty name",
            transforms(|v| {
                for f in v["frames"].as_array_mut().unwrap() {
                    f["file_path"] = json!("")
                }
            }),
            &["pictures on disk"],
        ),
    ];
    for (case, bytes, words) in cases {
        if case == "huge distortion" {
            // The scene loads; undoing the distortion fails.
            let (folder, _) = made_up(3);
            std::fs::write(folder.path().join("transforms.json"), bytes).unwrap();
            let scene = load_scene(folder.path()).unwrap();
            check(case, scene.frames[0].load().map(|_| ()), &["000.png", "distortion", "1e308"]);
            continue;
        }
        check(case, with("transforms.json", &bytes), words);
    }
}

#[test]
fn bad_cameras_json() {
    let cases: Vec<(&str, Vec<u8>, &[&str])> = vec![
        ("empty", vec![], &["cameras.json", "EOF"]),
        ("a number", b"7".to_vec(), &["cameras.json:1", "invalid type"]),
        ("a list of numbers", b"[7]".to_vec(), &["cameras.json:1", "3DGS"]),
        ("an empty list", b"[]".to_vec(), &["at least one frame"]),
        (
            "missing key",
            cameras_json(|v| {
                v["frames"][1].as_object_mut().unwrap().remove("fy");
            }),
            &["missing field `fy`"],
        ),
        ("null", cameras_json(|v| v["frames"][1]["fx"] = Value::Null), &["NaN, infinite"]),
        ("word", cameras_json(|v| v["frames"][1]["fx"] = json!("wide")), &["wide"]),
        (
            "three rows short",
            cameras_json(|v| v["frames"][1]["c2w"] = json!([[1, 0, 0, 0]])),
            &["frame 1", "[4]"],
        ),
        ("zero width", cameras_json(|v| v["frames"][2]["width"] = json!(0)), &["frame 2", "0x48"]),
        ("10^12 width", cameras_json(|v| v["frames"][2]["width"] = json!(1e12)), &["frame 2"]),
        (
            "negative focal",
            cameras_json(|v| v["frames"][2]["fy"] = json!(-5)),
            &["frame 2", "fy > 0"],
        ),
        (
            "sheared",
            cameras_json(|v| v["frames"][0]["c2w"][3][0] = json!(1)),
            &["frame 0", "rigid"],
        ),
    ];
    for (case, bytes, words) in cases {
        check(case, with("cameras.json", &bytes), words);
    }
}

const RE10K: &str = "https://a.b/c\n\
                     1000 1.1 1.4 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 0\n\
                     2000 1.1 1.4 .5 .5 0 0 1 0 0 1 0 1 0 0 0 0 1 0\n\
                     3000 1.1 1.4 .5 .5 0 0 1 0 0 2 0 1 0 0 0 0 1 0\n";

#[test]
fn bad_re10k_txt() {
    let cases: Vec<(&str, String, &[&str])> = vec![
        ("18 columns", RE10K.replace("2000 1.1 1.4", "1.1 1.4"), &["a.txt:3", "19 columns", "18"]),
        ("20 columns", RE10K.replace("2000 1.1 1.4", "2000 2 1.1 1.4"), &["a.txt:3", "20"]),
        ("a word", RE10K.replace("2000 1.1", "2000 wide"), &["a.txt:3", "`wide`"]),
        ("NaN", RE10K.replace("3000 1.1", "3000 NaN"), &["a.txt:4", "finite"]),
        ("infinite", RE10K.replace("3000 1.1", "3000 1e999"), &["a.txt:4", "finite"]),
        ("time stamp", RE10K.replace("2000 1.1", "2.5 1.1"), &["a.txt:3", "time stamp"]),
        ("zero focal", RE10K.replace("3000 1.1", "3000 0"), &["a.txt:4", "fx > 0"]),
        (
            "no inverse",
            RE10K.replace("0 1 0 0 0 0 1 0\n2", "0 0 0 0 0 0 1 0\n2"),
            &["a.txt:2", "inverse"],
        ),
        (
            "not rigid",
            RE10K.replace("0 1 0 0 0 0 1 0\n2", "0 9 0 0 0 0 1 0\n2"),
            &["a.txt:2", "rigid"],
        ),
        (
            "a line short",
            RE10K.lines().take(3).collect::<Vec<_>>().join("\n"),
            &["a.txt", "2 pictures", "3"],
        ),
        ("address alone", "https://a.b/c\n".into(), &["at least one camera"]),
        ("empty", String::new(), &["at least one camera"]),
    ];
    for (case, text, words) in cases {
        let (folder, _) = made_up(3);
        let path = folder.path().join("a.txt");
        std::fs::write(&path, text).unwrap();
        check(case, load(&path), words);
    }
    let (folder, _) = made_up(3);
    let path = folder.path().join("a.txt");
    std::fs::write(&path, b"https://a\n1 \xff").unwrap();
    check("not UTF-8", load(&path), &["a.txt", "UTF-8"]);
    let empty = tempfile::tempdir().unwrap();
    let path = empty.path().join("a.txt");
    std::fs::write(&path, RE10K).unwrap();
    check("no frames", load(&path), &["a.txt", "pictures in"]);
}

#[test]
fn bad_matrices() {
    let k = "70 0 32\n0 71 24\n0 0 1\n";
    let pose = "1 0 0 0 0 1 0 0 0 0 1 0\n";
    let nan = pose.replacen('1', "nan", 1);
    let (poses, two) = (pose.repeat(3), pose.repeat(2));
    let cases: Vec<(&str, &str, String, &[&str])> = vec![
        ("no numbers", "abc", poses.clone(), &["K.txt", "`abc`"]),
        ("five numbers", "1 2 3 4 5", poses.clone(), &["K.txt", "5 numbers"]),
        ("skew", "70 9 32 0 71 24 0 0 1", poses.clone(), &["K.txt", "skew"]),
        ("transposed", "70 0 0 0 71 0 32 24 1", poses.clone(), &["K.txt"]),
        ("zero focal", "0 71 32 24", poses.clone(), &["poses.txt:1", "fx > 0"]),
        ("11 numbers", k, "1 0 0 0 0 1 0 0 0 0 1\n".repeat(3), &["poses.txt:1", "11 numbers"]),
        ("two poses", k, two.clone(), &["poses.txt", "2 pictures", "3"]),
        ("nan", k, format!("{two}{nan}"), &["poses.txt:3", "finite"]),
        (
            "not rigid",
            k,
            format!("{pose}2 0 0 0 0 2 0 0 0 0 2 0\n{pose}"),
            &["poses.txt:2", "rigid"],
        ),
        ("empty", k, String::new(), &["poses.txt", "0 pictures"]),
    ];
    for (case, k, poses, words) in cases {
        let (folder, _) = made_up(3);
        std::fs::write(folder.path().join("K.txt"), k).unwrap();
        std::fs::write(folder.path().join("poses.txt"), poses).unwrap();
        check(case, load(folder.path()), words);
    }
    let (folder, _) = made_up(3);
    std::fs::write(folder.path().join("poses.txt"), poses).unwrap();
    check("no K.txt", load(folder.path()), &["K.txt", "intrinsics beside poses.txt"]);
}

#[test]
fn bad_pictures() {
    let (folder, cameras) = made_up(3);
    let path = folder.path().join("cameras.json");
    save_cameras_json(
        &path,
        &CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() },
    )
    .unwrap();
    let picture = folder.path().join("images/001.png");
    let good = std::fs::read(&picture).unwrap();

    // Headers that declare 60000 × 60000 pixels.
    let mut png = good[..33].to_vec();
    png[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]);
    let mut crc = flate2::Crc::new();
    crc.update(&png[12..29]);
    png[29..33].copy_from_slice(&crc.sum().to_be_bytes());
    png.extend(&good[33..]);
    let mut bmp = b"BM\0\0\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0".to_vec();
    bmp.extend(60000u32.to_le_bytes());
    bmp.extend(60000u32.to_le_bytes());
    bmp.extend([1, 0, 24, 0]);
    bmp.extend([0; 24]);
    let mut jpeg = vec![0xff, 0xd8, 0xff, 0xc0, 0, 17, 8, 0xea, 0x60, 0xea, 0x60, 3];
    jpeg.extend([
        1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0, 0xff, 0xda, 0, 12, 3, 1, 0, 2, 0, 3, 0, 0, 63, 0,
    ]);
    for (case, bytes, words) in [
        ("PNG bomb", png, &["001.png", "megapixels"][..]),
        ("BMP bomb", bmp, &["001.png", "megapixels"]),
        ("JPEG bomb", jpeg, &["001.png"]),
        ("zero bytes", vec![], &["001.png", "empty file"]),
        ("text", b"not a picture at all".to_vec(), &["001.png", "no known picture format"]),
        ("header alone", good[..20].to_vec(), &["001.png"]),
    ] {
        std::fs::write(&picture, bytes).unwrap();
        check(case, load(folder.path()), words);
        check(case, image::load(&picture).map(|_| ()), words);
    }
    // The header is complete, the pixels are not: loading the frame fails.
    std::fs::write(&picture, &good[..good.len() / 2]).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    check("half a PNG", scene.frames[1].load().map(|_| ()), &["001.png"]);
    // The size has changed since the scene was loaded.
    image::save_png(&picture, &noise::noise(48, 64)).unwrap();
    check("changed size", scene.frames[1].load().map(|_| ()), &["001.png", "64x48", "48x64"]);
    std::fs::remove_file(&picture).unwrap();
    check("gone", scene.frames[1].load().map(|_| ()), &["001.png", "No such file"]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 2);
    assert!(scene.warnings[0].contains("001.png"), "{:?}", scene.warnings);
    std::fs::create_dir(&picture).unwrap();
    check("a folder", load(folder.path()), &["001.png", "directory"]);
    check(
        "8-bit depth",
        image::load_depth_png(folder.path().join("images/000.png"), 0.001).map(|_| ()),
        &["16-bit grey"],
    );
}

#[test]
fn bad_paths() {
    let folder = tempfile::tempdir().unwrap();
    let at = |n: &str| folder.path().join(n);
    check("empty folder", load(folder.path()), &["cameras.json", "sparse/0", "none of them"]);
    check("nothing", load_scene(at("nowhere")).map(|_| ()), &["nowhere", "No such file"]);
    std::fs::write(at("a.ply"), "ply").unwrap();
    check("a .ply", load_scene(at("a.ply")).map(|_| ()), &["a.ply", "pose file", "`ply`"]);
    std::fs::write(at("a.bin"), "").unwrap();
    check("lone .bin", load_scene(at("a.bin")).map(|_| ()), &["cameras", "No such file"]);
}

#[test]
fn bad_protocols() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("p.json");
    for (case, text, words) in [
        ("empty", "", &["p.json", "EOF"][..]),
        ("list", "[1]", &["p.json:1"]),
        ("negative", r#"{"tests": [{"context": [-1], "target": []}]}"#, &["-1"]),
        ("word", r#"{"tests": [{"context": "all", "target": []}]}"#, &["all"]),
        ("fraction", r#"{"tests": [{"context": [0.5], "target": []}]}"#, &["0.5"]),
        ("no context", r#"{"tests": [{"context": [], "target": [1]}]}"#, &["test 0", "context"]),
    ] {
        std::fs::write(&path, text).unwrap();
        check(case, load_protocol(&path).map(|_| ()), words);
        let index = text.replace(r#""tests": ["#, r#""scene": "#).replace("}]}", "}}");
        std::fs::write(&path, index).unwrap();
        let words: Vec<&str> = words.iter().copied().filter(|w| *w != "test 0").collect();
        check(case, load_index(&path).map(|_| ()), &words);
    }
    std::fs::write(&path, r#"{"tests": [{"context": [0, 9], "target": [1]}]}"#).unwrap();
    let test = &load_protocol(&path).unwrap().tests[0];
    check("range", test.check(&path, 9), &["below 9", "got 9"]);
    test.check(&path, 10).unwrap();
}

/// The error of the first camera that is not read.
fn all_cameras(cameras: Cameras) -> Result<(), subsplat::files::Error> {
    cameras.into_values().collect::<Result<Vec<_>, _>>().map(|_| ())
}

/// An error of the first image without a pose.
fn all_poses(images: Vec<ColmapImage>) -> Result<(), subsplat::files::Error> {
    let refused = images.into_iter().find_map(|i| Some((i.place, i.refused?)));
    refused.map_or(Ok(()), |(place, got)| {
        Err(subsplat::files::Error::format("images", "a finite pose", got).at(place))
    })
}

type Parser = fn(&[u8]) -> Result<(), subsplat::files::Error>;

const BINARY: [(&str, Parser); 3] = [
    ("cameras", |b| all_cameras(parse_cameras_bin("cameras.bin", b)?)),
    ("images", |b| all_poses(parse_images_bin("images.bin", b)?)),
    ("points", |b| parse_points_bin("points3D.bin", b).map(|_| ())),
];

#[test]
fn colmap_binary_cut_at_every_byte() {
    let (_folder, cameras) = made_up(3);
    for ((case, parse), bytes) in BINARY.iter().zip(colmap_files::binary(&cameras)) {
        parse(&bytes).unwrap();
        for cut in 0..bytes.len() {
            let error = match parse(&bytes[..cut]) {
                Err(e) => e.to_string(),
                Ok(()) => panic!("{case}.bin cut at {cut} of {} was accepted", bytes.len()),
            };
            assert!(error.contains(".bin at byte"), "{case} {cut}: {error}");
        }
        let longer = [&bytes[..], &[0]].concat();
        check("one byte more", parse(&longer), &["at byte", "1 more bytes"]);
    }
}

#[test]
fn colmap_binary_with_hostile_fields() {
    let (_folder, cameras) = made_up(3);
    let files = colmap_files::binary(&cameras);
    let put = |file: usize, at: usize, value: &[u8]| {
        let mut bytes = files[file].clone();
        bytes[at..at + value.len()].copy_from_slice(value);
        bytes
    };
    let trillion = 1_000_000_000_000u64.to_le_bytes();
    let nan = f64::NAN.to_le_bytes();
    // Offsets follow the layouts in src/files/poses/colmap/binary.rs. The name of a picture has seven
    // letters and a terminator here.
    let observations = 8 + 4 + 56 + 4 + 8;
    let cases: Vec<(&str, usize, Vec<u8>, &[&str])> = vec![
        ("10^12 cameras", 0, put(0, 0, &trillion), &["at byte 0", "cameras", "1000000000000"]),
        ("2^64 - 1 cameras", 0, put(0, 0, &[0xff; 8]), &["at byte 0", "18446744073709551615"]),
        ("model 99", 0, put(0, 12, &99i32.to_le_bytes()), &["at byte 8", "OPENCV", "number 99"]),
        ("model -1", 0, put(0, 12, &(-1i32).to_le_bytes()), &["at byte 8", "4294967295"]),
        ("width 0", 0, put(0, 16, &[0; 8]), &["at byte 8", "0x48"]),
        ("width 10^12", 0, put(0, 16, &trillion), &["at byte 8", "1000000000000x48"]),
        ("NaN focal", 0, put(0, 32, &nan), &["at byte 8", "finite"]),
        ("id twice", 0, put(0, 8 + 88, &7u32.to_le_bytes()), &["at byte 96", "7 again"]),
        ("10^12 images", 1, put(1, 0, &trillion), &["at byte 0", "images"]),
        ("NaN quaternion", 1, put(1, 12, &nan), &["at byte 8", "finite pose"]),
        ("zero quaternion", 1, put(1, 12, &[0; 32]), &["at byte 8", "quaternion"]),
        ("infinite translation", 1, put(1, 44, &f64::INFINITY.to_le_bytes()), &["at byte 8"]),
        ("no name", 1, put(1, 72, &[0]), &["at byte 72", "empty"]),
        ("name not UTF-8", 1, put(1, 72, &[0xff]), &["at byte 72", "UTF-8"]),
        ("10^12 observations", 1, put(1, observations, &trillion), &["at byte 80", "observations"]),
        ("10^12 points", 2, put(2, 0, &trillion), &["at byte 0", "points"]),
        ("10^12 track", 2, put(2, 8 + 8 + 24 + 3 + 8, &trillion), &["at byte 51", "track"]),
    ];
    for (case, file, bytes, words) in cases {
        check(case, BINARY[file].1(&bytes), words);
    }
    let eucm = put(0, 12, &16i32.to_le_bytes());
    let mut eucm = eucm[..32 + 48].to_vec();
    eucm[..8].copy_from_slice(&1u64.to_le_bytes());
    check("EUCM model", BINARY[0].1(&eucm), &["SIMPLE_RADIAL", "got EUCM"]);
    // A camera that is missing in the cameras file.
    let (folder, _) = made_up(3);
    let images = put(1, 68, &55u32.to_le_bytes());
    let model = folder.path().join("sparse/0");
    colmap_files::write(&model, "bin", [&files[0], &images, &files[2]]);
    check("camera 55", load(folder.path()), &["images.bin at byte 8", "camera 55"]);
    std::fs::write(model.join("points3D.bin"), b"abc").unwrap();
    colmap_files::write(&model, "bin", [&files[0], &files[1], b"abc"]);
    check("bad points", load(folder.path()), &["points3D.bin at byte 0"]);
}

#[test]
fn bad_colmap_text() {
    let path = Path::new("x.txt");
    let cameras = |t: &str| all_cameras(parse_cameras_txt(path, t.as_bytes())?);
    let images = |t: &str| all_poses(parse_images_txt(path, t.as_bytes(), &mut Vec::new())?);
    let points = |t: &str| parse_points_txt(path, t.as_bytes()).map(|_| ());
    let cases: Vec<(&str, Result<(), subsplat::files::Error>, &[&str])> = vec![
        ("no cameras", cameras("# none\n"), &["x.txt", "at least one camera"]),
        ("id", cameras("\n\na PINHOLE 1 1 1 1 1 1"), &["x.txt:3", "camera id", "`a`"]),
        ("model", cameras("1 EUCM 6 4 1 1 1 1 1 1"), &["x.txt:1", "got EUCM"]),
        ("unknown model", cameras("1 LENS 6 4 1"), &["x.txt:1", "`LENS`"]),
        ("few parameters", cameras("1 PINHOLE 6 4 1 1 1"), &["4 parameters of PINHOLE", "got 3"]),
        ("many parameters", cameras("1 PINHOLE 6 4 1 1 1 1 1"), &["got 5"]),
        ("NaN", cameras("1 PINHOLE 6 4 nan 1 1 1"), &["finite"]),
        ("cut", cameras("1 PINHOLE 6"), &["height", "end of the line"]),
        ("negative", cameras("1 PINHOLE -6 4 1 1 1 1"), &["width", "`-6`"]),
        ("twice", cameras("1 SIMPLE_PINHOLE 6 4 1 1 1\n1 SIMPLE_PINHOLE 6 4 1 1 1"), &["x.txt:2"]),
        ("short pose", images("1 1 0 0 0 0 0 0"), &["x.txt:1", "camera id"]),
        ("no name", images("1 1 0 0 0 0 0 0 1"), &["picture name"]),
        ("zero quaternion", images("1 0 0 0 0 0 0 0 1 a.png"), &["quaternion [0.0, 0.0"]),
        ("NaN pose", images("1 1 0 0 0 0 NaN 0 1 a.png"), &["translation [0.0, NaN"]),
        ("NaN of C", images("1 1 0 0 0 0 -nan(ind) 0 1 a.png"), &["translation [0.0, NaN"]),
        ("odd points", images("1 1 0 0 0 0 0 0 1 a.png\n1 2 3 4\n"), &["x.txt:2", "triples"]),
        ("short point", points("1 2 3"), &["x.txt:1", "position"]),
    ];
    for (case, result, words) in cases {
        check(case, result, words);
    }
    let bytes = b"# a\n# b\n1 PINHOLE \xff";
    check("not UTF-8", parse_cameras_txt(path, bytes).map(|_| ()), &["x.txt:3", "UTF-8"]);
}

/// Random numbers for the mutations; SplitMix64.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        (random::next(&mut self.0) % n as u64) as usize
    }

    /// Applies one to four changes: a flipped bit, another byte, a run of ones, a removed piece, a
    /// repeated piece.
    fn mutate(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = bytes.to_vec();
        for _ in 0..=self.below(4) {
            if out.is_empty() {
                break;
            }
            let at = self.below(out.len());
            let end = (at + 1 + self.below(24)).min(out.len());
            match self.below(5) {
                0 => out[at] ^= 1 << self.below(8),
                1 => out[at] = self.below(256) as u8,
                2 => out[at..end].fill(0xff),
                3 => drop(out.drain(at..end)),
                _ => {
                    let piece = out[at..end].to_vec();
                    out.splice(at..at, piece);
                }
            }
        }
        out
    }
}

#[test]
fn parsers_accept_or_refuse_mutated_files() {
    let (_folder, cameras) = made_up(3);
    let mut random = Random(1);
    let (mut refused, mut accepted) = (0, 0);
    let mut count = |ok: bool| if ok { accepted += 1 } else { refused += 1 };
    for ((_, parse), bytes) in BINARY.iter().zip(colmap_files::binary(&cameras)) {
        for _ in 0..20_000 {
            count(parse(&random.mutate(&bytes)).is_ok());
        }
    }
    let text = colmap_files::text(&cameras);
    let path = Path::new("x");
    for _ in 0..5_000 {
        count(parse_cameras_txt(path, &random.mutate(text[0].as_bytes())).is_ok());
        let bytes = random.mutate(text[1].as_bytes());
        count(parse_images_txt(path, &bytes, &mut Vec::new()).is_ok());
        count(parse_points_txt(path, &random.mutate(text[2].as_bytes())).is_ok());
        count(re10k::parse(path, &random.mutate(RE10K.as_bytes()), &mut Vec::new()).is_ok());
    }
    // The mutations must cause both outcomes.
    assert!(refused > 10_000 && accepted > 10_000, "{refused} {accepted}");
}

#[test]
fn mutated_scenes_are_accepted_or_refused() {
    let (folder, cameras) = made_up(2);
    let mut random = Random(2);
    let files = colmap_files::binary(&cameras);
    colmap_files::write(folder.path(), "bin", [&files[0], &files[1], &files[2]]);
    let sources: Vec<(&str, Vec<u8>)> = vec![
        ("transforms.json", transforms(|_| ())),
        ("cameras.json", cameras_json(|_| ())),
        ("a.txt", RE10K.as_bytes().to_vec()),
        ("images.bin", files[1].clone()),
        ("cameras.bin", files[0].clone()),
    ];
    for (name, bytes) in sources {
        let begun = std::time::Instant::now();
        let path = folder.path().join(name);
        let (mut refused, mut accepted) = (0, 0);
        for _ in 0..200 {
            std::fs::write(&path, random.mutate(&bytes)).unwrap();
            match load_scene(&path) {
                Ok(scene) => {
                    accepted += 1;
                    for f in &scene.frames {
                        let k = f.camera.intrinsics();
                        assert_eq!(
                            subsplat_kernels::camera::Camera::new(k, f.camera.world_from_camera()),
                            Ok(f.camera)
                        );
                        let _ = f.pinhole();
                    }
                }
                Err(_) => refused += 1,
            }
        }
        std::fs::write(&path, &bytes).unwrap();
        eprintln!("{name}: {accepted} accepted, {refused} refused, {:?}", begun.elapsed());
        assert!(refused > 20, "{name}");
    }
    for bytes in [&b"{\"tests\": [{\"context\": [0, 1], \"target\": [2]}]}"[..]] {
        let path = folder.path().join("p.json");
        for _ in 0..200 {
            std::fs::write(&path, random.mutate(bytes)).unwrap();
            let _ = load_protocol(&path);
            let _ = load_index(&path);
        }
    }
    // Pictures too: the decoders are external, but the size limits belong to this crate.
    let picture = folder.path().join("images/000.png");
    let bytes = std::fs::read(&picture).unwrap();
    for _ in 0..200 {
        std::fs::write(&picture, random.mutate(&bytes)).unwrap();
        let _ = image::load(&picture);
    }
}
