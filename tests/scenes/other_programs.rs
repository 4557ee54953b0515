//! Cameras of OpenMVG, Meshroom, 3D Scanner App, MVSNet, NeuS and of data sets with a matrix file of each picture: known
//! cameras, written as these programs write them, are read back as they were. Cameras that are not read are named.

use crate::foreign_cameras::{axes, check, npy, opengl_rows, plain, refused, rows, write};
use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use glam::{DMat3, DVec3};
use serde_json::{Value, json};
use std::io::{Cursor, Write};
use std::path::Path;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat::files::poses::find::not_read;
use subsplat::files::poses::matrices::PoseConvention;
use subsplat::files::poses::scene::{
    Scene, SceneFormat, Units, is_scene, load_cameras, load_scene,
};
use subsplat::files::poses::{mvsnet, neus};
use subsplat::{SceneOptions, load_scene_with};
use subsplat_kernels::camera::{Camera, Intrinsics};
use zip::write::SimpleFileOptions;

/// Rows of world-to-camera with OpenCV's axes.
fn camera_from_world(camera: &Camera) -> [[f64; 4]; 3] {
    let [right, down, forward, position] = axes(camera);
    [right, down, forward].map(|axis| [axis.x, axis.y, axis.z, -axis.dot(position)])
}

/// Rows of the intrinsic matrix.
fn k_rows(camera: &Camera) -> [[f64; 3]; 3] {
    let k = camera.intrinsics();
    let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
    [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
}

/// Lines of a matrix, one for each row.
fn lines<const N: usize>(rows: &[[f64; N]]) -> String {
    let line = |row: &[f64; N]| row.map(|v| v.to_string()).join(" ") + "\n";
    rows.iter().map(line).collect()
}

/// Lines of a matrix with the fourth row 0 0 0 1.
fn square(rows: &[[f64; 4]]) -> String {
    lines(rows) + "0 0 0 1\n"
}

/// Lines of the intrinsic matrix as 4×4.
fn k_square(camera: &Camera) -> String {
    square(&k_rows(camera).map(|[a, b, c]| [a, b, c, 0.0]))
}

/// Gives all cameras the intrinsics of the first.
fn one_lens(cameras: &mut [NamedCamera]) {
    let k: Intrinsics = cameras[0].camera.intrinsics();
    for c in cameras {
        c.camera = Camera::new(k, c.camera.world_from_camera()).unwrap();
    }
}

#[track_caller]
fn left_out(scene: &Scene, expected: &[(usize, &str)]) {
    let found: Vec<usize> = scene.left_out.iter().map(|left| left.entry).collect();
    assert_eq!(found, expected.iter().map(|(entry, _)| *entry).collect::<Vec<_>>());
    for (left, (_, reason)) in scene.left_out.iter().zip(expected) {
        assert!(left.reason.contains(reason), "{left:?}");
    }
}

fn mvsnet_text(camera: &Camera, depths: &str) -> String {
    let (pose, k) = (square(&camera_from_world(camera)), lines(&k_rows(camera)));
    format!("extrinsic\n{pose}\nintrinsic\n{k}\n{depths}\n")
}

#[test]
fn mvsnet_is_read() {
    let (folder, cameras) = made_up(5);
    let at = |name: &str| folder.path().join(name);
    let file = |i: usize| at(&format!("cams/{i:08}_cam.txt"));
    let put = |i: usize, depths: &str| write(&file(i), mvsnet_text(&cameras[i].camera, depths));
    let depths = ["1.5 0.1 192 20.5", "0.5 0.25 118", "2 0.1", "-1 0.1 10 90", ""];
    depths.iter().enumerate().for_each(|(i, depths)| put(i, depths));
    write(&at("cams/pair.txt"), "5\n0\n1 1 3.5\n");
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MvsNet, &cameras);
    assert!(scene.warnings.is_empty() && not_read(folder.path()).is_none(), "{:?}", scene.warnings);
    let range = scene.near_far.unwrap();
    assert_eq!([range.near, range.far], [0.5, 30.0]);
    for path in [at("cams"), file(3)] {
        assert!(load_scene(path).unwrap().frames == scene.frames);
    }
    // Pictures with the numbers of the cameras, in another folder; two depths are no range.
    std::fs::rename(at("images"), at("blended_images")).unwrap();
    for i in 0..5 {
        put(i, "425 2.5");
        let old = at(&format!("blended_images/{i:03}.png"));
        std::fs::rename(old, at(&format!("blended_images/{i:08}.png"))).unwrap();
    }
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MvsNet, &cameras);
    assert_eq!(scene.near_far, None);
    // One folder deeper, under the name of the second folder of Tanks and Temples.
    std::fs::create_dir(at("scan1")).unwrap();
    std::fs::rename(at("cams"), at("scan1/cams_1")).unwrap();
    std::fs::rename(at("blended_images"), at("scan1/images")).unwrap();
    check(&load_scene(folder.path()).unwrap(), SceneFormat::MvsNet, &cameras);
}

