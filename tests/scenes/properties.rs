//! Properties of files of cameras, on random cases of a fixed seed: any cameras, written in the convention of a
//! format, are read back.

use crate::foreign_cameras::{check, opengl_rows, plain};
use glam::{Mat4, Quat, Vec3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use serde_json::json;
use std::path::Path;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::files::poses::colmap::save_colmap;
use subsplat::files::poses::matrices::{self, PoseConvention};
use subsplat::files::poses::scene::{SceneFormat, load_scene};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Cameras of a case.
const COUNT: usize = 3;

/// Poses of any direction near the origin, with focal lengths from fisheye to tele.
fn cameras() -> impl Strategy<Value = Vec<(Quat, Vec3, f32)>> {
    let q = prop::array::uniform4(-1.0..1.0f32)
        .prop_filter("no direction", |q| Quat::from_array(*q).length() > 0.1);
    let one = (q, prop::array::uniform3(-20.0..20.0f32), 20.0..2000.0f32);
    let one = one.prop_map(|(q, at, f)| (Quat::from_array(q).normalize(), Vec3::from(at), f));
    prop::collection::vec(one, COUNT)
}

/// The cameras of a folder with these poses; all have the focal length of the first one where `common`.
fn posed(of: &[NamedCamera], poses: &[(Quat, Vec3, f32)], common: bool) -> Vec<NamedCamera> {
    let one = |(camera, (q, at, f)): (&NamedCamera, &(Quat, Vec3, f32))| {
        let f = if common { poses[0].2 } else { *f };
        let k = Intrinsics { fx: f, fy: f, ..camera.camera.intrinsics() };
        let pose = Mat4::from_rotation_translation(*q, *at);
        NamedCamera { camera: Camera::new(k, pose).unwrap(), timestamp: None, ..camera.clone() }
    };
    of.iter().zip(poses).map(one).collect()
}

fn line(numbers: &[f32]) -> String {
    numbers.iter().map(f32::to_string).collect::<Vec<_>>().join(" ")
}

/// Writes `poses.txt`, each pose by `rows`, and `K.txt`.
fn save_matrices(folder: &Path, cameras: &[NamedCamera], rows: impl Fn(&Camera) -> Mat4) {
    let poses = cameras.iter().map(|c| line(&rows(&c.camera).transpose().to_cols_array()));
    std::fs::write(folder.join("poses.txt"), poses.collect::<Vec<_>>().join("\n")).unwrap();
    let k = cameras[0].camera.intrinsics();
    std::fs::write(folder.join("K.txt"), line(&[k.fx, k.fy, k.cx, k.cy])).unwrap();
}

fn transforms(cameras: &[NamedCamera]) -> String {
    let frame = |c: &NamedCamera| {
        let k = c.camera.intrinsics();
        let [a, b, d] = opengl_rows(&c.camera);
        json!({ "file_path": c.file, "transform_matrix": [a, b, d, [0.0, 0.0, 0.0, 1.0]],
            "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height })
    };
    json!({ "frames": cameras.iter().map(frame).collect::<Vec<_>>() }).to_string()
}

#[test]
fn cameras_of_any_pose_are_read_in_every_convention() {
    let (folder, start) = plain(COUNT);
    let at = |name: &str| folder.path().join(name);
    let config = ProptestConfig {
        cases: 64,
        rng_seed: RngSeed::Fixed(0x5EED),
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    proptest!(config, |(poses in cameras())| {
        let cameras = posed(&start, &poses, false);
        let content = CameraFile { cameras: cameras.clone(), ..Default::default() };
        save_cameras_json(at("cameras.json"), &content).unwrap();
        check(&load_scene(at("cameras.json")).unwrap(), SceneFormat::CamerasJson, &cameras);
        std::fs::write(at("transforms.json"), transforms(&cameras)).unwrap();
        check(&load_scene(at("transforms.json")).unwrap(), SceneFormat::Transforms, &cameras);
        let named = |c: &NamedCamera| (c.file.replace("images/", ""), c.camera);
        let list: Vec<_> = cameras.iter().map(named).collect();
        save_colmap(at("text"), &list, &[]).unwrap();
        check(&load_scene(at("text/cameras.txt")).unwrap(), SceneFormat::Colmap, &cameras);
        // One K for all.
        let cameras = posed(&start, &poses, true);
        let flip = Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
        type Rows<'a> = &'a dyn Fn(&Camera) -> Mat4;
        let conventions: [(PoseConvention, Rows<'_>); 3] = [
            (PoseConvention::WorldFromCameraOpenCv, &|c| c.world_from_camera()),
            (PoseConvention::WorldFromCameraOpenGl, &|c| c.world_from_camera() * flip),
            (PoseConvention::CameraFromWorldOpenCv, &|c| c.camera_from_world()),
        ];
        for (convention, rows) in conventions {
            save_matrices(folder.path(), &cameras, rows);
            let scene = matrices::load(folder.path(), convention).unwrap();
            check(&scene, SceneFormat::Matrices, &cameras);
        }
    });
}
