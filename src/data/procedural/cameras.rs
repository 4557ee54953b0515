//! Pairs of cameras as hand-held footage of rooms has them, and further cameras
//! between the two as targets.
//!
//! Field of view 40° to 80°; baseline 0.05 to 0.38 of the median depth; half of the
//! pairs move forward or back, a quarter sideways, a quarter anyhow; 35 % turn towards
//! the scene as on an orbit; at most 28° of rotation about an axis; either view sees
//! at least 40 % of the other; no eye within 0.1 m of a surface.

use super::Room;
use super::rng::Rng;
use super::shape::Ray;
use crate::camera::{Camera, Intrinsics};
use glam::{EulerRot, Mat3, Mat4, Quat, Vec2, Vec3};

/// Smallest distance of an eye from any surface, m.
pub(super) const CLEARANCE: f32 = 0.1;
/// Smallest share of either context view that the other sees.
const OVERLAP: f32 = 0.4;
/// Largest rotation between the context views about each axis, radians.
const ROTATION: f32 = 28.0 * std::f32::consts::PI / 180.0;
/// A view is probed on this many points along each side.
const PROBE: usize = 20;
/// Proposals before a room counts as too cramped.
const TRIES: u64 = 300;

/// What [`sample_cameras`] is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraSpec {
    /// Width of every picture, px; at least 1.
    pub width: usize,
    /// Height of every picture, px; at least 1.
    pub height: usize,
    /// Cameras between the two context cameras.
    pub targets: usize,
    /// Chance that the pictures are windows, off centre, of pictures twice as large:
    /// half the field of view, the pixel statistics of larger photographs.
    pub crop: f32,
}

/// How the second eye lies to the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// Along the line of sight, forward or back.
    Forward,
    /// Along the picture's rows.
    Sideways,
    /// Any direction.
    Free,
}

/// Cameras in a room, world units metres.
#[derive(Clone, Debug)]
pub struct Rig {
    /// The two context cameras, then the targets.
    pub cameras: Vec<Camera>,
    /// Distance of the two context eyes, m.
    pub baseline: f32,
    /// Depth below which 2 % of both context views lie, m.
    pub near_depth: f32,
    /// Median depth of the first context view, m.
    pub median_depth: f32,
    /// Largest depth found in both context views, m.
    pub far_depth: f32,
    /// Share of a context view that the other sees, the smaller of the two.
    pub overlap: f32,
    /// Direction of the motion.
    pub motion: Motion,
    /// The second camera turned towards what the first looks at.
    pub orbit: bool,
    /// The pictures are windows of larger ones.
    pub cropped: bool,
}

/// Cameras for `room`; the same for the same seed. `None` where the room leaves no
/// place for them (a few rooms in a thousand).
pub fn sample_cameras(room: &Room, seed: u64, spec: &CameraSpec) -> Option<Rig> {
    let stream = Rng::new(seed);
    (0..TRIES).find_map(|attempt| propose(room, &mut stream.fork(attempt), spec))
}

fn propose(room: &Room, rng: &mut Rng, spec: &CameraSpec) -> Option<Rig> {
    let cropped = rng.chance(spec.crop);
    let intrinsics = intrinsics(spec, cropped, rng);
    let first = first_camera(room, intrinsics, rng)?;
    let seen = probe(room, &first);
    let mut depths: Vec<f32> = seen.iter().map(|p| p.1).collect();
    depths.sort_by(f32::total_cmp);
    let median_depth = *depths.get(depths.len() / 2)?;
    // A wall at arm's length is no view of a room.
    if median_depth < 0.8 {
        return None;
    }
    let motion = match rng.unit() {
        v if v < 0.5 => Motion::Forward,
        v if v < 0.75 => Motion::Sideways,
        _ => Motion::Free,
    };
    let (second, orbit) = second_camera(&first, median_depth, motion, rng);
    if room.clearance(second.position()) < CLEARANCE {
        return None;
    }
    let seen_by_second = probe(room, &second);
    let overlap = overlap(room, [&first, &second], [&seen, &seen_by_second]);
    if overlap < OVERLAP {
        return None;
    }
    let mut cameras = vec![first, second];
    for _ in 0..spec.targets {
        cameras.push(between(room, &first, &second, rng)?);
    }
    let (near_depth, far_depth) = extent(seen.iter().chain(&seen_by_second))?;
    Some(Rig {
        baseline: first.position().distance(second.position()),
        near_depth,
        median_depth,
        far_depth,
        overlap,
        motion,
        orbit,
        cropped,
        cameras,
    })
}

/// 40° to 80° along the longer side, of the picture or of the one that it is cut from.
fn intrinsics(spec: &CameraSpec, cropped: bool, rng: &mut Rng) -> Intrinsics {
    let (width, height) = (spec.width.max(1), spec.height.max(1));
    let fov = rng.range(40.0, 80.0).to_radians();
    let full = if cropped { 2 } else { 1 };
    let (w, h) = ((width * full) as f32, (height * full) as f32);
    let f = 0.5 * w.max(h) / (0.5 * fov).tan();
    let (left, top) = if cropped { (rng.count(0, width), rng.count(0, height)) } else { (0, 0) };
    let (cx, cy) = (0.5 * w - left as f32, 0.5 * h - top as f32);
    Intrinsics { fx: f, fy: f, cx, cy, width, height }
}

/// Camera axes that look along `forward` with the picture's rows level.
fn level(forward: Vec3) -> Mat3 {
    let z = forward.normalize_or(Vec3::Z);
    let x = Vec3::Y.cross(z).normalize_or(Vec3::X);
    Mat3::from_cols(x, z.cross(x), z)
}

