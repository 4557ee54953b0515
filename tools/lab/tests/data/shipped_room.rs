//! Tests that `examples/room/` equals the output of `examples/make_room.rs`.

#[path = "../../examples/make_room.rs"]
#[allow(dead_code, reason = "its main belongs to the example")]
mod make_room;

use serde_json::Value;
use std::path::PathBuf;
use subsplat::scene::metrics::psnr;
use subsplat_lab::data::procedural::{Grade, Quality};

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../examples/room")
}

fn json(name: &str) -> Value {
    serde_json::from_str(&std::fs::read_to_string(folder().join(name)).unwrap()).unwrap()
}

#[test]
fn an_input_picture_is_reproduced() {
    let frame = &make_room::frames()[0];
    let committed = image::open(folder().join(&frame.file)).unwrap().to_rgb8();
    let made = make_room::bytes(&make_room::render(&make_room::room(), &frame.camera));
    assert_eq!(committed.as_raw().len(), made.len());
    let worst = committed.as_raw().iter().zip(&made).map(|(a, b)| a.abs_diff(*b)).max();
    // One level: `pow` may round differently on another platform.
    assert!(worst <= Some(1), "{worst:?}");
}

#[test]
fn cameras_and_planes_are_those_of_the_pictures() {
    let (cameras, frames) = (json("cameras.json"), make_room::frames());
    let listed = cameras["frames"].as_array().unwrap();
    assert_eq!(listed.len(), frames.len());
    let room = make_room::room();
    let quick = Quality {
        grade: Grade { gain: [make_room::GAIN; 3], ..Grade::default() },
        ..Quality::clean(1)
    };
    let mut context = Vec::new();
    for (i, (frame, entry)) in frames.iter().zip(listed).enumerate() {
        let k = &frame.camera.intrinsics();
        assert_eq!(entry["file"], frame.file.as_str());
        assert_eq!((&entry["width"], &entry["height"]), (&k.width.into(), &k.height.into()));
        let rows = frame.camera.world_from_camera().transpose().to_cols_array();
        let c2w = entry["c2w"].as_array().unwrap().iter().flat_map(|r| r.as_array().unwrap());
        let values = ["fx", "fy", "cx", "cy"].into_iter().map(|n| &entry[n]).chain(c2w);
        for (value, want) in values.zip([k.fx, k.fy, k.cx, k.cy].into_iter().chain(rows)) {
            assert!((value.as_f64().unwrap() - f64::from(want)).abs() < 1e-5, "frame {i}");
        }
        let view = room.render(&frame.camera, &quick);
        let picture = image::open(folder().join(&frame.file)).unwrap().to_rgb8();
        let picture: Vec<f32> = picture.into_raw().iter().map(|v| f32::from(*v) / 255.0).collect();
        // One sample per pixel against many, and JPEG: far above the agreement with another view or
        // another camera.
        let agreement = psnr(&picture, &view.rgb, k.width, k.height).unwrap();
        assert!(agreement > 26.0, "frame {i}: {agreement} dB");
        if i < 2 {
            context.push(view);
        }
    }
    let (near, far) = make_room::near_far(&context);
    assert_eq!((cameras["near"].as_f64(), cameras["far"].as_f64()), (Some(near), Some(far)));
}

#[test]
fn the_protocol_names_targets_at_twice_and_four_times_the_input() {
    let (protocol, frames) = (json("protocol.json"), make_room::frames());
    let tests = protocol["tests"].as_array().unwrap();
    assert_eq!(tests.len(), 2);
    for (test, factor) in tests.iter().zip([2, 4]) {
        assert_eq!(test["upscale"], factor);
        assert_eq!(test["context"], serde_json::json!([0, 1]));
        let targets = test["target"].as_array().unwrap();
        assert_eq!(targets.len(), 3);
        for target in targets {
            let k = &frames[target.as_u64().unwrap() as usize].camera.intrinsics();
            assert_eq!((k.width, k.height), (256 * factor, 256 * factor));
        }
    }
}

#[test]
fn the_pictures_are_small() {
    let files = std::fs::read_dir(folder().join("images")).unwrap();
    let bytes: u64 = files.map(|f| f.unwrap().metadata().unwrap().len()).sum();
    assert!(bytes < 2_000_000, "{bytes}");
}