#[test]
fn broken_cameras_of_mvsnet_are_left_out() {
    let (folder, cameras) = made_up(5);
    let at = |i: usize| folder.path().join(format!("cams/{i:08}_cam.txt"));
    for (i, c) in cameras.iter().enumerate() {
        write(&at(i), mvsnet_text(&c.camera, "1 1 1 9"));
    }
    let good = std::fs::read_to_string(at(0)).unwrap();
    write(&at(0), &good[..good.find("intrinsic").unwrap() + 15]);
    write(&at(1), good.replacen("0 0 0 1", "0 nan 0 1", 1));
    std::fs::remove_file(folder.path().join("images/004.png")).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MvsNet, &cameras[2..4]);
    left_out(&scene, &[(0, "`intrinsic` and 9"), (1, "`nan`"), (4, "no picture on disk")]);
    for cut in 0..good.find("\n1 1 1 9").unwrap() - 1 {
        refused(
            &format!("cut at {cut}"),
            mvsnet::parse("a.txt", &good.as_bytes()[..cut]),
            &["a.txt"],
        );
    }
    let skewed = good.replacen(" 0 31.7", " 5 31.7", 1);
    assert!(skewed != good);
    refused("skew", mvsnet::parse("a.txt", skewed.as_bytes()), &["without skew"]);
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    refused("no pictures", load_scene(folder.path()), &["expected", "cam.txt"]);
}

/// Matrices in another convention are read as a person says.
#[test]
fn the_convention_of_matrices_can_be_stated() {
    let (folder, cameras) = made_up(3);
    let (inverse, direct) =
        (PoseConvention::WorldFromCameraOpenCv, PoseConvention::CameraFromWorldOpenCv);
    let with = |convention| {
        let options = SceneOptions { convention: Some(convention), ..SceneOptions::default() };
        load_scene_with(folder.path(), &options).unwrap()
    };
    for (i, c) in cameras.iter().enumerate() {
        let text = mvsnet_text(&c.camera, "1 1");
        let wrong = square(&rows(axes(&c.camera)));
        let text = text.replace(&square(&camera_from_world(&c.camera)), &wrong);
        write(&folder.path().join(format!("cams/{i:08}_cam.txt")), text);
    }
    check(&with(inverse), SceneFormat::MvsNet, &cameras);
    std::fs::remove_dir_all(folder.path().join("cams")).unwrap();
    for (i, c) in cameras.iter().enumerate() {
        let at = |name: &str| folder.path().join(format!("{name}/{i:03}.txt"));
        write(&at("pose"), square(&camera_from_world(&c.camera)));
        write(&at("intrinsics"), k_square(&c.camera));
    }
    check(&with(direct), SceneFormat::MatrixFiles, &cameras);
}

#[test]
fn scannet_is_read() {
    let (folder, mut cameras) = made_up(12);
    one_lens(&mut cameras);
    let at = |name: &str| folder.path().join(name);
    std::fs::rename(at("images"), at("color")).unwrap();
    for (i, c) in cameras.iter().enumerate() {
        let old = at(&format!("color/{i:03}.png"));
        std::fs::rename(old, at(&format!("color/{i}.png"))).unwrap();
        write(&at(&format!("pose/{i}.txt")), square(&rows(axes(&c.camera))));
    }
    write(&at("intrinsic/intrinsic_color.txt"), k_square(&cameras[0].camera));
    write(&at("intrinsic/intrinsic_depth.txt"), "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1");
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MatrixFiles, &cameras);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert_eq!(scene.units, Units::Metres);
    // Frames without a pose, a pose that is cut short, a picture that is missing.
    write(&at("pose/0.txt"), "-inf -inf -inf -inf\n".repeat(4));
    write(&at("pose/1.txt"), "1 0 0 0\n0 1 0");
    std::fs::remove_file(at("color/11.png")).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MatrixFiles, &cameras[2..11]);
    left_out(&scene, &[(0, "not finite"), (1, "7 numbers"), (11, "no picture on disk")]);
    // Intrinsics that are none, and none at all.
    write(&at("intrinsic/intrinsic_color.txt"), "1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1");
    refused("a pose", load_scene(folder.path()), &["intrinsic_color.txt", "no intrinsic matrix"]);
    std::fs::remove_dir_all(at("intrinsic")).unwrap();
    refused("none", load_scene(folder.path()), &["intrinsics of the pictures", "none"]);
}

