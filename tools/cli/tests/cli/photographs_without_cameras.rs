//! Photographs without cameras: `subsplat poses`, and `run` of photographs and folders.

use crate::program::{call_in, call_with};
use std::fs;
use std::path::{Path, PathBuf};
use subsplat::Camera;
use subsplat::files::poses::scene::load_scene;

/// The example's folder, whose two inputs have known cameras.
fn room() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/room")
}

/// Focal length and centre of the example's inputs, px.
const INTRINSICS: &str = "189.767822,189.767822,128,128";

/// A folder `photos` with the example's two inputs and no cameras.
fn folder() -> tempfile::TempDir {
    let place = tempfile::tempdir().unwrap();
    fs::create_dir(place.path().join("photos")).unwrap();
    for name in ["input_0.png", "input_1.png"] {
        fs::copy(room().join("images").join(name), place.path().join("photos").join(name)).unwrap();
    }
    place
}

/// Rotation and direction errors of the second camera in the first one's frame, degrees.
fn errors(found: [Camera; 2], truth: [Camera; 2]) -> [f32; 2] {
    let relative = |[a, b]: [Camera; 2]| a.camera_from_world() * b.world_from_camera();
    let (f, t) = (relative(found), relative(truth));
    let turn = glam::Quat::from_mat4(&f).angle_between(glam::Quat::from_mat4(&t));
    let direction = f.w_axis.truncate().angle_between(t.w_axis.truncate());
    [turn.to_degrees(), direction.to_degrees()]
}

#[test]
fn poses_of_two_photographs_are_those_of_the_scene() {
    let place = folder();
    let called =
        call_in(place.path(), &format!("--json poses photos --intrinsics {INTRINSICS} -o photos"));
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    assert_eq!(report["confidence"], "high", "{report}");
    assert!(report["points"].as_u64().unwrap() > 50, "{report}");
    let truth = load_scene(room()).unwrap();
    let truth = [truth.frames[0].camera, truth.frames[1].camera];
    for file in ["photos", "photos/cameras.json", "photos/sparse/0"] {
        let found = load_scene(place.path().join(file)).unwrap();
        assert!(found.points.is_some_and(|p| p.len() > 50), "{file}");
        let found = [found.frames[0].camera, found.frames[1].camera];
        let [turn, direction] = errors(found, truth);
        assert!(turn < 0.5 && direction < 1.5, "{file}: {turn} {direction}");
    }
}

