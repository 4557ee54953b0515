//! Which source of cameras of a folder is read, what is said of the others, and cameras that need a correction.

use crate::as_people_have_them::{write_text, write_transforms};
use crate::foreign_cameras::refused;
use subsplat_test_support::colmap_files;
use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use serde_json::{Value, json};
use std::path::Path;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat::files::poses::scene::{Scene, SceneFormat, load_scene};
use subsplat::{SceneOptions, load_scene_with};

fn missing(name: &str) -> String {
    name.replace("images/", "gone/x")
}

#[track_caller]
fn has_line(scene: &Scene, words: &[&str]) {
    let has = |line: &String| words.iter().all(|word| line.contains(word));
    assert!(scene.warnings.iter().any(has), "{words:?} {:?}", scene.warnings);
}

#[test]
fn a_source_that_cannot_be_read_gives_way_to_the_next() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    write_text(&at("sparse/0"), &cameras);
    write_transforms(&at("transforms.json"), &cameras, str::to_owned);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(
        (scene.source, &scene.other_sources[..]),
        (SceneFormat::Transforms, &["sparse/0".to_owned()][..])
    );
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);

    write_transforms(&at("transforms.json"), &cameras, missing);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!((scene.source, scene.frames.len()), (SceneFormat::Colmap, 4));
    assert!(scene.other_sources.is_empty());
    has_line(&scene, &["transforms.json is not used", "pictures on disk"]);
    has_line(&scene, &["the cameras come from sparse/0"]);

    std::fs::write(at("transforms.json"), b"{\"frames\": [").unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.source, SceneFormat::Colmap);
    has_line(&scene, &["transforms.json is not used", "EOF"]);

    // A source that a person names, and a strict reading.
    let model = Some("transforms.json".into());
    let named = SceneOptions { model, ..SceneOptions::default() };
    refused("named", load_scene_with(folder.path(), &named), &["transforms.json", "EOF"]);
    let strict = SceneOptions { strict: true, ..SceneOptions::default() };
    refused("strict", load_scene_with(folder.path(), &strict), &["transforms.json", "EOF"]);
    // Nothing is left.
    std::fs::remove_dir_all(at("images")).unwrap();
    refused("none", load_scene(folder.path()), &["transforms.json", "EOF"]);
}

/// `colmap automatic_reconstructor` has the pictures that belong to `dense/0/sparse` in `dense/0/images`.
#[test]
fn the_dense_folder_of_colmap_is_found() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    write_text(&at("sparse/0"), &cameras);
    write_text(&at("dense/0/sparse"), &cameras);
    std::fs::rename(at("images"), at("dense/0/images")).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 4);
    assert_eq!(scene.frames[0].image, at("dense/0/images/000.png"));
}

#[test]
fn a_model_as_text_beside_a_binary_one_is_a_source() {
    let (folder, cameras) = made_up(4);
    let model = folder.path().join("sparse/0");
    write_text(&model, &cameras);
    let files = colmap_files::binary(&cameras[..3]);
    colmap_files::write(&model, "bin", [0, 1, 2].map(|i| &files[i][..]));
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 3);
    assert_eq!(scene.other_sources, ["sparse/0/images.txt"]);
    has_line(&scene, &["sparse/0/images.txt (4 cameras)"]);
    let model = Some(scene.other_sources[0].clone().into());
    let options = SceneOptions { model, ..SceneOptions::default() };
    assert_eq!(load_scene_with(folder.path(), &options).unwrap().frames.len(), 4);
}

#[test]
fn an_image_of_an_unknown_camera_is_left_out() {
    let (folder, cameras) = made_up(4);
    let [lenses, poses, points] = colmap_files::text(&cameras);
    // The camera of 001.png.
    let lenses = lenses.replace("\n8 OPENCV", "\n80 OPENCV");
    let model = folder.path().join("sparse/0");
    colmap_files::write(&model, "txt", [lenses.as_bytes(), poses.as_bytes(), points.as_bytes()]);
    let scene = load_scene(folder.path()).unwrap();
    let read: Vec<usize> = scene.frames.iter().map(|f| f.entry).collect();
    assert_eq!(read, [0, 2, 3]);
    assert_eq!((scene.left_out.len(), scene.left_out[0].name.as_str()), (1, "001.png"));
    assert!(scene.left_out[0].reason.contains("camera 8"), "{:?}", scene.left_out);
    let strict = SceneOptions { strict: true, ..SceneOptions::default() };
    refused("strict", load_scene_with(folder.path(), &strict), &["001.png", "camera 8"]);
}