#[test]
fn nsvf_and_nerf_plus_plus_are_read() {
    let (folder, cameras) = made_up(3);
    let at = |name: String| folder.path().join(name);
    std::fs::rename(at("images".into()), at("rgb".into())).unwrap();
    for (i, c) in cameras.iter().enumerate() {
        let line = square(&rows(axes(&c.camera))).replace('\n', " ");
        write(&at(format!("pose/{i:03}.txt")), line);
        write(&at(format!("intrinsics/{i:03}.txt")), k_square(&c.camera).replace('\n', " "));
    }
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::MatrixFiles, &cameras);
    assert_eq!(scene.units, Units::Unknown);
    // A picture without intrinsics of its own.
    std::fs::remove_file(at("intrinsics/001.txt".into())).unwrap();
    left_out(&load_scene(folder.path()).unwrap(), &[(1, "intrinsics of this picture")]);
    std::fs::remove_dir_all(at("intrinsics".into())).unwrap();
    // NSVF has the same for all pictures, as a matrix or as its first line says.
    let (_, mut cameras) = plain(3);
    one_lens(&mut cameras);
    let k = cameras[0].camera.intrinsics();
    for text in [
        k_square(&cameras[0].camera),
        lines(&k_rows(&cameras[0].camera)),
        format!("{} {} {} 0.\n0. 0. 0.\n0.1\n1.0\n48 64\n", k.fx, k.cx, k.cy),
    ] {
        write(&at("intrinsics.txt".into()), text);
        check(&load_scene(folder.path()).unwrap(), SceneFormat::MatrixFiles, &cameras);
    }
    // The parts of NeRF++ lie in folders; the one with most poses that has pictures is read.
    for name in ["pose", "rgb", "intrinsics.txt"] {
        let inside = at(format!("train/{name}"));
        std::fs::create_dir_all(inside.parent().unwrap()).unwrap();
        std::fs::rename(at(name.into()), inside).unwrap();
    }
    for i in 0..9 {
        write(&at(format!("camera_path/pose/{i:03}.txt")), square(&rows(axes(&cameras[0].camera))));
    }
    write(&at("camera_path/intrinsics.txt".into()), k_square(&cameras[0].camera));
    check(&load_scene(folder.path()).unwrap(), SceneFormat::MatrixFiles, &cameras);
}

#[test]
fn the_7_scenes_are_read() {
    let (folder, mut cameras) = made_up(3);
    one_lens(&mut cameras);
    let at = |name: String| folder.path().join(name);
    for (i, c) in cameras.iter().enumerate() {
        let name = format!("seq-01/frame-{i:06}");
        write(&at(format!("{name}.pose.txt")), square(&rows(axes(&c.camera))));
        std::fs::rename(at(c.file.clone()), at(format!("{name}.color.png"))).unwrap();
        save_png(at(format!("{name}.depth.png")), &noise(64, 48)).unwrap();
    }
    std::fs::remove_dir(at("images".into())).unwrap();
    let sequence = at("seq-01".into());
    let scene = load_scene(&sequence).unwrap();
    // 585 px at 640×480 are 58.5 px at 64×48.
    let k = scene.frames[1].camera.intrinsics();
    assert_eq!([k.fx, k.fy, k.cx, k.cy], [58.5, 58.5, 32.0, 24.0]);
    assert_eq!(scene.units, Units::Metres);
    assert!(scene.warnings.iter().any(|line| line.contains("585 px")), "{:?}", scene.warnings);
    // Intrinsics in the folder above, as 3DMatch has them, and in the folder itself.
    for file in ["camera-intrinsics.txt", "seq-01/intrinsics.txt"] {
        write(&at(file.into()), lines(&k_rows(&cameras[0].camera)));
        let scene = load_scene(&sequence).unwrap();
        check(&scene, SceneFormat::MatrixFiles, &cameras);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        std::fs::remove_file(at(file.into())).unwrap();
    }
    assert_eq!(load_scene(sequence.join("frame-000000.pose.txt")).unwrap().frames.len(), 3);
    assert_eq!(load_scene(folder.path()).unwrap().frames.len(), 3);
}

