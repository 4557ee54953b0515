//! Options of a scene's reading: which cameras, which pictures, and what is an error.

use subsplat_test_support::colmap_files;
use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use std::path::Path;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::files::poses::colmap::parse_cameras_txt;
use subsplat::files::poses::scene::{Scene, SceneFormat, load_cameras_with, load_scene};
use subsplat::{SceneOptions, load_scene_with};

fn write_model(folder: &Path, cameras: &[NamedCamera]) {
    let files = colmap_files::text(cameras);
    colmap_files::write(folder, "txt", [0, 1, 2].map(|i| files[i].as_bytes()));
}

fn save(path: &Path, cameras: &[NamedCamera]) {
    let content = CameraFile { cameras: cameras.to_vec(), ..Default::default() };
    save_cameras_json(path, &content).unwrap();
}

fn names(scene: &Scene) -> Vec<&str> {
    scene.frames.iter().map(|f| f.name.as_str()).collect()
}

fn strict() -> SceneOptions {
    SceneOptions { strict: true, ..SceneOptions::default() }
}

#[test]
fn a_model_is_chosen() {
    let (folder, cameras) = made_up(5);
    write_model(&folder.path().join("sparse/0"), &cameras);
    write_model(&folder.path().join("sparse/1"), &cameras[..2]);
    save(&folder.path().join("three.json"), &cameras[..3]);
    let with = |model: &Path| {
        let options = SceneOptions { model: Some(model.to_owned()), ..SceneOptions::default() };
        load_scene_with(folder.path(), &options)
    };
    assert_eq!(load_scene(folder.path()).unwrap().frames.len(), 5);
    for (model, count) in
        [("sparse/1", 2), ("sparse/1/images.txt", 2), ("three.json", 3), ("sparse", 5)]
    {
        let scene = with(Path::new(model)).unwrap();
        assert_eq!(scene.frames.len(), count, "{model}");
        assert!(scene.frames.iter().all(|f| f.image.starts_with(folder.path())));
    }
    // Elsewhere: the pictures are still those of the scene.
    let other = tempfile::tempdir().unwrap();
    write_model(&other.path().join("again"), &cameras[3..]);
    let scene = with(&other.path().join("again")).unwrap();
    assert_eq!(names(&scene), ["003", "004"]);
    assert_eq!(scene.frames[0].image, folder.path().join("images/003.png"));
    let missing = with(Path::new("sparse/9")).unwrap_err().to_string();
    assert!(missing.contains("sparse/9"), "{missing}");
    let empty = with(Path::new("images")).unwrap_err().to_string();
    assert!(empty.contains("COLMAP"), "{empty}");
    // Cameras alone.
    let options = SceneOptions { model: Some("sparse/1".into()), ..SceneOptions::default() };
    assert_eq!(load_cameras_with(folder.path(), &options).unwrap().frames.len(), 2);
}

#[test]
fn pictures_are_taken_from_a_folder() {
    let (folder, mut cameras) = made_up(3);
    cameras[2].file = "right/000.png".to_owned();
    save(&folder.path().join("cameras.json"), &cameras);
    let other = tempfile::tempdir().unwrap();
    let images = other.path().join("undistorted");
    std::fs::create_dir(&images).unwrap();
    for name in ["000.png", "001.png"] {
        save_png(images.join(name), &noise(32, 24)).unwrap();
    }
    let options = SceneOptions { images: Some(images.clone()), ..SceneOptions::default() };
    let scene = load_scene_with(folder.path(), &options).unwrap();
    // Two entries do not find one picture by a part of their paths.
    assert_eq!(names(&scene), ["000", "001"]);
    assert_eq!(scene.frames[0].image, images.join("000.png"));
    assert_eq!(scene.frames[0].camera.intrinsics().width, 32);
    assert_eq!(scene.left_out[0].name, "right/000.png");
    std::fs::create_dir(images.join("right")).unwrap();
    save_png(images.join("right/000.png"), &noise(32, 24)).unwrap();
    let scene = load_scene_with(folder.path(), &options).unwrap();
    assert_eq!(scene.frames[2].image, images.join("right/000.png"));
    let none = SceneOptions { images: Some(images.join("none")), ..SceneOptions::default() };
    let error = load_scene_with(folder.path(), &none).unwrap_err().to_string();
    assert!(error.contains("a folder of pictures"), "{error}");
}