#[test]
fn pictures_without_a_camera_are_counted() {
    let (folder, cameras) = made_up(6);
    let at = |name: &str| folder.path().join(name);
    let some: Vec<NamedCamera> = [0, 2, 4].map(|i| cameras[i].clone()).into();
    write_transforms(&at("transforms.json"), &some, str::to_owned);
    let line =
        "3 of 6 pictures in images/ have no camera in transforms.json: 001.png, 003.png, 005.png";
    assert_eq!(load_scene(folder.path()).unwrap().warnings, [line]);
    std::fs::remove_file(at("transforms.json")).unwrap();
    write_text(&at("sparse/0"), &some);
    let line = line.replace("transforms.json", "sparse/0");
    assert_eq!(load_scene(folder.path()).unwrap().warnings, [line]);
    // Masks, depth maps and copies in another format are no photographs of their own.
    for (i, name) in [(1, "000_depth.png"), (3, "mask_002.png"), (5, "004.bmp")] {
        std::fs::rename(at(&cameras[i].file), at("images").join(name)).unwrap();
    }
    let scene = load_scene(folder.path()).unwrap();
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    // A picture that cannot be read has a line of its own.
    std::fs::write(at("images/004.png"), b"").unwrap();
    std::fs::remove_file(at("images/004.bmp")).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert!(
        scene.warnings.len() == 1 && scene.warnings[0].contains("left out"),
        "{:?}",
        scene.warnings
    );
}

#[test]
fn folders_of_masks_have_several_names() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    write_transforms(&at("transforms.json"), &cameras, str::to_owned);
    for name in ["masks_2", "mask", "masks"] {
        std::fs::create_dir(at(name)).unwrap();
        for i in 0..4 {
            save_png(at(name).join(format!("00{i}.png")), &noise(64, 48)).unwrap();
        }
        let scene = load_scene(folder.path()).unwrap();
        // Each of these goes before those of the turns before it.
        let masks = scene.frames.iter().map(|frame| frame.mask.clone().unwrap());
        assert!(masks.into_iter().all(|mask| mask.parent() == Some(&at(name))), "{name}");
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    }
}

/// A transforms.json whose matrices are changed.
fn write_changed(path: &Path, cameras: &[NamedCamera], change: impl Fn(usize, &mut Value)) {
    write_transforms(path, cameras, str::to_owned);
    let mut file: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let frames = file["frames"].as_array_mut().unwrap();
    frames.iter_mut().enumerate().for_each(|(i, f)| change(i, &mut f["transform_matrix"]));
    std::fs::write(path, file.to_string()).unwrap();
}

fn scaled(matrix: &mut Value, scale: f64) {
    for i in 0..9 {
        let (row, column) = (i / 3, i % 3);
        matrix[row][column] = json!(matrix[row][column].as_f64().unwrap() * scale);
    }
}

#[test]
fn a_scale_that_all_matrices_share_is_divided_out() {
    let (folder, cameras) = made_up(4);
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &cameras, str::to_owned);
    let plain = load_scene(folder.path()).unwrap();
    write_changed(&path, &cameras, |_, matrix| scaled(matrix, 0.33));
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.warnings.len(), 1, "{:?}", scene.warnings);
    has_line(&scene, &["all 4 matrices", "0.33"]);
    for (a, b) in plain.frames.iter().zip(&scene.frames) {
        let (a, b) = (a.camera.world_from_camera(), b.camera.world_from_camera());
        let off = (a - b).to_cols_array().into_iter().fold(0f32, |m, v| m.max(v.abs()));
        assert!(off < 1e-6, "{a} {b}");
        assert_eq!(a.w_axis, b.w_axis);
    }
    // Another scale in each: no common world.
    write_changed(&path, &cameras, |i, matrix| scaled(matrix, 0.33 + 0.1 * i as f64));
    refused("scales", load_scene(folder.path()), &["rigid"]);
    // One that is not scaled.
    write_changed(&path, &cameras, |i, matrix| scaled(matrix, if i == 0 { 1.0 } else { 0.33 }));
    refused("one", load_scene(folder.path()), &["rigid"]);
}