/// OpenMVG's file; `lens` gives the model and the coefficients of a camera.
fn openmvg(cameras: &[NamedCamera], lens: &dyn Fn(usize) -> (&'static str, Value)) -> Value {
    let (mut views, mut intrinsics, mut extrinsics) = (Vec::new(), Vec::new(), Vec::new());
    let mut named: Vec<&str> = Vec::new();
    for (i, c) in cameras.iter().enumerate() {
        let k = c.camera.intrinsics();
        let name = c.file.trim_start_matches("images/");
        views.push(json!({ "key": i, "value": { "polymorphic_id": 1073741824u32, "ptr_wrapper": {
            "id": 2147483649u32 + i as u32, "data": {
                "local_path": "", "filename": name, "width": 64, "height": 48,
                "id_view": i, "id_intrinsic": 10 + i, "id_pose": 20 + i } } } }));
        let (model, coefficients) = lens(i);
        let mut data = json!({ "width": 64, "height": 48, "focal_length": k.fx, "principal_point": [k.cx, k.cy] });
        if let Some(object) = coefficients.as_object() {
            object.iter().for_each(|(key, value)| data[key] = value.clone());
        }
        // The first use of a name has the highest bit, and later ones have no name.
        let mut value = json!({ "ptr_wrapper": { "id": 2147483749u32 + i as u32, "data": data } });
        match named.iter().position(|own| *own == model) {
            Some(id) => value["polymorphic_id"] = json!(1 + id),
            None => {
                named.push(model);
                value["polymorphic_id"] = json!((1u32 << 31) + named.len() as u32);
                value["polymorphic_name"] = json!(model);
            }
        }
        intrinsics.push(json!({ "key": 10 + i, "value": value }));
        let [right, down, forward, position] = axes(&c.camera).map(|v| v.to_array());
        extrinsics.push(json!({ "key": 20 + i, "value": { "rotation": [right, down, forward], "center": position } }));
    }
    json!({ "sfm_data_version": "0.3", "root_path": "/another/machine", "views": views, "intrinsics": intrinsics,
            "extrinsics": extrinsics, "control_points": [], "structure": [
        { "key": 0, "value": { "X": [0.5, 0.25, 4.0], "observations": [{ "key": 0, "value": { "id_feat": 1, "x": [1, 2] } }] } },
        { "key": 1, "value": { "X": [f64::NAN, 0.0, 1.0], "observations": [] } } ] })
}

#[test]
fn openmvg_is_read() {
    let (folder, cameras) = plain(6);
    let at = |name: &str| folder.path().join(name);
    let lens = |i: usize| match i {
        0 | 5 => ("pinhole_radial_k3", json!({ "disto_k3": [0.1, 0.2, 0.3] })),
        1 => ("pinhole", Value::Null),
        2 => ("pinhole_radial_k1", json!({ "disto_k1": [0.1] })),
        3 => ("pinhole_brown_t2", json!({ "disto_t2": [0.1, 0.2, 0.3, 0.01, 0.02] })),
        _ => ("fisheye", json!({ "fisheye": [0.1, 0.2, 0.3, 0.4] })),
    };
    let file = openmvg(&cameras, &lens);
    write(&at("reconstruction/sfm_data.json"), file.to_string());
    let mut photographs = file.clone();
    photographs["extrinsics"] = json!([]);
    write(&at("sfm_data.json"), photographs.to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::OpenMvg, &cameras);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert_eq!(scene.points.as_deref(), Some(&[glam::Vec3::new(0.5, 0.25, 4.0)][..]));
    let brown = |k: [f64; 3], p| Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], p);
    let expected = [
        brown([0.1, 0.2, 0.3], [0.0; 2]),
        Distortion::None,
        brown([0.1, 0.0, 0.0], [0.0; 2]),
        brown([0.1, 0.2, 0.3], [0.01, 0.02]),
        Distortion::fisheye([0.1, 0.2, 0.3, 0.4]),
        brown([0.1, 0.2, 0.3], [0.0; 2]),
    ];
    assert_eq!(scene.frames.iter().map(|f| f.distortion).collect::<Vec<_>>(), expected);
    // A file of any name, found by content; cameras alone.
    std::fs::rename(at("reconstruction/sfm_data.json"), at("robust.json")).unwrap();
    assert!(load_scene(folder.path()).unwrap().frames == scene.frames);
    assert_eq!(load_cameras(at("robust.json")).unwrap().frames.len(), 6);
}

#[test]
fn broken_views_of_openmvg_are_left_out() {
    let (folder, cameras) = plain(8);
    let path = folder.path().join("sfm_data.json");
    let mut file = openmvg(&cameras, &|_| ("pinhole", Value::Null));
    file["extrinsics"][0]["key"] = json!(99);
    file["extrinsics"][1]["value"]["center"] = json!([0, null]);
    file["extrinsics"][2]["value"]["center"] = json!([0, null, 1]);
    file["intrinsics"][3]["value"]["polymorphic_name"] = json!("omnidirectional");
    file["intrinsics"][3]["value"]["polymorphic_id"] = json!(2147483650u32);
    file["intrinsics"][4]["value"]["ptr_wrapper"]["data"]["principal_point"] = json!([1]);
    // A panorama, whose world is mirrored.
    file["intrinsics"][5]["value"]["polymorphic_name"] = json!("spherical");
    file["intrinsics"][5]["value"]["polymorphic_id"] = json!(2147483651u32);
    write(&path, file.to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::OpenMvg, &cameras[6..]);
    let reasons = [
        (0, "a pose"),
        (1, "a center of three"),
        (2, "NaN"),
        (3, "`omnidirectional`"),
        (4, "principal_point of 2"),
        (5, "`spherical`"),
    ];
    left_out(&scene, &reasons);
    let text = file.to_string();
    write(&path, &text[..text.len() / 2]);
    refused("cut", load_scene(&path), &["sfm_data.json"]);
    assert!(!is_scene(folder.path()));
    // A list of photographs is no scene.
    file["extrinsics"] = json!([]);
    write(&path, file.to_string());
    assert!(!is_scene(folder.path()));
}