#[test]
fn strict_reading_refuses_what_is_left_out() {
    let (folder, cameras) = made_up(5);
    write_model(&folder.path().join("sparse/0"), &cameras);
    assert_eq!(
        load_scene_with(folder.path(), &strict()).unwrap(),
        load_scene(folder.path()).unwrap()
    );
    let error = || load_scene_with(folder.path(), &strict()).unwrap_err().to_string();
    // A mask that does not fit.
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    for i in 0..4 {
        let white = subsplat::Rgb { data: vec![255; 64 * 48 * 3], width: 64, height: 48 };
        save_png(folder.path().join(format!("masks/00{i}.png.png")), &white).unwrap();
    }
    assert!(error().contains("the first is 004.png (a mask"), "{}", error());
    save_png(folder.path().join("masks/004.png.png"), &noise(48, 64)).unwrap();
    assert!(error().contains("1 that are not used: the first is 004.png (a mask"), "{}", error());
    std::fs::remove_dir_all(folder.path().join("masks")).unwrap();
    // One picture is missing, one is empty, one has another shape.
    std::fs::remove_file(folder.path().join("images/001.png")).unwrap();
    std::fs::write(folder.path().join("images/002.png"), b"").unwrap();
    save_png(folder.path().join("images/003.png"), &noise(48, 64)).unwrap();
    let line = "expected all of 5 entries with their pictures and masks (strict), got 3 that are not used: the \
                first is 001.png (no picture on disk)";
    assert!(error().contains(line), "{}", error());
    // Numbers of entries stay.
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.iter().map(|f| f.entry).collect::<Vec<_>>(), [0, 3, 4]);
    assert_eq!(scene.left_out.iter().map(|l| l.entry).collect::<Vec<_>>(), [1, 2, 3]);
    assert_eq!(
        (scene.entries(), scene.frame_of_entry(4), scene.frame_of_entry(1)),
        (5, Some(2), None)
    );
    assert_eq!(scene.usable(), [0, 2]);
}

/// Points without a position, in both forms of COLMAP's model.
#[test]
fn points_that_are_no_numbers_are_left_out() {
    let (folder, cameras) = made_up(3);
    let model = folder.path().join("sparse/0");
    let text = colmap_files::text(&cameras);
    let mut binary = colmap_files::binary(&cameras);
    // The second point's x: 8 bytes of the count, one record of 59 + 8 bytes, an id.
    let at = 8 + (8 + 24 + 3 + 8 + 8 + 8) + 8;
    binary[2][at..at + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    colmap_files::write(&model, "bin", [0, 1, 2].map(|i| &binary[i][..]));
    let from_binary = load_scene(folder.path()).unwrap();
    let strictly = load_scene_with(folder.path(), &strict()).unwrap_err().to_string();
    assert!(strictly.contains("1 of 40 that are not: point 1001"), "{strictly}");
    std::fs::remove_dir_all(&model).unwrap();
    let points = text[2].replacen("1001 0.1", "1001 -nan(ind)", 1);
    assert_ne!(points, text[2]);
    let files = [text[0].as_bytes(), text[1].as_bytes(), points.as_bytes()];
    colmap_files::write(&model, "txt", files);
    let from_text = load_scene(folder.path()).unwrap();
    for scene in [&from_binary, &from_text] {
        let points = scene.points.as_ref().unwrap();
        assert_eq!(points.len(), 39);
        assert!((points[1].x - 0.2).abs() < 1e-6, "{}", points[1]);
        // Frame 1 sees the points 1000 and 1002.
        assert_eq!(scene.frames[1].visible, [0, 1]);
        assert_eq!(scene.frames[0].visible, [0]);
        assert!(scene.warnings[0].contains("1 of 40 points have no finite position"));
    }
}

/// PowerShell's `>` writes UTF-16.
#[test]
fn pose_files_in_utf_16_are_read() {
    let (folder, cameras) = made_up(3);
    let path = folder.path().join("cameras.json");
    save(&path, &cameras);
    let plain = load_scene(folder.path()).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let units = std::iter::once(0xfeff).chain(text.encode_utf16());
    let bytes: Vec<u8> = units.flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, bytes).unwrap();
    assert_eq!(load_scene(folder.path()).unwrap().frames, plain.frames);
    // A list of 3DGS with UTF-8's mark.
    let list = "\u{feff}[{\"img_name\": \"images/000.png\", \"width\": 64, \"height\": 48, \"fx\": 70, \
                \"fy\": 70, \"rotation\": [[1,0,0],[0,1,0],[0,0,1]], \"position\": [0,0,0]}]";
    std::fs::write(&path, list).unwrap();
    assert_eq!(names(&load_scene(folder.path()).unwrap()), ["000"]);
}

