//! A COLMAP model of made-up cameras, in both forms.

use glam::DQuat;
use std::path::Path;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Model number, name, and parameters of a camera of 64×48 pixels.
pub type Model = (i32, &'static str, Vec<f64>);

pub fn model(k: &Intrinsics) -> Model {
    let p = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
    (4, "OPENCV", [&p[..], &[0.01, -0.02, 0.001, 0.002]].concat())
}

/// Quaternion wxyz and translation, camera from world.
fn pose(c: &Camera) -> ([f64; 4], [f64; 3]) {
    let m = c.world_from_camera().as_dmat4().inverse();
    let q = DQuat::from_mat4(&m);
    ([q.w, q.x, q.y, q.z], m.w_axis.truncate().to_array())
}

pub fn points() -> Vec<[f64; 3]> {
    (0..40).map(|i| [0.1 * f64::from(i), 0.2, 3.0 + 0.01 * f64::from(i)]).collect()
}

pub fn binary(cameras: &[NamedCamera]) -> [Vec<u8>; 3] {
    let count = |n: usize| (n as u64).to_le_bytes().to_vec();
    let (mut cams, mut images, mut pts) =
        (count(cameras.len()), count(cameras.len()), count(points().len()));
    for (i, c) in cameras.iter().enumerate() {
        let (number, _, parameters) = model(&c.camera.intrinsics());
        cams.extend((i as u32 + 7).to_le_bytes());
        cams.extend(number.to_le_bytes());
        cams.extend(64u64.to_le_bytes());
        cams.extend(48u64.to_le_bytes());
        parameters.iter().for_each(|p| cams.extend(p.to_le_bytes()));

        images.extend((i as u32).to_le_bytes());
        let (q, t) = pose(&c.camera);
        q.iter().chain(&t).for_each(|v| images.extend(v.to_le_bytes()));
        images.extend((i as u32 + 7).to_le_bytes());
        images.extend(c.file.trim_start_matches("images/").bytes());
        images.push(0);
        images.extend(3u64.to_le_bytes());
        for id in [1000u64, u64::MAX, 1001 + i as u64] {
            images.extend(1.5f64.to_le_bytes());
            images.extend(2.5f64.to_le_bytes());
            images.extend(id.to_le_bytes());
        }
    }
    for (i, p) in points().iter().enumerate() {
        pts.extend((1000 + i as u64).to_le_bytes());
        p.iter().for_each(|v| pts.extend(v.to_le_bytes()));
        pts.extend([1, 2, 3]);
        pts.extend(0.5f64.to_le_bytes());
        pts.extend(1u64.to_le_bytes());
        pts.extend([0; 8]);
    }
    [cams, images, pts]
}

pub fn text(cameras: &[NamedCamera]) -> [String; 3] {
    let mut out = [(); 3].map(|()| "# comment\n".to_owned());
    for (i, c) in cameras.iter().enumerate() {
        let (_, name, parameters) = model(&c.camera.intrinsics());
        let join = |v: &[f64]| v.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        out[0] += &format!("{} {name} 64 48 {}\n", i + 7, join(&parameters));
        let (q, t) = pose(&c.camera);
        let file = c.file.trim_start_matches("images/");
        out[1] += &format!("{i} {} {} {} {file}\n", join(&q), join(&t), i + 7);
        out[1] += &format!("1.5 2.5 1000 1.5 2.5 -1 1.5 2.5 {}\n", 1001 + i);
    }
    for (i, [x, y, z]) in points().iter().enumerate() {
        out[2] += &format!("{} {x} {y} {z} 1 2 3 0.5 0 0\n", 1000 + i);
    }
    out
}

pub fn write(folder: &Path, extension: &str, files: [&[u8]; 3]) {
    std::fs::create_dir_all(folder).unwrap();
    for (stem, bytes) in ["cameras", "images", "points3D"].iter().zip(files) {
        std::fs::write(folder.join(format!("{stem}.{extension}")), bytes).unwrap();
    }
}