/// Cameras that are written elsewhere name files that other programs can open, and photographs by their own names.
#[test]
fn poses_beside_the_photographs_name_their_files() {
    let place = folder();
    let arguments = format!("poses photos --intrinsics {INTRINSICS} -o poses");
    assert_eq!(call_in(place.path(), &arguments).code, 0);
    let text = fs::read_to_string(place.path().join("poses/cameras.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    for frame in json["frames"].as_array().unwrap() {
        let file = frame["file"].as_str().unwrap();
        assert!(fs::File::open(place.path().join("poses").join(file)).is_ok(), "{file}");
        assert!(file.ends_with(".png"), "{file}");
    }
    let called = call_in(place.path(), "--json check poses --context input_0,input_1 -o out");
    assert_eq!(called.code, 0, "{}", called.stderr);
}

#[test]
fn a_folder_of_photographs_becomes_a_scene() {
    let place = folder();
    let arguments =
        format!("--json run photos --intrinsics {INTRINSICS} --fit 0 --frames 1 -o out");
    let called = call_in(place.path(), &arguments);
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    assert_eq!(report["context"], serde_json::json!(["input_0", "input_1"]));
    assert_eq!(report["near_far_from"].as_str().unwrap().matches("sparse points").count(), 1);
    // The photographs give themselves back: the cameras fit.
    assert!(report["inputs"]["psnr"].as_f64().unwrap() > 20.0, "{}", report["inputs"]);
    assert!(place.path().join("out/scene.ply").is_file());
}

/// Photographs two levels down are found, a scene there is named, and those of a folder beside others are not left
/// out without a word.
#[test]
fn photographs_deeper_in_a_folder_are_found_or_named() {
    let place = folder();
    let at = |path: &str| place.path().join(path);
    let poses = |path: &str| {
        call_in(place.path(), &format!("poses {path} --intrinsics {INTRINSICS} -o out.json"))
    };
    fs::create_dir_all(at("phone/DCIM")).unwrap();
    fs::rename(at("photos"), at("phone/DCIM/100APPLE")).unwrap();
    let called = poses("phone");
    assert_eq!(called.code, 0, "{}", called.stderr);
    assert!(called.stderr.contains("100APPLE") || called.stdout.contains("100APPLE"));
    // Two folders of photographs.
    fs::create_dir(at("phone/DCIM/101APPLE")).unwrap();
    for name in ["input_0.png", "input_1.png"] {
        fs::copy(at("phone/DCIM/100APPLE").join(name), at("phone/DCIM/101APPLE").join(name))
            .unwrap();
    }
    let called = poses("phone");
    assert!(
        called.code != 0 && called.stderr.contains("101APPLE (2 photographs)"),
        "{}",
        called.stderr
    );
    // Photographs beside a folder of others.
    fs::rename(at("phone/DCIM/100APPLE"), at("photos")).unwrap();
    fs::rename(at("phone/DCIM/101APPLE"), at("photos/more")).unwrap();
    let called = poses("photos");
    assert_eq!(called.code, 0, "{}", called.stderr);
    let note = called.stderr.lines().find(|line| line.contains("not used"));
    assert!(note.is_some_and(|note| note.contains("more (2)")), "{}", called.stderr);
    fs::remove_dir_all(at("photos/more")).unwrap();
    assert!(!poses("photos").stderr.contains("not used"));
    // `images` of a folder has its photographs.
    fs::create_dir(at("album")).unwrap();
    fs::rename(at("photos"), at("album/images")).unwrap();
    let called = poses("album");
    assert!(called.code == 0 && !called.stderr.contains("not used"), "{}", called.stderr);
    fs::rename(at("album/images"), at("photos")).unwrap();
    // A scene two levels down.
    fs::create_dir_all(at("project/a/scene")).unwrap();
    fs::rename(at("photos"), at("project/a/scene/images")).unwrap();
    let cameras = fs::read(at("out.json")).unwrap();
    let text = String::from_utf8(cameras).unwrap().replace("photos/", "images/");
    fs::write(at("project/a/scene/cameras.json"), text).unwrap();
    let called = poses("project");
    assert!(called.code != 0 && called.stderr.contains("give project/a"), "{}", called.stderr);
}

#[test]
fn all_of_three_photographs_are_used() {
    let place = folder();
    fs::copy(room().join("images/heldout_0_512.jpg"), place.path().join("photos/third.jpg"))
        .unwrap();
    // The field of view of INTRINSICS, which the larger picture shares.
    let arguments =
        "--json run photos --fov 68 --input-size 64 --frames 1 --surroundings off -o out";
    let called = call_in(place.path(), arguments);
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    assert_eq!(report["context"], serde_json::json!(["input_0", "input_1", "third"]));
    // They share the Gaussians of two and a half; hidden ones are left out.
    let count = |report: &serde_json::Value| report["gaussians"].as_u64().unwrap();
    let full = 3 * 64 * 64 * 4;
    assert!(count(&report) <= full * 5 / 6 && report["refine"]["removed"] == 0, "{report}");
    let maps =
        || (0..3).filter(|i| place.path().join(format!("out/inputs/{i}_children.png")).exists());
    assert_eq!(maps().count(), 3);
    // Of all Gaussians, the refinement removes those of hidden parents.
    let called = call_in(place.path(), &format!("{arguments} --gaussians 100%"));
    let report = called.json();
    let removed = report["refine"]["removed"].as_u64().unwrap();
    assert!(removed > 0 && count(&report) + removed == full, "{report}");
    assert_eq!(maps().count(), 0);
}

#[test]
fn photographs_that_determine_no_cameras_are_refused_with_exit_code_3() {
    let place = folder();
    let same = "photos/input_0.png photos/input_0.png";
    for command in ["poses", "run", "check"] {
        let called = call_in(place.path(), &format!("--json {command} {same} --fov 60 -o new"));
        assert_eq!(called.code, 3, "{command}: {}", called.stderr);
        assert!(called.error().contains("input_0.png"), "{}", called.stderr);
        assert!(called.json()["error"].as_str().unwrap().contains("photographs"));
    }
    assert!(!place.path().join("new/cameras.json").exists());
    fs::create_dir(place.path().join("one")).unwrap();
    fs::copy(place.path().join("photos/input_0.png"), place.path().join("one/a.png")).unwrap();
    for (arguments, words) in [
        ("poses one", "at least 2 photographs, got 1"),
        ("poses photos/input_0.png", "got one photograph"),
        ("run one", "at least 2 photographs, got 1"),
        ("poses photos missing.png", "missing.png"),
        ("poses photos --intrinsics 1,2", "--intrinsics"),
    ] {
        let called = call_in(place.path(), arguments);
        assert_eq!(called.code, 1, "{arguments}: {}", called.stderr);
        assert!(called.error().contains(words), "{arguments}: {}", called.error());
    }
    let scene = room();
    let called = call_with(place.path(), &["poses", scene.to_str().unwrap()], &[]);
    assert!(
        called.code == 1 && called.error().contains("a scene with cameras"),
        "{}",
        called.stderr
    );
}