/// Meshroom's file of a version, with every number as a text.
fn meshroom(cameras: &[NamedCamera], version: [u32; 3], model: [&str; 2], k: &[f64]) -> Value {
    let text = |v: f64| json!(v.to_string());
    let texts = |v: &[f64]| json!(v.iter().map(|v| v.to_string()).collect::<Vec<_>>());
    let (mut views, mut intrinsics, mut poses) = (Vec::new(), Vec::new(), Vec::new());
    for (i, c) in cameras.iter().enumerate() {
        let [fx, fy, cx, cy] = {
            let k = c.camera.intrinsics();
            [k.fx, k.fy, k.cx, k.cy].map(f64::from)
        };
        let name = c.file.trim_start_matches("images/");
        views.push(json!({ "viewId": (7 + i).to_string(), "poseId": (7 + i).to_string(), "metadata": "",
            "intrinsicId": (50 + i).to_string(), "path": format!("C:/photos/images/{name}"), "width": "64", "height": "48" }));
        let mut intrinsic = json!({ "intrinsicId": (50 + i).to_string(), "width": "64", "height": "48",
            "sensorWidth": "23.5", "sensorHeight": "17", "type": model[0], "distortionParams": texts(k), "locked": "0" });
        if version < [1, 2, 0] {
            intrinsic["pxFocalLength"] = text(fx);
        } else if version < [1, 2, 2] {
            intrinsic["pxFocalLength"] = texts(&[fx, fy]);
        } else {
            intrinsic["focalLength"] = text(fx / 64.0 * 23.5);
            intrinsic["pixelRatio"] = text(if version < [1, 2, 5] { fx / fy } else { fy / fx });
        }
        let from_middle = version >= [1, 2, 1];
        intrinsic["principalPoint"] =
            texts(&if from_middle { [cx - 32.0, cy - 24.0] } else { [cx, cy] });
        if version >= [1, 2, 8] {
            intrinsic["distortionType"] = json!(model[1]);
            intrinsic["undistortionType"] = json!("none");
        }
        intrinsics.push(intrinsic);
        let [right, down, forward, position] = axes(&c.camera);
        // The rotation from the world has these rows; its columns are written.
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        poses.push(json!({ "poseId": (7 + i).to_string(), "pose": { "locked": "1", "transform": {
            "rotation": texts(&rotation.to_cols_array()), "center": texts(&position.to_array()) } } }));
    }
    json!({ "version": version.map(|v| v.to_string()), "views": views, "intrinsics": intrinsics, "poses": poses,
        "structure": [{ "landmarkId": "3", "X": ["0.5", "0.25", "4"] }, { "landmarkId": "4", "X": ["nan", "0", "1"] }] })
}

#[test]
fn meshroom_is_read() {
    let brown = |k: [f64; 3], p| Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], p);
    let k3 = brown([0.1, 0.2, 0.3], [0.0; 2]);
    for (version, model, k, expected) in [
        ([1, 0, 0], ["radial3", ""], &[0.1, 0.2, 0.3][..], k3),
        ([1, 1, 0], ["radial1", ""], &[0.1], brown([0.1, 0.0, 0.0], [0.0; 2])),
        ([1, 2, 0], ["pinhole", ""], &[], Distortion::None),
        (
            [1, 2, 1],
            ["brown", ""],
            &[0.1, 0.2, 0.3, 0.01, 0.02],
            brown([0.1, 0.2, 0.3], [0.01, 0.02]),
        ),
        (
            [1, 2, 2],
            ["fisheye4", ""],
            &[0.1, 0.2, 0.3, 0.4],
            Distortion::fisheye([0.1, 0.2, 0.3, 0.4]),
        ),
        ([1, 2, 5], ["radial3", ""], &[0.1, 0.2], Distortion::None),
        ([1, 2, 8], ["pinhole", "radialk3"], &[0.1, 0.2, 0.3], k3),
        ([1, 2, 14], ["pinhole", "none"], &[], Distortion::None),
    ] {
        // Before 1.2.0 there is one focal length.
        let (folder, mut cameras) = if version < [1, 2, 0] { plain(3) } else { made_up(3) };
        cameras.iter_mut().for_each(|c| c.timestamp = None);
        let path = folder.path().join("cameras.sfm");
        write(&path, meshroom(&cameras, version, model, k).to_string());
        let scene = load_scene(folder.path()).unwrap();
        check(&scene, SceneFormat::Meshroom, &cameras);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        assert!(scene.frames.iter().all(|f| f.distortion == expected), "{version:?}");
        assert_eq!(scene.points.as_deref(), Some(&[glam::Vec3::new(0.5, 0.25, 4.0)][..]));
        assert!(load_scene(&path).unwrap().frames == scene.frames);
        // In the folder of the program's results, and as JSON of any name.
        let cached = "MeshroomCache/StructureFromMotion/1f2e/cameras.sfm";
        for other in [cached, "sfm.json", "scene.sfm", "my cameras.json"] {
            let other = folder.path().join(other);
            std::fs::create_dir_all(other.parent().unwrap()).unwrap();
            std::fs::copy(&path, &other).unwrap();
            let options = SceneOptions {
                images: Some(folder.path().join("images")),
                ..SceneOptions::default()
            };
            std::fs::remove_file(&path).unwrap();
            assert!(
                load_scene_with(folder.path(), &options).unwrap().frames == scene.frames,
                "{other:?}"
            );
            std::fs::rename(&other, &path).unwrap();
        }
    }
}

