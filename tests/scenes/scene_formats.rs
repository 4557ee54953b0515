//! Tests of every pose format, on files that the tests write.

use subsplat_test_support::colmap_files;
use subsplat_test_support::made_up;
use subsplat_test_support::noise;

use crate::as_people_have_them::write_transforms;
use glam::{Mat4, Vec3};
use made_up::made_up;
use noise::noise;
use std::path::PathBuf;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::image;
use subsplat::files::poses::cameras_json::{
    CameraFile, NamedCamera, load_cameras_json, save_cameras_json,
};
use subsplat::files::poses::matrices;
use subsplat::files::poses::matrices::PoseConvention;
use subsplat::files::poses::scene::{Scene, SceneFormat, Units, load_scene};
use subsplat::reconstruct::inputs::pair::choose_pair;
use subsplat::reconstruct::{DepthBounds, DepthRange};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

#[test]
fn cameras_json_round_trips() {
    let (folder, mut cameras) = made_up(5);
    cameras[3].depth = Some("depth/003.png".to_owned());
    cameras[2].mask = Some("keep/2.png".to_owned());
    for units in [Units::Unknown, Units::Metres, Units::RealEstate10k] {
        let path = folder.path().join("cameras.json");
        let content = CameraFile {
            cameras: cameras.clone(),
            units,
            near_far: Some(NearFar::new(0.5, 8.0)),
            ..Default::default()
        };
        save_cameras_json(&path, &content).unwrap();
        assert_eq!(load_cameras_json(&path).unwrap(), content);
        let scene = load_scene(folder.path()).unwrap();
        assert_eq!(scene.units, units);
        for (frame, camera) in scene.frames.iter().zip(&cameras) {
            assert_eq!(frame.camera, camera.camera);
            assert_eq!(frame.timestamp, camera.timestamp);
            assert_eq!(frame.image, folder.path().join(&camera.file));
            assert_eq!(NamedCamera::of_frame(frame, &*camera.file).camera, camera.camera);
        }
    }
}

/// A camera list and the scene with its pictures are equal, also where the rotations in the file
/// have few digits.
#[test]
fn a_camera_list_is_orthonormalised_as_a_scene_is() {
    let (folder, cameras) = made_up(2);
    let path = folder.path().join("cameras.json");
    let content =
        CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() };
    save_cameras_json(&path, &content).unwrap();
    let mut json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for value in json["frames"][1]["c2w"].as_array_mut().unwrap() {
        for v in value.as_array_mut().unwrap() {
            *v = ((v.as_f64().unwrap() * 1000.0).round() / 1000.0).into();
        }
    }
    std::fs::write(&path, json.to_string()).unwrap();
    let list = load_cameras_json(&path).unwrap().cameras;
    let scene = load_scene(folder.path()).unwrap();
    for (c, frame) in list.iter().zip(&scene.frames) {
        assert_eq!(c.camera, frame.camera);
    }
    assert_ne!(list[1].camera, content.cameras[1].camera);
}

#[test]
fn three_dgs_camera_lists_are_read() {
    let (folder, cameras) = made_up(2);
    let list: Vec<_> = cameras
        .iter()
        .map(|c| {
            let rows = c.camera.rotation().transpose().to_cols_array_2d();
            let k = c.camera.intrinsics();
            serde_json::json!({
                "id": 0, "img_name": c.file.trim_start_matches("images/").trim_end_matches(".png"),
                "width": 64, "height": 48, "fx": k.fx, "fy": k.fy,
                "rotation": rows, "position": c.camera.position().to_array(),
            })
        })
        .collect();
    std::fs::write(folder.path().join("cameras.json"), serde_json::to_vec(&list).unwrap()).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    for (frame, c) in scene.frames.iter().zip(&cameras) {
        assert_eq!(frame.camera.world_from_camera(), c.camera.world_from_camera());
        assert_eq!((frame.camera.intrinsics().cx, frame.camera.intrinsics().cy), (32.0, 24.0));
    }
}