#[test]
fn a_mirrored_world_is_named() {
    let (folder, cameras) = made_up(4);
    let path = folder.path().join("transforms.json");
    let mirror = |matrix: &mut Value, row: usize| {
        for column in 0..4 {
            matrix[row][column] = json!(-matrix[row][column].as_f64().unwrap());
        }
    };
    write_changed(&path, &cameras, |_, matrix| mirror(matrix, 0));
    let words = ["right-handed", "left-handed", "4 matrices", "transforms.json", "negate one axis"];
    refused("mirrored", load_scene(folder.path()), &words);
    write_changed(&path, &cameras, |_, matrix| {
        mirror(matrix, 0);
        mirror(matrix, 2);
    });
    assert_eq!(load_scene(folder.path()).unwrap().frames.len(), 4);
    // Some of them are wrong, not the world.
    write_changed(&path, &cameras, |i, matrix| {
        if i == 1 {
            mirror(matrix, 1);
        }
    });
    let scene = load_scene(folder.path()).unwrap();
    assert!(scene.frames.len() == 3 && scene.left_out[0].reason.contains("determinant"));
}

/// The names of other sources are those that `model` reads again.
#[test]
fn other_sources_are_read_by_their_names() {
    let (folder, cameras) = made_up(3);
    let at = |name: &str| folder.path().join(name);
    write_transforms(&at("transforms.json"), &cameras, str::to_owned);
    std::fs::create_dir_all(at("pose")).unwrap();
    std::fs::create_dir_all(at("keyframes/cameras")).unwrap();
    std::fs::create_dir_all(at("keyframes/images")).unwrap();
    let mut poses = String::new();
    for (i, c) in cameras.iter().enumerate() {
        let rows = c.camera.world_from_camera().transpose().to_cols_array();
        let line = rows.map(|v| v.to_string()).join(" ");
        std::fs::write(at(&format!("pose/{i:03}.txt")), &line).unwrap();
        poses += &format!("{line}\n");
        let frame = json!({
            "cameraPoseARFrame": rows, "intrinsics": [70, 0, 32, 0, 70, 24, 0, 0, 1]
        });
        std::fs::write(at(&format!("frame_{i:05}.json")), frame.to_string()).unwrap();
        save_png(at(&format!("frame_{i:05}.png")), &noise(64, 48)).unwrap();
        let mut key_frame =
            json!({ "fx": 70, "fy": 70, "cx": 32, "cy": 24, "width": 64, "height": 48 });
        for (j, v) in rows[..12].iter().enumerate() {
            key_frame[format!("t_{}{}", j / 4, j % 4)] = json!(v);
        }
        let file = format!("keyframes/cameras/{i}.json");
        std::fs::write(at(&file), key_frame.to_string()).unwrap();
        save_png(at(&format!("keyframes/images/{i}.png")), &noise(64, 48)).unwrap();
    }
    std::fs::write(at("intrinsics.txt"), "70 0 32 0 70 24 0 0 1").unwrap();
    std::fs::write(at("poses.txt"), &poses).unwrap();
    std::fs::write(at("K.txt"), "70 70 32 24").unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.source, SceneFormat::Transforms);
    let expected = [
        ("poses.txt", SceneFormat::Matrices),
        ("keyframes", SceneFormat::Polycam),
        ("frame_00000.json", SceneFormat::ScannerApp),
        ("pose/000.txt", SceneFormat::MatrixFiles),
    ];
    assert_eq!(scene.other_sources, expected.map(|(name, _)| name));
    for (name, format) in expected {
        let options = SceneOptions { model: Some(name.into()), ..SceneOptions::default() };
        let read = load_scene_with(folder.path(), &options).unwrap();
        assert_eq!((read.source, read.frames.len()), (format, 3), "{name}");
    }
    // KITTI has its intrinsics elsewhere.
    std::fs::remove_file(at("K.txt")).unwrap();
    let options = SceneOptions { model: Some("poses.txt".into()), ..SceneOptions::default() };
    refused("K.txt", load_scene_with(folder.path(), &options), &["intrinsics beside", "got none"]);
    std::fs::write(at("calib.txt"), "P0: 70 0 32 0 0 70 24 0 0 0 1 0").unwrap();
    refused("KITTI", load_scene_with(folder.path(), &options), &["KITTI's", "line P0"]);
}