#[test]
fn broken_views_of_meshroom_are_left_out() {
    let (folder, cameras) = made_up(8);
    let path = folder.path().join("cameras.sfm");
    let mut file = meshroom(&cameras, [1, 2, 8], ["pinhole", "none"], &[]);
    file["poses"][0]["poseId"] = json!("1");
    file["poses"][1]["pose"]["transform"]["rotation"][4] = json!("nan");
    file["intrinsics"][2]["type"] = json!("equidistant");
    file["intrinsics"][3]["undistortionType"] = json!("3deanamorphic4");
    file["views"][4]["isPoseIndependant"] = json!("false");
    file["intrinsics"][5]["focalLength"] = json!("");
    write(&path, file.to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Meshroom, &cameras[6..]);
    let reasons = [
        (0, "a pose"),
        (1, "NaN"),
        (2, "`equidistant`"),
        (3, "`3deanamorphic4`"),
        (4, "one of a rig"),
        (5, "focalLength"),
    ];
    left_out(&scene, &reasons);
    file["version"] = json!([1, 2]);
    write(&path, file.to_string());
    refused("version", load_scene(&path), &["a version of three numbers"]);
    let text = file.to_string();
    write(&path, &text[..text.len() / 2]);
    refused("cut", load_scene(&path), &["cameras.sfm"]);
    // A list of photographs is no scene.
    file["poses"] = json!([]);
    write(&path, file.to_string());
    std::fs::copy(&path, folder.path().join("photographs.json")).unwrap();
    assert!(!is_scene(folder.path()));
}

/// The 12 numbers of K·[R | t], times `scale`.
fn projection(camera: &Camera, scale: f64, skew: f64) -> Vec<f64> {
    let pose = camera_from_world(camera);
    let mut k = k_rows(camera);
    k[0][1] = skew;
    let row =
        |k: &[f64; 3]| [0, 1, 2, 3].map(|j| scale * (0..3).map(|i| k[i] * pose[i][j]).sum::<f64>());
    k.iter().flat_map(row).collect()
}

fn npz(arrays: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, bytes) in arrays {
        archive.start_file(format!("{name}.npy"), options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

/// Arrays `world_mat_N` as NeuS has them, and `scale_mat_N`.
fn neus_arrays(cameras: &[NamedCamera]) -> Vec<(String, Vec<u8>)> {
    let array = |(i, c): (usize, &NamedCamera)| {
        let mut world = projection(&c.camera, [1.0, -2.5, 0.01][i % 3], 0.0);
        world.extend([0.0, 0.0, 0.0, 1.0]);
        let scale =
            [3.0, 0.0, 0.0, 1.0, 0.0, 3.0, 0.0, 2.0, 0.0, 0.0, 3.0, 3.0, 0.0, 0.0, 0.0, 1.0];
        let scale = npy("'<f8'", "(4, 4)", &scale);
        [
            (format!("scale_mat_{i}"), scale),
            (format!("world_mat_{i}"), npy("'<f8'", "(4, 4)", &world)),
        ]
    };
    cameras.iter().enumerate().flat_map(array).collect()
}

#[test]
fn neus_is_read() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    std::fs::rename(at("images"), at("image")).unwrap();
    let path = at("cameras_sphere.npz");
    let mut arrays = neus_arrays(&cameras);
    write(&path, npz(&arrays));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Neus, &cameras);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert!(scene.frames.iter().all(|f| f.distortion == Distortion::None && f.mask.is_none()));
    // Masks by order; an array by columns, one of 3×4, one with skew.
    std::fs::create_dir(at("mask")).unwrap();
    for i in 0..4 {
        save_png(at(&format!("mask/{i}.png")), &noise(64, 48)).unwrap();
    }
    let p = projection(&cameras[0].camera, 1.0, 0.0);
    let columns: Vec<f64> = (0..12).map(|i| p[i % 3 * 4 + i / 3]).collect();
    let mut bytes = npy("'<f8'", "(3, 4)", &columns);
    let word = bytes.windows(5).position(|w| w == b"False").unwrap();
    bytes[word..word + 5].copy_from_slice(b"True ");
    arrays[1].1 = bytes;
    let fx = f64::from(cameras[1].camera.intrinsics().fx);
    arrays[3].1 = npy("'<f8'", "(3, 4)", &projection(&cameras[1].camera, -1.0, 0.02 * fx));
    std::fs::remove_file(&path).unwrap();
    write(&at("cameras.npz"), npz(&arrays));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Neus, &cameras);
    assert_eq!(scene.frames[2].mask, Some(at("mask/2.png")));
    let Distortion::Polynomial { skew, .. } = scene.frames[1].distortion else {
        panic!("{:?}", scene.frames[1].distortion)
    };
    assert!((skew - 0.02).abs() < 1e-6, "{skew}");
}

