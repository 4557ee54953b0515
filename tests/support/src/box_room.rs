//! A box-shaped room with noise on its walls, which is seen in any direction: pictures of lenses of any kind.

use glam::{DMat3, DVec2, DVec3, Mat4};
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};
use subsplat::kernels::camera::{Camera, Intrinsics};
use subsplat::{EstimatedScene, Rgb, save_png};

/// Half of the room's sides; its middle is the origin, +y is down.
const HALF: DVec3 = DVec3::new(2.0, 1.3, 2.6);
/// Sides of the cells of noise, and their weights.
const OCTAVES: [[f64; 2]; 3] = [[0.5, 0.35], [0.2, 0.35], [0.08, 0.3]];

/// Colour that an eye at `from`, inside the room, sees in `direction`.
pub fn colour(from: DVec3, direction: DVec3) -> [u8; 3] {
    // The nearest wall in front.
    let reach = |from: f64, d: f64, half: f64| (half * d.signum() - from) / d;
    let times = [
        reach(from.x, direction.x, HALF.x),
        reach(from.y, direction.y, HALF.y),
        reach(from.z, direction.z, HALF.z),
    ];
    let time = times.into_iter().filter(|t| t.is_finite() && *t > 0.0).fold(f64::MAX, f64::min);
    let at = from + direction * time;
    [0.0, 40.0, 80.0].map(|channel| {
        let noise: f64 =
            OCTAVES.iter().map(|[side, weight]| weight * noise(at / *side + channel)).sum();
        (30.0 + 200.0 * noise) as u8
    })
}

/// Noise between the corners of whole numbers, 0 to 1.
fn noise(at: DVec3) -> f64 {
    let base = at.floor();
    let t = at - base;
    let t = t * t * (DVec3::splat(3.0) - 2.0 * t);
    let mut sum = 0.0;
    for corner in 0..8u32 {
        let bit = |i: u32| f64::from(corner >> i & 1);
        let step = DVec3::new(bit(0), bit(1), bit(2));
        let side = |step: f64, t: f64| if step > 0.0 { t } else { 1.0 - t };
        let weight = side(step.x, t.x) * side(step.y, t.y) * side(step.z, t.z);
        sum += weight * hash(base + step);
    }
    sum
}

fn hash(at: DVec3) -> f64 {
    let mut state = 0x9E37_79B9_7F4A_7C15u64;
    for v in at.to_array() {
        state = (state ^ (v as i64 as u64)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        state ^= state >> 31;
    }
    (state >> 40) as f64 / (1u64 << 24) as f64
}

/// A picture of `width` × `height` px whose pixels see the direction that `ray` gives for their centres, in the
/// world; black where there is none.
pub fn picture(
    [width, height]: [usize; 2],
    from: DVec3,
    ray: impl Fn(DVec2) -> Option<DVec3>,
) -> Rgb {
    let pixel = |i: usize| {
        let px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        ray(px).map_or([0; 3], |direction| colour(from, direction))
    };
    Rgb { width, height, data: (0..width * height).flat_map(pixel).collect() }
}

/// An equirectangular panorama, `width` px wide, of a camera with the axes `world_from_camera` (x right, y down,
/// z ahead, in the middle of the picture).
pub fn panorama(width: usize, from: DVec3, world_from_camera: DMat3) -> Rgb {
    let height = width / 2;
    picture([width, height], from, |px| {
        let longitude = (px.x / width as f64 - 0.5) * TAU;
        let latitude = (px.y / height as f64 - 0.5) * PI;
        let level = DVec3::new(longitude.sin(), 0.0, longitude.cos());
        Some(world_from_camera * (level * latitude.cos() + DVec3::Y * latitude.sin()))
    })
}

/// The picture of a fisheye lens: a disc of `radius` px in the middle of `size`, with r = focal·`curve`(θ).
/// `angle` inverts the curve: the angle from the axis of a radius in units of the disc's.
pub fn fisheye(
    size: [usize; 2],
    radius: f64,
    from: DVec3,
    world_from_camera: DMat3,
    angle: impl Fn(f64) -> f64,
) -> Rgb {
    let middle = DVec2::new(size[0] as f64, size[1] as f64) * 0.5;
    picture(size, from, |px| {
        let off = px - middle;
        let r = off.length() / radius;
        let theta = angle(r);
        let side = off.normalize_or_zero() * theta.sin();
        (r <= 1.0).then(|| world_from_camera * side.extend(theta.cos()))
    })
}

/// A camera in the room, of its axes and position.
pub fn camera_at((axes, position): (DMat3, DVec3), k: Intrinsics) -> Camera {
    let pose = Mat4::from_mat3_translation(axes.as_mat3(), position.as_vec3());
    Camera::new(k, pose).unwrap()
}

/// Writes pictures to `folder` as R0.png, R1.png, … and returns the files.
pub fn save_pictures(folder: &Path, pictures: &[Rgb]) -> Vec<PathBuf> {
    let save = |(i, picture): (usize, &Rgb)| {
        let file = folder.join(format!("R{i}.png"));
        save_png(&file, picture).unwrap();
        file
    };
    pictures.iter().enumerate().map(save).collect()
}

/// Mean difference, of 255, of a picture from what a pinhole `k` with these axes sees from `from`.
pub fn difference(picture: &Rgb, k: &Intrinsics, from: DVec3, axes: DMat3) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (p, pixel) in picture.data.chunks_exact(3).enumerate().step_by(7) {
        let px = DVec2::new((p % k.width) as f64 + 0.5, (p / k.width) as f64 + 0.5);
        let at = px - DVec2::new(k.cx.into(), k.cy.into());
        let seen = colour(from, axes * (at / f64::from(k.fx)).extend(1.0));
        sum += pixel.iter().zip(seen).map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0;
        count += 1.0;
    }
    sum / count
}

/// Median distance between points as their frames' cameras project them and where the frames show them, px.
pub fn median_reprojection(found: &EstimatedScene) -> f32 {
    let mut errors: Vec<f32> = Vec::new();
    for (point, seen) in found.estimate.points.iter().zip(&found.observations) {
        for (frame, px) in seen {
            let at = found.scene.frames[*frame].camera.project(point.position).unwrap();
            errors.push(at.distance((*px).into()));
        }
    }
    errors.sort_by(f32::total_cmp);
    errors[errors.len() / 2]
}
