//! A made-up scene: pictures of noise, and cameras that nothing is special about.

use super::noise::noise;
use glam::{Mat4, Quat, Vec3};
use subsplat::files::photos::image;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// A folder with `n` pictures of 64×48 and cameras that nothing is special about.
pub fn made_up(n: usize) -> (tempfile::TempDir, Vec<NamedCamera>) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    let cameras = (0..n).map(|i| {
        let file = format!("images/{i:03}.png");
        image::save_png(folder.path().join(&file), &noise(64, 48)).unwrap();
        let t = i as f32;
        let k = Intrinsics {
            fx: 70.1 + t,
            fy: 71.3 + t,
            cx: 31.7 - 0.1 * t,
            cy: 24.9,
            width: 64,
            height: 48,
        };
        let rotation = Quat::from_euler(glam::EulerRot::XYZ, 0.1 * t, 0.7 - 0.2 * t, 0.3 + t);
        let pose = Mat4::from_rotation_translation(rotation, Vec3::new(t, 0.3, -0.7 * t));
        let camera = Camera::new(k, pose).unwrap();
        let timestamp = (i % 2 == 0).then_some(i as i64);
        NamedCamera { timestamp, ..NamedCamera::new(file, camera) }
    });
    let cameras = cameras.collect();
    (folder, cameras)
}
