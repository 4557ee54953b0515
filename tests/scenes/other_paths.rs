//! Pictures whose paths differ from those of the pose file: folders of another machine, folders that are missing or
//! too many, other extensions.

use crate::as_people_have_them::{write_text, write_transforms};
use crate::foreign_cameras::{bundle, opensfm, plain, write};
use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use serde_json::json;
use std::path::{Path, PathBuf};
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::{SceneOptions, load_scene_with};

/// Path of picture `i` in a pose file.
type Named = fn(usize) -> String;

/// The cameras with other paths.
fn renamed(cameras: &[NamedCamera], name: impl Fn(usize) -> String) -> Vec<NamedCamera> {
    let all = cameras.iter().enumerate();
    all.map(|(i, camera)| NamedCamera { file: name(i), ..camera.clone() }).collect()
}

/// Checks that the frames have the pictures `folder/00i.png`, and their names.
#[track_caller]
fn check(scene: &Scene, folder: &Path, names: Named) {
    let images: Vec<PathBuf> = scene.frames.iter().map(|f| f.image.clone()).collect();
    let expected: Vec<PathBuf> = (0..4).map(|i| folder.join(format!("00{i}.png"))).collect();
    assert_eq!(images, expected, "{:?}", scene.warnings);
    for (i, frame) in scene.frames.iter().enumerate() {
        assert_eq!(frame.name, names(i));
    }
    assert!(scene.left_out.is_empty());
}

fn plain_name(i: usize) -> String {
    format!("00{i}")
}

#[test]
fn folders_of_another_machine_are_ignored() {
    let windows = |i: usize| format!("C:\\Users\\me\\scan\\images\\00{i}.png");
    let camera = |i: usize| format!("cam0/00{i}.png");
    let home = |i: usize| format!("/home/nobody/scan/00{i}.png");
    for name in [windows as Named, camera as Named, home as Named] {
        let (folder, cameras) = plain(4);
        let at = |name: &str| folder.path().join(name);
        let cameras = renamed(&cameras, name);
        write_text(&at("sparse/0"), &cameras);
        check(&load_scene(folder.path()).unwrap(), &at("images"), plain_name);
        std::fs::remove_dir_all(at("sparse")).unwrap();

        write_transforms(&at("transforms.json"), &cameras, str::to_owned);
        check(&load_scene(folder.path()).unwrap(), &at("images"), plain_name);
        std::fs::remove_file(at("transforms.json")).unwrap();

        write(&at("reconstruction.json"), json!([opensfm(&cameras)]).to_string());
        check(&load_scene(folder.path()).unwrap(), &at("images"), plain_name);
        std::fs::remove_file(at("reconstruction.json")).unwrap();

        write(&at("bundle/bundle.out"), bundle(&cameras));
        write(&at("list.txt"), (0..4).map(|i| name(i) + "\n").collect::<String>());
        check(&load_scene(folder.path()).unwrap(), &at("images"), plain_name);
    }
}

#[test]
fn pictures_in_a_folder_that_the_file_lacks_are_found() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    std::fs::rename(at("images"), at("cam0")).unwrap();
    std::fs::create_dir(at("images")).unwrap();
    std::fs::rename(at("cam0"), at("images/cam0")).unwrap();
    write_text(&at("sparse/0"), &cameras);
    let inner = |i: usize| format!("cam0/00{i}");
    check(&load_scene(folder.path()).unwrap(), &at("images/cam0"), inner);
    // The folder of the pictures alone, for a file elsewhere.
    let other = tempfile::tempdir().unwrap();
    write_text(&other.path().join("sparse/0"), &cameras);
    let options = SceneOptions { images: Some(at("images")), ..SceneOptions::default() };
    check(&load_scene_with(other.path(), &options).unwrap(), &at("images/cam0"), inner);
    let error = load_scene(other.path()).unwrap_err().to_string();
    for words in ["pictures on disk", "000.png", "--images", &other.path().display().to_string()] {
        assert!(error.contains(words), "{error}");
    }
    // Two pictures of one name: neither.
    std::fs::create_dir(at("images/cam1")).unwrap();
    save_png(at("images/cam1/000.png"), &noise(64, 48)).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    let left: Vec<&str> = scene.left_out.iter().map(|left| left.name.as_str()).collect();
    assert_eq!((scene.frames.len(), left), (3, vec!["000.png"]));
}

#[test]
fn a_picture_that_two_entries_may_mean_is_given_to_neither() {
    let (folder, cameras) = made_up(4);
    let names = ["left/000.png", "right/000.png", "left/002.png", "images/003.png"];
    let cameras = renamed(&cameras, |i| names[i].to_owned());
    write_transforms(&folder.path().join("transforms.json"), &cameras, str::to_owned);
    let scene = load_scene(folder.path()).unwrap();
    let read: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(read, ["002", "003"]);
    // One of them has the whole path.
    let names = ["left/000.png", "images/000.png", "left/002.png", "images/003.png"];
    let cameras = renamed(&cameras, |i| names[i].to_owned());
    write_transforms(&folder.path().join("transforms.json"), &cameras, str::to_owned);
    let scene = load_scene(folder.path()).unwrap();
    let entries: Vec<usize> = scene.frames.iter().map(|f| f.entry).collect();
    assert_eq!(entries, [1, 2, 3]);
}

#[test]
fn pictures_of_another_scene_are_not_found_by_a_part_of_their_path() {
    let (folder, cameras) = made_up(4);
    let scene = folder.path().join("garden");
    write_text(&scene.join("sparse/0"), &renamed(&cameras, |i| format!("cam0/00{i}.png")));
    let error = load_scene(&scene).unwrap_err().to_string();
    assert!(error.contains("pictures on disk"), "{error}");
}

#[test]
fn of_pictures_with_one_stem_the_extension_decides() {
    let (folder, cameras) = made_up(4);
    let images = folder.path().join("images");
    for i in 0..4 {
        std::fs::copy(images.join(format!("00{i}.png")), images.join(format!("00{i}.jpg")))
            .unwrap();
    }
    write_text(&folder.path().join("sparse/0"), &renamed(&cameras, |i| format!("00{i}.PNG")));
    check(&load_scene(folder.path()).unwrap(), &images, plain_name);
}