fn check_colmap(scene: &Scene, cameras: &[NamedCamera]) {
    assert_eq!(scene.source, SceneFormat::Colmap);
    assert_eq!(scene.frames.len(), cameras.len());
    let points = scene.points.as_ref().unwrap();
    assert_eq!(points.len(), 40);
    assert_eq!(points[0], Vec3::new(0.0, 0.2, 3.0));
    for (i, (f, c)) in scene.frames.iter().zip(cameras).enumerate() {
        let error = f.camera.world_from_camera() - c.camera.world_from_camera();
        assert!(error.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{error}");
        assert_eq!(f.camera.intrinsics(), c.camera.intrinsics());
        assert_eq!(f.visible, [0, 1 + i as u32]);
        let Distortion::Brown { k, p } = f.distortion else { panic!() };
        assert_eq!((k[0], k[1], p), (0.01, -0.02, [0.001, 0.002]));
        let (picture, camera) = f.load().unwrap();
        assert_eq!((picture.width, picture.height), (64, 48));
        assert_ne!(camera.intrinsics().fx, f.camera.intrinsics().fx);
    }
}

#[test]
fn colmap_binary_and_text_agree_in_every_folder() {
    for subfolder in ["sparse/0", "sparse", "colmap/sparse/0", "."] {
        let (folder, cameras) = made_up(4);
        let model = folder.path().join(subfolder);
        let files = colmap_files::binary(&cameras);
        colmap_files::write(&model, "bin", [&files[0], &files[1], &files[2]]);
        // COLMAP 4's extra files.
        std::fs::write(model.join("rigs.bin"), [1, 2]).unwrap();
        std::fs::write(model.join("frames.bin"), [1, 2]).unwrap();
        check_colmap(&load_scene(folder.path()).unwrap(), &cameras);
        let name = folder.path().file_name().unwrap().to_string_lossy().into_owned();
        assert_eq!(load_scene(model.join("images.bin")).unwrap().name, name);

        let (folder, cameras) = made_up(4);
        let model = folder.path().join(subfolder);
        let files = colmap_files::text(&cameras);
        let files = [files[0].as_bytes(), files[1].as_bytes(), files[2].as_bytes()];
        colmap_files::write(&model, "txt", files);
        let scene = load_scene(folder.path()).unwrap();
        check_colmap(&scene, &cameras);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        check_colmap(&load_scene(model.join("cameras.txt")).unwrap(), &cameras);
    }
}

#[test]
fn colmap_text_without_point_lines_or_points_file() {
    let (folder, cameras) = made_up(3);
    let [cams, images, _] = colmap_files::text(&cameras);
    for empty_lines in [true, false] {
        let images: String = images
            .lines()
            .filter(|l| !l.starts_with("1.5"))
            .map(|l| format!("{l}\n{}", if empty_lines { "\n" } else { "" }))
            .collect();
        colmap_files::write(
            &folder.path().join("sparse/0"),
            "txt",
            [cams.as_bytes(), images.as_bytes(), b""],
        );
        std::fs::remove_file(folder.path().join("sparse/0/points3D.txt")).unwrap();
        let scene = load_scene(folder.path()).unwrap();
        assert_eq!(scene.frames.len(), 3);
        assert!(scene.points.is_none());
        assert_eq!(scene.warnings.len(), if empty_lines { 1 } else { 2 }, "{:?}", scene.warnings);
    }
}

#[test]
fn colmap_points_give_the_depth_range() {
    let (folder, cameras) = made_up(1);
    let files = colmap_files::binary(&cameras);
    colmap_files::write(&folder.path().join("sparse"), "bin", [&files[0], &files[1], &files[2]]);
    let mut scene = load_scene(folder.path()).unwrap();
    // Other pose and points: a wall at depths 2 to 4 in front of the camera.
    let camera = &mut scene.frames[0].camera;
    *camera = Camera::new(camera.intrinsics(), Mat4::IDENTITY).unwrap();
    scene.points = Some((0..101).map(|i| Vec3::new(0.0, 0.0, 2.0 + 0.02 * i as f32)).collect());
    let of_frames = |scene: &Scene, frame, range| DepthBounds::of_frames(scene, &[frame], range);
    let range = of_frames(&scene, 0, DepthRange::Auto).unwrap();
    assert!((range.near - 2.04 / 1.5).abs() < 1e-4 && (range.far - 2.0 * 3.96).abs() < 1e-4);
    assert!(range.source.to_string().contains("101"), "{}", range.source);
    let fixed_near = of_frames(&scene, 0, DepthRange::Near(0.5)).unwrap();
    assert_eq!((fixed_near.near, fixed_near.far), (0.5, range.far));
    assert!(of_frames(&scene, 0, DepthRange::Near(50.0)).is_err());
    let not_a_number = DepthRange::Fixed { near: f32::NAN, far: 2.0 };
    assert!(of_frames(&scene, 0, not_a_number).is_err());
    assert!(of_frames(&scene, 7, DepthRange::Auto).is_err());
    // 19 depths say too little.
    scene.points.as_mut().unwrap().truncate(19);
    assert_eq!(DepthBounds::of_scene(&scene, &[0]).unwrap(), None);
    let error = of_frames(&scene, 0, DepthRange::Auto).unwrap_err().to_string();
    assert!(error.contains(&scene.name) && error.contains("distance of 0"), "{error}");
}

#[test]
fn the_content_of_a_file_decides_and_not_its_name() {
    let (folder, cameras) = made_up(4);
    let [own, nerfs] = ["cameras.json", "transforms.json"].map(|name| folder.path().join(name));
    let content = CameraFile { cameras: cameras.clone(), ..Default::default() };
    save_cameras_json(&own, &content).unwrap();
    std::fs::rename(&own, &nerfs).unwrap();
    for given in [folder.path(), &nerfs] {
        let scene = load_scene(given).unwrap();
        let poses = scene.frames.iter().map(|f| f.camera.world_from_camera());
        assert!(poses.eq(cameras.iter().map(|c| c.camera.world_from_camera())));
    }
    std::fs::remove_file(&nerfs).unwrap();
    write_transforms(&own, &cameras, str::to_owned);
    assert_eq!(load_scene(&own).unwrap().frames.len(), 4);
    // Neither layout: the name decides which one is expected.
    for (path, expected) in [(&own, "c2w"), (&nerfs, "transform_matrix")] {
        std::fs::write(path, r#"{"frames": [{"a": 1}]}"#).unwrap();
        let error = load_scene(path).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
        std::fs::remove_file(path).unwrap();
    }
}

/// Cameras outside the folder of the photographs name these by absolute paths; results have short names.
#[test]
fn names_that_lead_out_of_the_folder_lose_what_they_share() {
    let (folder, mut cameras) = made_up(3);
    let elsewhere = tempfile::tempdir().unwrap();
    let path = elsewhere.path().join("cameras.json");
    let names = |cameras: &[NamedCamera]| {
        let content = CameraFile { cameras: cameras.to_vec(), ..Default::default() };
        save_cameras_json(&path, &content).unwrap();
        let frames = load_scene(&path).unwrap().frames;
        frames.into_iter().map(|frame| frame.name).collect::<Vec<_>>()
    };
    let own: Vec<String> = cameras.iter().map(|c| c.file.clone()).collect();
    for c in &mut cameras {
        c.file = folder.path().join(&c.file).to_str().unwrap().to_owned();
    }
    let stem = |file: &String| file[7..].trim_end_matches(".png").to_owned();
    assert_eq!(names(&cameras), own.iter().map(stem).collect::<Vec<_>>());
    // Two of them in folders of their own.
    for (i, sub) in ["a", "b"].into_iter().enumerate() {
        let to = folder.path().join(sub).join("x.png");
        std::fs::create_dir(to.parent().unwrap()).unwrap();
        std::fs::rename(&cameras[i].file, &to).unwrap();
        cameras[i].file = to.to_str().unwrap().to_owned();
    }
    assert_eq!(
        names(&cameras),
        ["a/x".to_owned(), "b/x".to_owned(), format!("images/{}", stem(&own[2]))]
    );
}

#[test]
fn transforms_json_variants_are_read() {
    let (folder, cameras) = made_up(3);
    let gl = |c: &Camera| {
        let m = c.world_from_camera() * Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
        m.transpose().to_cols_array_2d()
    };
    let frames = |name: &dyn Fn(&str) -> String| -> Vec<serde_json::Value> {
        let frame = |c: &NamedCamera| {
            serde_json::json!({"file_path": name(&c.file), "transform_matrix": gl(&c.camera),
                "sharpness": 3})
        };
        cameras.iter().map(frame).collect()
    };
    let load = |json: serde_json::Value| {
        std::fs::write(folder.path().join("transforms.json"), json.to_string()).unwrap();
        load_scene(folder.path()).unwrap()
    };
    // NeRF's Blender scenes: a field of view, no size, names without extension.
    let bare = |f: &str| format!("./{}", f.trim_end_matches(".png"));
    let scene = load(serde_json::json!({"camera_angle_x": 0.8, "frames": frames(&bare)}));
    let f = 32.0 / (0.4f32).tan();
    for (frame, c) in scene.frames.iter().zip(&cameras) {
        assert_eq!(frame.camera.world_from_camera(), c.camera.world_from_camera());
        let k = frame.camera.intrinsics();
        assert!((k.fx - f).abs() < 1e-4 && k.fy == k.fx && (k.cx, k.cy) == (32.0, 24.0), "{k:?}");
        assert_eq!(frame.name, c.file[7..].trim_end_matches(".png"));
    }
    // Per-frame intrinsics have precedence; Windows separators; a camera model; half-size pictures.
    let mut with_own = frames(&|f: &str| f.replace('/', "\\"));
    with_own[1]["fl_x"] = 200.0.into();
    with_own[1]["cx"] = 60.0.into();
    let scene = load(serde_json::json!({
        "fl_x": 140.0, "fl_y": 142.0, "cx": 64.0, "cy": 48.0, "w": 128.0, "h": 96,
        "camera_model": "OPENCV", "k1": 0.01, "aabb_scale": 16, "frames": with_own}));
    let k = |i: usize| scene.frames[i].camera.intrinsics();
    assert_eq!((k(0).fx, k(0).fy, k(0).cx), (70.0, 71.0, 32.0));
    assert_eq!((k(1).fx, k(1).fy, k(1).cx), (100.0, 71.0, 30.0));
    assert!(scene.warnings.iter().any(|w| w.contains("another size")), "{:?}", scene.warnings);
    assert_eq!(
        scene.frames[0].distortion,
        Distortion::Brown { k: [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }
    );
    // PINHOLE, and a listed frame without a picture.
    let mut list = frames(&str::to_owned);
    list[2]["file_path"] = "images/nowhere.png".into();
    let scene = load(serde_json::json!({"camera_model": "PINHOLE", "fl_x": 70, "frames": list}));
    assert_eq!(scene.frames.len(), 2);
    // Its picture has another name.
    assert_eq!(scene.warnings.len(), 2, "{:?}", scene.warnings);
    assert!(scene.warnings[0].contains("images/nowhere.png"));
    // Both spellings of fisheye.
    for (key, value) in
        [("camera_model", serde_json::json!("OPENCV_FISHEYE")), ("is_fisheye", true.into())]
    {
        let scene = load(
            serde_json::json!({key: value, "fl_x": 70, "k4": 0.1, "frames": frames(&str::to_owned)}),
        );
        assert_eq!(scene.frames[0].distortion, Distortion::Fisheye { k: [0.0, 0.0, 0.0, 0.1] });
    }
}

#[test]
fn precedence_of_pose_files() {
    let (folder, cameras) = made_up(2);
    let at = |name: &str| folder.path().join(name);
    let line = |v: &[f32]| v.iter().map(f32::to_string).collect::<Vec<_>>().join(" ");
    let pose = |c: &NamedCamera| c.camera.world_from_camera().transpose().to_cols_array();
    let poses: Vec<String> = cameras.iter().map(|c| line(&pose(c))).collect();
    std::fs::write(at("poses.txt"), poses.join("\n")).unwrap();
    std::fs::write(at("K.txt"), "70 0 32\n0 71 24\n0 0 1\n").unwrap();
    let source = || load_scene(folder.path()).unwrap().source;
    assert_eq!(source(), SceneFormat::Matrices);
    let w2c = |c: &NamedCamera| c.camera.camera_from_world().transpose().to_cols_array();
    let cams: Vec<String> =
        cameras.iter().map(|c| format!("1 1.1 1.4 .5 .5 0 0 {}", line(&w2c(c)[..12]))).collect();
    std::fs::write(at("abc.txt"), format!("https://a.b/c\n{}", cams.join("\n"))).unwrap();
    assert_eq!(source(), SceneFormat::RealEstate10k);
    let bin = colmap_files::binary(&cameras);
    colmap_files::write(&at("sparse/0"), "bin", [&bin[0], &bin[1], &bin[2]]);
    assert_eq!(source(), SceneFormat::Colmap);
    let gl = Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
    let frames: Vec<_> = cameras
        .iter()
        .map(|c| {
            let m = (c.camera.world_from_camera() * gl).transpose().to_cols_array_2d();
            serde_json::json!({"file_path": c.file, "transform_matrix": m})
        })
        .collect();
    let json = serde_json::json!({"fl_x": 70, "frames": frames}).to_string();
    std::fs::write(at("transforms.json"), json).unwrap();
    assert_eq!(source(), SceneFormat::Transforms);
    save_cameras_json(
        at("cameras.json"),
        &CameraFile {
            cameras: cameras.clone(),
            units: Units::Unknown,
            near_far: None,
            ..Default::default()
        },
    )
    .unwrap();
    assert_eq!(source(), SceneFormat::CamerasJson);
    // All five formats agree, and each can be selected by its file.
    let reference = load_scene(folder.path()).unwrap();
    for (file, format) in [
        ("transforms.json", SceneFormat::Transforms),
        ("sparse/0/cameras.bin", SceneFormat::Colmap),
        ("abc.txt", SceneFormat::RealEstate10k),
        ("poses.txt", SceneFormat::Matrices),
    ] {
        let scene = load_scene(at(file)).unwrap();
        assert_eq!(scene.source, format);
        for (a, b) in scene.frames.iter().zip(&reference.frames) {
            assert_eq!((&a.name, &a.image), (&b.name, &b.image));
            let e = a.camera.world_from_camera() - b.camera.world_from_camera();
            assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{file} {e}");
        }
    }
    assert_eq!(load_scene(at("sparse/0")).unwrap().source, SceneFormat::Colmap);
    // Other matrix conventions, from the same numbers.
    for (convention, want) in [
        (PoseConvention::WorldFromCameraOpenGl, cameras[0].camera.world_from_camera() * gl),
        (PoseConvention::CameraFromWorldOpenCv, cameras[0].camera.camera_from_world()),
    ] {
        let scene = matrices::load(folder.path(), convention).unwrap();
        let e = scene.frames[0].camera.world_from_camera() - want;
        assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{convention:?} {e}");
    }
}

#[test]
fn re10k_frames_are_matched_by_time_order_or_number() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let lines: Vec<String> = (0..4)
        .map(|i| format!("{} 1 1.5 .5 .5 0 0 1 0 0 {i} 0 1 0 0 0 0 1 0", 1000 * i + 500))
        .collect();
    std::fs::write(folder.path().join("a.txt"), format!("url://x\n{}\n", lines.join("\n")))
        .unwrap();
    let put = |names: &[&str]| -> Vec<PathBuf> {
        std::fs::remove_dir_all(&images).unwrap();
        std::fs::create_dir(&images).unwrap();
        let path = |n: &&str| images.join(n);
        names.iter().for_each(|n| image::save_png(path(n), &noise(12, 8)).unwrap());
        names.iter().map(path).collect()
    };
    let x = |scene: &Scene| -> Vec<f32> {
        scene.frames.iter().map(|f| -f.camera.position().x).collect()
    };
    put(&["3500.png", "500.png"]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(x(&scene), [0.0, 3.0]);
    assert_eq!(scene.warnings.len(), 1);
    put(&["a.png", "b.png", "c.png", "d.png"]);
    assert_eq!(x(&load_scene(folder.path()).unwrap()), [0.0, 1.0, 2.0, 3.0]);
    put(&["01.png", "02.png"]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(x(&scene), [1.0, 2.0]);
    // The intrinsics refer to the stored size.
    let k = scene.frames[0].camera.intrinsics();
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (12.0, 12.0, 6.0, 4.0));
    put(&["p.png", "q.png"]);
    let e = load_scene(folder.path()).unwrap_err().to_string();
    assert!(e.contains("4 pictures"), "{e}");
}

/// Ten or more pictures without leading zeros: `10.png` is not the third.
#[test]
fn names_are_sorted_by_their_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let line = |i: usize| format!("{} 1 1.5 .5 .5 0 0 1 0 0 {i} 0 1 0 0 0 0 1 0", 1000 * i + 500);
    let lines: Vec<String> = (0..12).map(line).collect();
    std::fs::write(at("a.txt"), format!("url://x\n{}\n", lines.join("\n"))).unwrap();
    let poses: Vec<String> = (0..12).map(|i| format!("1 0 0 -{i} 0 1 0 0 0 0 1 0")).collect();
    std::fs::write(at("poses.txt"), poses.join("\n")).unwrap();
    std::fs::write(at("K.txt"), "12 12 6 4").unwrap();
    let names: [&dyn Fn(usize) -> String; 4] =
        [&|i| i.to_string(), &|i| (i + 1).to_string(), &|i| format!("frame_{i}"), &|i| {
            format!("take2-{:02}", i + 95)
        }];
    for name in names {
        let _ = std::fs::remove_dir_all(at("images"));
        std::fs::create_dir(at("images")).unwrap();
        for i in 0..12 {
            image::save_png(at("images").join(name(i) + ".png"), &noise(12, 8)).unwrap();
        }
        for file in ["a.txt", "poses.txt"] {
            let scene = load_scene(at(file)).unwrap();
            assert_eq!(scene.frames.len(), 12);
            for (i, frame) in scene.frames.iter().enumerate() {
                let x = -frame.camera.position().x;
                assert_eq!((&*frame.name, x), (&*name(i), i as f32), "{file}");
            }
        }
    }
    // Fewer pictures than lines, and the first name is also a time stamp: names are still indices.
    let text = format!("url://x\n{}\n", lines.join("\n")).replace("\n500 ", "\n0 ");
    std::fs::write(at("a.txt"), text).unwrap();
    std::fs::remove_dir_all(at("images")).unwrap();
    std::fs::create_dir(at("images")).unwrap();
    for name in ["images/0.png", "images/7.png"] {
        image::save_png(at(name), &noise(12, 8)).unwrap();
    }
    let x = |f: &subsplat::files::poses::scene::Frame| -f.camera.position().x;
    let scene = load_scene(at("a.txt")).unwrap();
    assert_eq!(scene.frames.iter().map(x).collect::<Vec<_>>(), [0.0, 7.0]);
}

#[test]
fn pairs_and_exif() {
    let (folder, cameras) = made_up(2);
    let path = |i: usize| folder.path().join(&cameras[i].file);
    let scene = Scene::from_pair(path(0), path(1), cameras[0].camera, cameras[1].camera).unwrap();
    assert_eq!(scene.frames[1].camera, cameras[1].camera);
    assert!(scene.warnings.is_empty());
    let camera = cameras[0].camera;
    let wrong = Intrinsics { width: 48, height: 64, ..camera.intrinsics() };
    let wrong = camera.with_intrinsics(wrong).unwrap();
    let e = Scene::from_pair(path(0), path(1), wrong, cameras[1].camera).unwrap_err();
    assert!(e.to_string().contains("48x64"), "{e}");

    // A PNG eXIf chunk with orientation 6, big-endian TIFF.
    let mut exif = b"MM\0\x2a\0\0\0\x08\0\x01".to_vec();
    exif.extend([0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, 6, 0, 0, 0, 0, 0, 0]);
    let mut chunk = (exif.len() as u32).to_be_bytes().to_vec();
    chunk.extend(b"eXIf");
    chunk.extend(&exif);
    let mut crc = flate2::Crc::new();
    crc.update(&chunk[4..]);
    chunk.extend(crc.sum().to_be_bytes());
    let mut png = std::fs::read(path(0)).unwrap();
    png.splice(33..33, chunk);
    std::fs::write(path(0), png).unwrap();
    assert_eq!(image::probe(path(0)).unwrap().orientation, Some(6));
    let before = image::load(path(1)).unwrap();
    assert_eq!(image::load(path(0)).unwrap(), before, "the orientation is not applied");
    // A pose file's cameras describe the stored pixels.
    let pose_file = folder.path().join("cameras.json");
    let save = |camera| {
        let cameras = vec![NamedCamera::new(cameras[0].file.as_str(), camera)];
        let content =
            CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() };
        save_cameras_json(&pose_file, &content).unwrap();
    };
    save(camera);
    let scene = load_scene(&pose_file).unwrap();
    assert!(scene.warnings[0].contains("EXIF"), "{:?}", scene.warnings);
    save(wrong);
    let e = load_scene(&pose_file).unwrap_err();
    assert!(e.to_string().contains("EXIF orientation 6"), "{e}");
}

/// A picture of another shape than its camera's gives a frame that cannot be loaded. It stops the
/// scene only where fewer than two others are left.
#[test]
fn a_frame_of_another_shape_is_reported_and_avoided() {
    let (folder, cameras) = made_up(4);
    image::save_png(folder.path().join("images/001.png"), &noise(48, 64)).unwrap();
    let pose_file = folder.path().join("cameras.json");
    let save = |cameras: &[NamedCamera]| {
        let cameras = cameras.to_vec();
        let content =
            CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() };
        save_cameras_json(&pose_file, &content).unwrap();
    };
    save(&cameras);
    let scene = load_scene(&pose_file).unwrap();
    assert_eq!((scene.frames.len(), scene.usable()), (4, vec![0, 2, 3]));
    assert!(scene.warnings[0].starts_with("1 of 4 frames have pictures of another shape"));
    assert_eq!(scene.frames[1].camera, cameras[1].camera);
    let e = scene.frames[1].load().unwrap_err().to_string();
    assert!(e.contains("001.png") && e.contains("64x48") && e.contains("got 48x64"), "{e}");
    assert!(scene.frames[2].load().is_ok());
    let pair = choose_pair(&scene).unwrap();
    assert!(!pair.frames.contains(&1), "{pair:?}");
    save(&cameras[..2]);
    let e = load_scene(&pose_file).unwrap_err().to_string();
    assert!(e.contains("001.png of 64x48") && e.contains("got 48x64"), "{e}");
}