/// The same of text files.
#[test]
fn text_files_in_utf_16_are_read() {
    let (folder, cameras) = made_up(3);
    let at = |name: &str| folder.path().join(name);
    write_model(&at("sparse/0"), &cameras);
    let rewrite = |files: &[&str]| {
        for file in files {
            let text = std::fs::read_to_string(at(file)).unwrap();
            let units: Vec<u16> = std::iter::once(0xfeff).chain(text.encode_utf16()).collect();
            let bytes: Vec<u8> = units.into_iter().flat_map(u16::to_be_bytes).collect();
            std::fs::write(at(file), bytes).unwrap();
        }
    };
    let model = ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"];
    let plain = load_scene(folder.path()).unwrap();
    rewrite(&model);
    assert_eq!(load_scene(folder.path()).unwrap(), plain);
    // UTF-8's mark, and bytes that are neither.
    let text = "\u{feff}# Cameras\n1 PINHOLE 64 48 70 70 32 24\n";
    assert_eq!(parse_cameras_txt("cameras.txt", text.as_bytes()).unwrap().len(), 1);
    let error = parse_cameras_txt("cameras.txt", b"1 PINHOLE\n\xff\n").unwrap_err().to_string();
    assert!(error.contains("cameras.txt:2") && error.contains("UTF-8"), "{error}");
    std::fs::remove_dir_all(at("sparse")).unwrap();
    // Plain matrices.
    let poses: Vec<String> = (0..3).map(|i| format!("1 0 0 {i} 0 1 0 0 0 0 1 0")).collect();
    std::fs::write(at("poses.txt"), poses.join("\r\n")).unwrap();
    std::fs::write(at("K.txt"), "70 70 32 24").unwrap();
    let plain = load_scene(folder.path()).unwrap();
    rewrite(&["poses.txt", "K.txt"]);
    assert_eq!(load_scene(folder.path()).unwrap(), plain);
    std::fs::remove_file(at("poses.txt")).unwrap();
    // RealEstate10K.
    let line = |i: usize| format!("{i} 0.9 1.2 0.5 0.5 0 0 1 0 0 {i} 0 1 0 0 0 0 1 0");
    let text = format!("https://example.org/a\n{}\n{}\n{}\n", line(0), line(1), line(2));
    std::fs::write(at("a.txt"), text).unwrap();
    let plain = load_scene(folder.path()).unwrap();
    assert_eq!((plain.source, plain.frames.len()), (SceneFormat::RealEstate10k, 3));
    rewrite(&["a.txt"]);
    assert_eq!(load_scene(folder.path()).unwrap(), plain);
}

/// Masks of cameras.json are written and read back.
#[test]
fn masks_of_cameras_json_are_kept() {
    let (folder, mut cameras) = made_up(2);
    std::fs::create_dir(folder.path().join("keep")).unwrap();
    let mut mask = subsplat::Rgb::black(64, 48);
    mask.data[..64 * 24 * 3].fill(255);
    save_png(folder.path().join("keep/0.png"), &mask).unwrap();
    cameras[0].mask = Some("keep/0.png".to_owned());
    save(&folder.path().join("cameras.json"), &cameras);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames[0].mask, Some(folder.path().join("keep/0.png")));
    assert_eq!(scene.frames[1].mask, None);
    let loaded = scene.frames[0].load_with(&subsplat::LoadOptions::default()).unwrap();
    assert_eq!(loaded.mask.unwrap().count(), 64 * 24);
}