#[test]
fn hostile_archives_of_neus() {
    let (folder, cameras) = made_up(4);
    let path = folder.path().join("cameras.npz");
    let arrays = neus_arrays(&cameras);
    let good = npz(&arrays);
    for cut in 0..good.len() {
        let read = neus::parse("a.npz", &good[..cut]);
        refused(&format!("cut at {cut}"), read, &["a.npz"]);
    }
    let mut broken = arrays.clone();
    broken[1].1 = npy("'<f8'", "(4, 4)", &[f64::NAN; 16]);
    broken[3].1 = npy("'<f8'", "(16,)", &[1.0; 16]);
    write(&path, npz(&broken));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Neus, &cameras[2..]);
    left_out(&scene, &[(0, "a projection K"), (1, "(16, 1)")]);
    // No rotation: the rows of M lie in a plane.
    broken[3].1 = npy("'<f8'", "(3, 4)", &[1.0; 12]);
    write(&path, npz(&broken));
    left_out(&load_scene(folder.path()).unwrap(), &[(0, "a projection K"), (1, "a projection K")]);
    refused("one missing", neus::parse("a.npz", &npz(&arrays[2..])), &["world_mat_0.npy", "3 of"]);
    refused("none", neus::parse("a.npz", &npz(&[])), &["world_mat_0.npy", "0 of"]);
}

/// Numbers in the names of pictures say which one is missing.
#[test]
fn a_picture_of_neus_may_be_missing() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    write(&at("cameras.npz"), npz(&neus_arrays(&cameras)));
    let names: Vec<&str> = cameras.iter().map(|c| c.file.trim_start_matches("images/")).collect();
    std::fs::create_dir(at("mask")).unwrap();
    for name in &names {
        save_png(at("mask").join(name), &noise(64, 48)).unwrap();
    }
    std::fs::remove_file(at("images").join(names[2])).unwrap();
    let gap = [cameras[0].clone(), cameras[1].clone(), cameras[3].clone()];
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Neus, &gap);
    left_out(&scene, &[(2, "no picture on disk")]);
    let entries: Vec<usize> = scene.frames.iter().map(|frame| frame.entry).collect();
    assert_eq!(entries, [0, 1, 3]);
    assert_eq!(scene.frames[2].mask, Some(at("mask").join(names[3])));
    // Names from 1 on.
    for i in [3, 1, 0] {
        let to = format!("images/p{}.png", i + 1);
        std::fs::rename(at("images").join(names[i]), at(&to)).unwrap();
    }
    let scene = load_scene(folder.path()).unwrap();
    let entries: Vec<usize> = scene.frames.iter().map(|frame| frame.entry).collect();
    assert_eq!(entries, [0, 1, 3]);
    // Neither the first number nor the last.
    std::fs::remove_file(at("images/p4.png")).unwrap();
    refused("a picture", load_scene(folder.path()), &["4 pictures", "0, 2, 0", "numbers"]);
}

#[test]
fn scanner_app_is_read() {
    let (folder, cameras) = made_up(6);
    let at = |name: String| folder.path().join(name);
    for (i, c) in cameras.iter().enumerate() {
        let (m, k) = (opengl_rows(&c.camera), k_rows(&c.camera));
        let rows: Vec<f64> = m.concat().into_iter().chain([0.0, 0.0, 0.0, 1.0]).collect();
        let transposed = |v: &[f64], n: usize| -> Vec<f64> {
            (0..n * n).map(|j| v[j % n * n + j / n]).collect()
        };
        let k = k.concat();
        let (pose, k) =
            if i % 2 == 0 { (rows, k) } else { (transposed(&rows, 4), transposed(&k, 3)) };
        let frame = json!({ "cameraPoseARFrame": pose, "intrinsics": k, "frame_index": i, "motionQuality": 1.0 });
        write(&at(format!("frame_{i:05}.json")), frame.to_string());
        std::fs::rename(at(c.file.clone()), at(format!("frame_{i:05}.png"))).unwrap();
    }
    write(&at("info.json".into()), "{\"frames\": 6}");
    std::fs::remove_dir(at("images".into())).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::ScannerApp, &cameras);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert_eq!(scene.units, Units::Metres);
    // Maps of confidence are no photographs without a camera.
    for name in ["conf_00000.png", "conference.png"] {
        save_png(at(name.into()), &noise(64, 48)).unwrap();
    }
    let warnings = load_scene(folder.path()).unwrap().warnings;
    assert!(warnings.len() == 1 && warnings[0].starts_with("1 of 7 pictures"), "{warnings:?}");
    ["conf_00000.png", "conference.png"]
        .iter()
        .for_each(|name| std::fs::remove_file(at((*name).into())).unwrap());
    write(&at("frame_00001.json".into()), "{");
    write(
        &at("frame_00002.json".into()),
        json!({ "cameraPoseARFrame": [1, 2], "intrinsics": [1] }).to_string(),
    );
    let pose: Vec<Value> = std::iter::once(Value::Null).chain((1..16).map(|v| json!(v))).collect();
    write(
        &at("frame_00003.json".into()),
        json!({ "cameraPoseARFrame": pose, "intrinsics": [1] }).to_string(),
    );
    std::fs::remove_file(at("frame_00004.png".into())).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::ScannerApp, &[cameras[0].clone(), cameras[5].clone()]);
    let finite = "16 finite numbers";
    left_out(&scene, &[(1, "EOF"), (2, finite), (3, finite), (4, "no picture on disk")]);
}