fn posed(intrinsics: Intrinsics, rotation: Mat3, eye: Vec3) -> Camera {
    let pose = Mat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        eye.extend(1.0),
    );
    Camera { intrinsics, world_from_camera: pose }
}

/// A camera at the height of a hand or an eye that looks across the room.
fn first_camera(room: &Room, intrinsics: Intrinsics, rng: &mut Rng) -> Option<Camera> {
    let size = room.size();
    let floor = |rng: &mut Rng| {
        Vec3::new(rng.range(-0.46, 0.46) * size.x, 0.0, rng.range(-0.46, 0.46) * size.z)
    };
    let up = if rng.chance(0.75) { rng.range(1.1, 1.8) } else { rng.range(0.4, size.y - 0.25) };
    let eye = floor(rng) - Vec3::Y * up;
    let aim = floor(rng) - Vec3::Y * rng.range(0.15, 0.75) * size.y;
    let ahead = aim - eye;
    if Vec2::new(ahead.x, ahead.z).length() < 1.0 || room.clearance(eye) < CLEARANCE {
        return None;
    }
    let roll = Mat3::from_rotation_z(2f32.to_radians() * rng.normal());
    Some(posed(intrinsics, level(ahead) * roll, eye))
}

/// The second camera, and whether it turns towards the scene.
fn second_camera(first: &Camera, median: f32, motion: Motion, rng: &mut Rng) -> (Camera, bool) {
    let baseline = rng.range(0.05, 0.38) * median;
    let shake = 0.15 * Vec3::new(rng.normal(), rng.normal(), rng.normal());
    let along = match motion {
        Motion::Forward => Vec3::Z * rng.sign() + shake,
        Motion::Sideways => Vec3::X * rng.sign() + shake,
        Motion::Free => Vec3::new(rng.normal(), rng.normal(), rng.normal()),
    };
    let step = along.normalize_or(Vec3::X) * baseline;
    let orbit = rng.chance(0.35);
    let mut turn = Quat::IDENTITY;
    if orbit {
        let pivot = Vec3::Z * median * rng.range(0.7, 1.3);
        let towards = (pivot - step).normalize_or(Vec3::Z);
        turn = Quat::from_rotation_arc(Vec3::Z, towards);
    }
    let degrees = if orbit { [1.5, 1.5, 1.0] } else { [3.0, 7.0, 1.5] };
    let [pitch, yaw, roll] = degrees.map(|d: f32| d.to_radians() * rng.normal());
    let (y, x, z) =
        (turn * Quat::from_euler(EulerRot::YXZ, yaw, pitch, roll)).to_euler(EulerRot::YXZ);
    let [y, x, z] = [y, x, z].map(|a| a.clamp(-ROTATION, ROTATION));
    let rotation = first.rotation() * Mat3::from_quat(Quat::from_euler(EulerRot::YXZ, y, x, z));
    let eye = first.position() + first.rotation() * step;
    (posed(first.intrinsics, rotation, eye), orbit)
}

/// A camera on the way from the first to the second, a little off it.
fn between(room: &Room, first: &Camera, second: &Camera, rng: &mut Rng) -> Option<Camera> {
    let (a, b) = (first.position(), second.position());
    let t = rng.range(0.1, 0.9);
    let off = 0.04 * a.distance(b) * Vec3::new(rng.normal(), rng.normal(), rng.normal());
    let eye = a.lerp(b, t) + off;
    let rotation = Quat::from_mat3(&first.rotation()).slerp(Quat::from_mat3(&second.rotation()), t);
    let clear = room.clearance(eye) >= CLEARANCE;
    clear.then(|| posed(first.intrinsics, Mat3::from_quat(rotation), eye))
}

/// Depth below which 2 % of the points lie, and the largest.
pub(super) fn extent<'a>(seen: impl Iterator<Item = &'a (Vec3, f32)>) -> Option<(f32, f32)> {
    let mut depths: Vec<f32> = seen.map(|p| p.1).collect();
    depths.sort_by(f32::total_cmp);
    Some((*depths.get(depths.len() / 50)?, *depths.last()?))
}

/// Share of what either of two cameras sees that the other sees too, the smaller one.
pub(super) fn overlap(room: &Room, [a, b]: [&Camera; 2], seen: [&[(Vec3, f32)]; 2]) -> f32 {
    visible(room, seen[0], b).min(visible(room, seen[1], a))
}

/// World points and depths that a camera sees, on a grid.
pub(super) fn probe(room: &Room, camera: &Camera) -> Vec<(Vec3, f32)> {
    let k = &camera.intrinsics;
    let mut seen = Vec::with_capacity(PROBE * PROBE);
    for j in 0..PROBE {
        for i in 0..PROBE {
            let share = Vec2::new(i as f32 + 0.5, j as f32 + 0.5) / PROBE as f32;
            let px = share * Vec2::new(k.width as f32, k.height as f32);
            let direction = camera.rotation() * k.unproject(px);
            let ray = Ray { origin: camera.position(), direction };
            if let Some((_, t)) = room.nearest(&ray) {
                seen.push((ray.at(t), t));
            }
        }
    }
    seen
}

/// Share of the points that `camera` sees: in front, inside the picture and not hidden.
fn visible(room: &Room, points: &[(Vec3, f32)], camera: &Camera) -> f32 {
    let (w, h) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
    let sees = |point: Vec3| {
        let inside = camera
            .project(point)
            .is_some_and(|p| p.cmpge(Vec2::ZERO).all() && p.x <= w && p.y <= h);
        let ray = Ray { origin: camera.position(), direction: point - camera.position() };
        inside && room.nearest(&ray).is_none_or(|hit| hit.1 > 0.99)
    };
    points.iter().filter(|p| sees(p.0)).count() as f32 / points.len().max(1) as f32
}
