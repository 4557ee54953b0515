//! Flags about what is read of a scene: --model, --images, --strict, --pose-convention.

use crate::program;

use glam::{Mat4, Vec3};
use program::{call_in, workplace};
use serde_json::Value;
use std::path::Path;
use subsplat::image::{GrayImage, Luma};

#[test]
fn models_pictures_and_axes_are_chosen() {
    let place = workplace();
    let at = |name: &str| place.path().join(name);
    let text = std::fs::read_to_string(at("scene/cameras.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    let mut two = all.clone();
    two["frames"].as_array_mut().unwrap().remove(1);
    std::fs::write(at("scene/two.json"), two.to_string()).unwrap();
    let photographs = |arguments: &str| {
        let called = call_in(place.path(), &format!("check scene -o out {arguments}"));
        let line = called.stderr.lines().find(|l| l.contains(" photographs (")).map(str::to_owned);
        line.unwrap_or(called.stderr)
    };
    assert!(photographs("").contains("scene: 3 photographs (cameras.json)"));
    let chosen = photographs("--model two.json");
    assert!(chosen.contains("scene: 2 photographs (cameras.json)"), "{chosen}");
    // The pictures lie elsewhere.
    std::fs::rename(at("scene/images"), at("elsewhere")).unwrap();
    let chosen = photographs("--images elsewhere");
    assert!(chosen.contains("3 photographs"), "{chosen}");
    // OpenCV's matrices in a file of OpenGL's format.
    let frame = |f: &Value| {
        serde_json::json!({ "file_path": f["file"], "fl_x": f["fx"], "fl_y": f["fy"], "cx": f["cx"],
            "cy": f["cy"], "w": f["width"], "h": f["height"], "transform_matrix": f["c2w"] })
    };
    let frames: Vec<Value> = all["frames"].as_array().unwrap().iter().map(frame).collect();
    std::fs::create_dir(at("other")).unwrap();
    std::fs::rename(at("elsewhere"), at("other/images")).unwrap();
    let text = serde_json::json!({ "frames": frames }).to_string();
    std::fs::write(at("other/transforms.json"), text).unwrap();
    let reports = |arguments: &str| {
        let call = format!("--json check other --context 0,2 -o out {arguments}");
        call_in(place.path(), &call).json()["pairs"][0].clone()
    };
    let (wrong, right) = (reports(""), reports("--pose-convention opencv-c2w"));
    assert_ne!(wrong["baseline"], Value::Null);
    assert_eq!(wrong["baseline"], right["baseline"]);
    assert_ne!(wrong["overlap"], right["overlap"], "{wrong} {right}");
}

/// A transforms.json of the frames of a cameras.json in the folder `room`, with `matrix` of each pose.
fn transforms(all: &Value, room: &Path, matrix: &dyn Fn(Mat4) -> Mat4) -> Value {
    let frame = |f: &Value| {
        let rows: Vec<Vec<f32>> = serde_json::from_value(f["c2w"].clone()).unwrap();
        let c2w = [&rows[..3].concat()[..], &[0.0, 0.0, 0.0, 1.0]].concat();
        let c2w = Mat4::from_cols_slice(&c2w).transpose();
        let rows = matrix(c2w).transpose().to_cols_array_2d();
        serde_json::json!({ "file_path": room.join(f["file"].as_str().unwrap()), "fl_x": f["fx"],
            "fl_y": f["fy"], "cx": f["cx"], "cy": f["cy"], "w": f["width"], "h": f["height"],
            "transform_matrix": rows })
    };
    let frames: Vec<Value> = all["frames"].as_array().unwrap().iter().map(frame).collect();
    serde_json::json!({ "frames": frames })
}

/// Axes of OpenGL in those of OpenCV.
const OPENGL: Vec3 = Vec3::new(1.0, -1.0, -1.0);

/// Matrices in another convention than their format's are read in the one that fits the photographs, and a line says so.
#[test]
fn the_convention_that_fits_the_photographs_is_found() {
    let room = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/room");
    let place = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(room.join("cameras.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    let report = |scene: &str, matrix: &dyn Fn(Mat4) -> Mat4, arguments: &str| {
        std::fs::create_dir_all(place.path().join(scene)).unwrap();
        let text = transforms(&all, &room, matrix).to_string();
        std::fs::write(place.path().join(scene).join("transforms.json"), text).unwrap();
        let call = format!("--json check {scene} --context 0,1 -o out {arguments}");
        let called = call_in(place.path(), &call);
        let line = called.stderr.lines().find(|l| l.contains("are read as")).map(str::to_owned);
        (called.json()["pairs"][0]["verdict"].clone(), line)
    };
    assert_eq!(report("opengl", &|m| m * Mat4::from_scale(OPENGL), "").1, None);
    let (verdict, line) = report("opencv", &|m| m, "");
    assert_eq!(verdict, "ok");
    let line = line.unwrap();
    assert!(line.contains("opencv: ") && line.contains("read as opencv-c2w"), "{line}");
    let (verdict, line) = report("inverse", &|m| m.inverse(), "");
    assert!(verdict == "ok" && line.unwrap().contains("read as opencv-w2c"));
    // A flag is believed.
    let (verdict, line) = report("opencv", &|m| m, "--pose-convention opengl-c2w");
    assert!(verdict == "bad" && line.is_none(), "{verdict} {line:?}");
}

/// Of two sources of cameras the one that fits the photographs is read, and a line says so.
#[test]
fn the_source_that_fits_the_photographs_is_found() {
    let room = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/room");
    let place = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(room.join("cameras.json")).unwrap();
    let mut all: Value = serde_json::from_str(&text).unwrap();
    let frames = all["frames"].as_array_mut().unwrap();
    for frame in frames.iter_mut() {
        frame["file"] = room.join(frame["file"].as_str().unwrap()).display().to_string().into();
    }
    let write = |name: &str, all: &Value| {
        std::fs::write(place.path().join(name), all.to_string()).unwrap();
    };
    write("transforms.json", &transforms(&all, &room, &|m| m * Mat4::from_scale(OPENGL)));
    let check = |arguments: &str| {
        let called =
            call_in(place.path(), &format!("--json check . --context 0,1 -o out {arguments}"));
        let line = called.stderr.lines().find(|l| l.contains("read instead")).map(str::to_owned);
        (called.json()["pairs"][0]["verdict"].clone(), line)
    };
    write("cameras.json", &all);
    assert_eq!(check(""), ("ok".into(), None));
    // Each photograph with the camera of the next one.
    let frames = all["frames"].as_array_mut().unwrap();
    let mut poses: Vec<Value> = frames.iter().map(|frame| frame["c2w"].clone()).collect();
    poses.rotate_left(1);
    frames.iter_mut().zip(poses).for_each(|(frame, pose)| frame["c2w"] = pose);
    write("cameras.json", &all);
    let (verdict, line) = check("");
    let line = line.unwrap();
    assert!(verdict == "ok" && line.contains("those of transforms.json"), "{verdict} {line}");
    // A flag is believed.
    assert_eq!(check("--model cameras.json"), ("bad".into(), None));
}

/// Entries that are left out are listed at the end, and `render` refuses splats that are no numbers.
#[test]
fn what_is_left_out_is_listed() {
    let place = workplace();
    let at = |name: &str| place.path().join(name);
    std::fs::write(at("scene/images/view1.png"), "").unwrap();
    let called = call_in(place.path(), "check scene -o out");
    let list = "left out of 3 entries of the pose file: 1\n    1 images/view1.png: expected";
    assert!(called.stderr.contains(list), "{}", called.stderr);
    let json = call_in(place.path(), "--json info scene").json();
    assert_eq!(json["left_out"][0]["entry"], 1);
    assert_eq!(json["frames"][1]["entry"], 2);
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
                  property float z\nproperty float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\n\
                  property float opacity\nproperty float scale_0\nproperty float scale_1\n\
                  property float scale_2\nproperty float rot_0\nproperty float rot_1\nproperty float rot_2\n\
                  property float rot_3\nend_header\n";
    let rows = "0 0 1 0 0 0 1 0 0 0 1 0 0 0\nnan 0 1 0 0 0 1 0 0 0 1 0 0 0\n";
    std::fs::write(at("two.ply"), format!("{header}{rows}")).unwrap();
    let drawn = call_in(place.path(), "render two.ply -o pictures --size 16");
    assert_eq!(drawn.code, 0, "{}", drawn.stderr);
    let refused = call_in(place.path(), "render two.ply -o pictures --size 16 --strict");
    assert_eq!(refused.code, 1);
    assert!(refused.error().contains("1 of 2 splats"), "{}", refused.error());
}

/// A photograph that is masked as a whole is left out where others remain, and is an error where it is needed.
#[test]
fn a_photograph_without_pixels_is_left_out() {
    let place = workplace();
    let mask = |i: usize, value: u8| {
        std::fs::create_dir_all(place.path().join("scene/masks")).unwrap();
        let file = place.path().join(format!("scene/masks/view{i}.png"));
        GrayImage::from_pixel(8, 8, Luma([value])).save(file).unwrap();
    };
    (0..3).for_each(|i| mask(i, 255));
    let run = |more: &str| {
        let call = format!("run scene -o out --save ply --refine off --fit 0 --size 64 {more}");
        call_in(place.path(), &call)
    };
    // It is a view to compare with.
    mask(1, 0);
    let called = run("--input-size 64 --context 0,2");
    assert_eq!(called.code, 0, "{}", called.stderr);
    assert!(
        called.stderr.contains("warning: view1.png is not drawn: expected"),
        "{}",
        called.stderr
    );
    let list = "left out of 3 entries of the pose file: 1\n    1 view1.png: expected";
    assert!(called.stderr.contains(list), "{}", called.stderr);
    let called = run("--input-size 64 --context 0,2 --target 1");
    assert!(called.code == 1 && called.error().contains("view1.png: expected"));
    assert!(!called.stderr.contains("the scene lies at"), "{}", called.stderr);
    // It is one of those that the scene would be made from.
    mask(1, 255);
    mask(2, 0);
    let called = run("--input-size 64");
    assert_eq!(called.code, 0, "{}", called.stderr);
    let list = "left out of 3 entries of the pose file: 1\n    2 view2.png: expected";
    assert!(called.stderr.contains(list), "{}", called.stderr);
    assert!(called.stderr.contains("2 photographs (cameras.json)"), "{}", called.stderr);
    for needed in ["--strict", "--context 0,2"] {
        let called = run(needed);
        assert!(called.code == 1 && called.error().contains("view2.png: expected"), "{needed}");
    }
    mask(0, 0);
    let called = run("");
    assert!(
        called.code == 1 && called.error().contains("view0.png: expected"),
        "{}",
        called.stderr
    );
}