/// Cameras that are not read are named, with what to do.
#[test]
fn cameras_that_are_not_read_are_named() {
    let named = |files: &[(&str, &str)]| {
        let folder = tempfile::tempdir().unwrap();
        files.iter().for_each(|(name, text)| write(&folder.path().join(name), text));
        assert!(!is_scene(folder.path()), "{files:?}");
        not_read(folder.path())
    };
    let xmp =
        "<x:xmpmeta><rdf:Description xcr:Version=\"3\" xcr:PosePrior=\"initial\"/></x:xmpmeta>";
    let pose = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n";
    for (files, words) in [
        (
            &[("odometry.csv", "timestamp, frame"), ("camera_matrix.csv", "1, 0, 2")][..],
            ["Stray Scanner", "COLMAP"],
        ),
        (
            &[("groundtruth.txt", "# ground truth"), ("rgb.txt", "# color")],
            ["TUM RGB-D", "no intrinsics"],
        ),
        (
            &[("sensors/trajectories.txt", "# kapture format: 1.1"), ("sensors/sensors.txt", "")],
            ["Kapture", "kapture_export_colmap.py"],
        ),
        (
            &[("1_initial/params/a_calibrated_external_camera_parameters.txt", "imageName X")],
            ["Pix4D", "COLMAP"],
        ),
        (&[("images/a.xmp", xmp)], ["RealityCapture", "CSV"]),
        (&[("a.xmp", xmp)], ["RealityCapture", "CSV"]),
        (&[("traj.txt", pose)], ["Replica", "no intrinsics"]),
        (&[("camera_path.json", "{}")], ["nerfstudio", "COLMAP"]),
        (&[("a.rcproj", "")], ["RealityCapture project", "CSV"]),
    ] {
        let line = named(files).unwrap_or_default();
        assert!(words.iter().all(|word| line.contains(word)), "{files:?}: {line}");
    }
    for files in [
        &[("odometry.csv", "x")][..],
        &[("rgb.txt", "x")],
        &[("traj.txt", "a story\n")],
        &[("a.xmp", "<x:xmpmeta crs:Version=\"3\"/>")],
    ] {
        assert_eq!(named(files), None, "{files:?}");
    }
}

/// The same cameras in each layout are equal.
#[test]
fn all_layouts_have_the_same_cameras() {
    let (_, mut cameras) = plain(3);
    one_lens(&mut cameras);
    type Writer = fn(&Path, &[NamedCamera]);
    let layouts: [(SceneFormat, Writer); 6] = [
        (SceneFormat::MvsNet, |at, cameras| {
            for (i, c) in cameras.iter().enumerate() {
                write(&at.join(format!("cams/{i:08}_cam.txt")), mvsnet_text(&c.camera, "1 1"));
            }
        }),
        (SceneFormat::MatrixFiles, |at, cameras| {
            write(&at.join("intrinsics.txt"), lines(&k_rows(&cameras[0].camera)));
            for (i, c) in cameras.iter().enumerate() {
                write(&at.join(format!("pose/{i:03}.txt")), square(&rows(axes(&c.camera))));
            }
        }),
        (SceneFormat::OpenMvg, |at, cameras| {
            let file = openmvg(cameras, &|_| ("pinhole", Value::Null));
            write(&at.join("sfm_data.json"), file.to_string());
        }),
        (SceneFormat::Meshroom, |at, cameras| {
            let file = meshroom(cameras, [1, 2, 8], ["pinhole", "none"], &[]);
            write(&at.join("cameras.sfm"), file.to_string());
        }),
        (SceneFormat::Neus, |at, cameras| {
            write(&at.join("cameras_sphere.npz"), npz(&neus_arrays(cameras)));
        }),
        (SceneFormat::ScannerApp, |at, cameras| {
            for (i, c) in cameras.iter().enumerate() {
                let m = opengl_rows(&c.camera).concat();
                let pose: Vec<f64> = m.into_iter().chain([0.0, 0.0, 0.0, 1.0]).collect();
                let frame =
                    json!({ "cameraPoseARFrame": pose, "intrinsics": k_rows(&c.camera).concat() });
                write(&at.join(format!("frame_{i:05}.json")), frame.to_string());
                std::fs::copy(at.join(&c.file), at.join(format!("frame_{i:05}.png"))).unwrap();
            }
        }),
    ];
    for (format, put) in layouts {
        let (folder, _) = plain(3);
        put(folder.path(), &cameras);
        let scene = load_scene(folder.path()).unwrap();
        check(&scene, format, &cameras);
        let position = scene.frames[2].camera.world_from_camera().w_axis.truncate().as_dvec3();
        assert!(position.distance(DVec3::new(2.0, 0.3, -1.4)) < 1e-5, "{format:?} {position}");
    }
}
