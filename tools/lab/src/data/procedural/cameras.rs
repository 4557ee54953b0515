//! Samples pairs of cameras with the statistics of hand-held footage of rooms, and target cameras
//! between the two.
//!
//! Half of the pairs move forward or back, a quarter sideways, a quarter in any direction. 35 %
//! rotate towards the scene as on an orbit. No camera is within 0.1 m of a surface. A
//! [`CameraRange`] gives the field of view, the baseline, the rotation and the overlap.

use super::Room;
use super::rng::Rng;
use super::shape::Ray;
use glam::{EulerRot, Mat3, Mat4, Quat, Vec2, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

/// Smallest distance of a camera from any surface, m.
pub(super) const CLEARANCE: f32 = 0.1;
/// Number of probe rays along each side of a view.
const PROBE: usize = 20;
/// Number of proposals before a room is rejected as too small.
const TRIES: u64 = 300;

/// Parameters of [`sample_cameras`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraSpec {
    /// Width of every picture, px; at least 1.
    pub width: usize,
    /// Height of every picture, px; at least 1.
    pub height: usize,
    /// Number of cameras between the two context cameras.
    pub targets: usize,
    /// Probability that the pictures are off-centre windows of pictures twice as large: half the
    /// field of view, with the pixel statistics of larger photographs.
    pub crop: f32,
    /// Field of view, baseline and rotation.
    pub range: CameraRange,
}

/// Range of the field of view, the baseline and the rotation of context cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CameraRange {
    /// Hand-held footage of rooms: field of view 40° to 80°, baseline 0.05 to 0.38 of the median
    /// depth, at most 28° about each axis. Each view sees at least 40 % of the other.
    #[default]
    HandHeld,
    /// As [`CameraRange::HandHeld`], with a baseline of 0.02 to 0.6 of the median depth with uniform
    /// logarithm (WMGStereo, arXiv 2504.16930, samples baselines so).
    LogBaseline,
    /// Pairs of photographs of any kind: field of view 28° to 96° (focal lengths 2 to 0.45
    /// widths), baseline 0.02 to 0.6 of the median depth with uniform logarithm, at most 40° about
    /// each axis. Each view sees at least 30 % of the other.
    Wide,
}

impl CameraRange {
    /// Samples a field of view, degrees.
    fn field_of_view(self, rng: &mut Rng) -> f32 {
        match self {
            Self::HandHeld | Self::LogBaseline => rng.range(40.0, 80.0),
            Self::Wide => rng.range(28.0, 96.0),
        }
    }

    /// Samples a baseline, in units of the median depth.
    fn baseline(self, rng: &mut Rng) -> f32 {
        match self {
            Self::HandHeld => rng.range(0.05, 0.38),
            Self::LogBaseline | Self::Wide => rng.log_range(0.02, 0.6),
        }
    }

    /// Largest rotation between the context views about each axis, degrees.
    fn max_rotation(self) -> f32 {
        match self {
            Self::HandHeld | Self::LogBaseline => 28.0,
            Self::Wide => 40.0,
        }
    }

    /// Standard deviations of pitch, yaw and roll of the second view, degrees.
    fn rotation_spread(self, orbit: bool) -> [f32; 3] {
        match (self, orbit) {
            (Self::HandHeld | Self::LogBaseline, true) => [1.5, 1.5, 1.0],
            (Self::HandHeld | Self::LogBaseline, false) => [3.0, 7.0, 1.5],
            (Self::Wide, true) => [3.0, 4.0, 3.0],
            (Self::Wide, false) => [6.0, 12.0, 4.0],
        }
    }

    /// Smallest share of each context view that the other sees.
    fn min_overlap(self) -> f32 {
        match self {
            Self::HandHeld | Self::LogBaseline => 0.4,
            Self::Wide => 0.3,
        }
    }
}

/// Direction of the second camera's position relative to the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// Along the line of sight, forward or back.
    Forward,
    /// Along the picture's rows.
    Sideways,
    /// Any direction.
    Free,
}

/// Context and target cameras in a room, world units metres.
#[derive(Clone, Debug)]
pub struct Rig {
    /// The two context cameras, then the targets.
    pub cameras: Vec<Camera>,
    /// Distance between the two context cameras, m.
    pub baseline: f32,
    /// 2 % quantile of the depth of both context views, m.
    pub near_depth: f32,
    /// Median depth of the first context view, m.
    pub median_depth: f32,
    /// Largest depth of both context views, m.
    pub far_depth: f32,
    /// Share of a context view that the other sees, the smaller of the two.
    pub overlap: f32,
    /// Direction of the motion.
    pub motion: Motion,
    /// True if the second camera rotates towards the point that the first one faces.
    pub orbit: bool,
    /// True if the pictures are windows of larger ones.
    pub cropped: bool,
}

/// Point of a surface that a camera sees.
#[derive(Clone, Copy, Debug)]
pub(super) struct SurfacePoint {
    /// Position, world.
    pub(super) in_world: Vec3,
    /// Camera z, m.
    pub(super) depth: f32,
}

/// Samples cameras for `room`; equal seeds give equal cameras. Returns `None` where the room has no
/// space for them (a few rooms in a thousand).
pub fn sample_cameras(room: &Room, seed: u64, spec: &CameraSpec) -> Option<Rig> {
    let stream = Rng::new(seed);
    (0..TRIES).find_map(|attempt| propose(room, &mut stream.fork(attempt), spec))
}

/// Samples one set of cameras; `None` where it violates a condition.
fn propose(room: &Room, rng: &mut Rng, spec: &CameraSpec) -> Option<Rig> {
    let cropped = rng.chance(spec.crop);
    let intrinsics = intrinsics(spec, cropped, rng);
    let first = first_camera(room, intrinsics, rng)?;
    let first_points = probe(room, &first);
    let mut depths: Vec<f32> = first_points.iter().map(|p| p.depth).collect();
    depths.sort_by(f32::total_cmp);
    let median_depth = *depths.get(depths.len() / 2)?;
    // A view of a near wall holds no geometry of the room.
    if median_depth < 0.8 {
        return None;
    }
    let motion = match rng.unit() {
        v if v < 0.5 => Motion::Forward,
        v if v < 0.75 => Motion::Sideways,
        _ => Motion::Free,
    };
    let (second, orbit) = second_camera(&first, median_depth, motion, spec.range, rng);
    if room.clearance(second.position()) < CLEARANCE {
        return None;
    }
    let second_points = probe(room, &second);
    let overlap = overlap(room, [&first, &second], [&first_points, &second_points]);
    if overlap < spec.range.min_overlap() {
        return None;
    }
    let mut cameras = vec![first, second];
    for _ in 0..spec.targets {
        cameras.push(between(room, &first, &second, rng)?);
    }
    let depths = extent(first_points.iter().chain(&second_points))?;
    Some(Rig {
        baseline: first.position().distance(second.position()),
        near_depth: depths.near,
        median_depth,
        far_depth: depths.far,
        overlap,
        motion,
        orbit,
        cropped,
        cameras,
    })
}

/// Samples a field of view along the longer side of the picture, or of the larger picture that it
/// is a window of.
fn intrinsics(spec: &CameraSpec, cropped: bool, rng: &mut Rng) -> Intrinsics {
    let (width, height) = (spec.width.max(1), spec.height.max(1));
    let fov = spec.range.field_of_view(rng).to_radians();
    let full = if cropped { 2 } else { 1 };
    let (w, h) = ((width * full) as f32, (height * full) as f32);
    let f = 0.5 * w.max(h) / (0.5 * fov).tan();
    let (left, top) = if cropped { (rng.count(0, width), rng.count(0, height)) } else { (0, 0) };
    let (cx, cy) = (0.5 * w - left as f32, 0.5 * h - top as f32);
    Intrinsics { fx: f, fy: f, cx, cy, width, height }
}

/// Returns the axes of a camera that faces `forward` with level picture rows.
fn level(forward: Vec3) -> Mat3 {
    let z = forward.normalize_or(Vec3::Z);
    let x = Vec3::Y.cross(z).normalize_or(Vec3::X);
    Mat3::from_cols(x, z.cross(x), z)
}

/// Builds a camera from its intrinsics, rotation and position.
fn posed(intrinsics: Intrinsics, rotation: Mat3, eye: Vec3) -> Camera {
    let pose = Mat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        eye.extend(1.0),
    );
    Camera::new_unchecked(intrinsics, pose)
}

/// Samples a camera at hand or eye height that faces across the room.
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

/// Samples the second camera; the flag is true if it rotates towards the scene.
fn second_camera(
    first: &Camera,
    median: f32,
    motion: Motion,
    range: CameraRange,
    rng: &mut Rng,
) -> (Camera, bool) {
    let baseline = range.baseline(rng) * median;
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
    let [pitch, yaw, roll] = range.rotation_spread(orbit).map(|d| d.to_radians() * rng.normal());
    let (y, x, z) =
        (turn * Quat::from_euler(EulerRot::YXZ, yaw, pitch, roll)).to_euler(EulerRot::YXZ);
    let limit = range.max_rotation().to_radians();
    let [y, x, z] = [y, x, z].map(|a| a.clamp(-limit, limit));
    let rotation = first.rotation() * Mat3::from_quat(Quat::from_euler(EulerRot::YXZ, y, x, z));
    let eye = first.position() + first.rotation() * step;
    (posed(first.intrinsics(), rotation, eye), orbit)
}

/// Samples a target camera near the path from the first to the second camera.
fn between(room: &Room, first: &Camera, second: &Camera, rng: &mut Rng) -> Option<Camera> {
    let (a, b) = (first.position(), second.position());
    let t = rng.range(0.1, 0.9);
    let off = 0.04 * a.distance(b) * Vec3::new(rng.normal(), rng.normal(), rng.normal());
    let eye = a.lerp(b, t) + off;
    let rotation = Quat::from_mat3(&first.rotation()).slerp(Quat::from_mat3(&second.rotation()), t);
    let clear = room.clearance(eye) >= CLEARANCE;
    clear.then(|| posed(first.intrinsics(), Mat3::from_quat(rotation), eye))
}

/// Returns the 2 % quantile of depth and the largest depth, or `None` without points.
pub(super) fn extent<'a>(points: impl Iterator<Item = &'a SurfacePoint>) -> Option<NearFar> {
    let mut depths: Vec<f32> = points.map(|p| p.depth).collect();
    depths.sort_by(f32::total_cmp);
    Some(NearFar { near: *depths.get(depths.len() / 50)?, far: *depths.last()? })
}

/// Returns the smaller share of either camera's view that the other camera sees; `points` are the
/// probes of the two.
pub(super) fn overlap(room: &Room, [a, b]: [&Camera; 2], points: [&[SurfacePoint]; 2]) -> f32 {
    visible_share(room, points[0], b).min(visible_share(room, points[1], a))
}

/// Returns the surface points that a camera sees through a regular grid of rays.
pub(super) fn probe(room: &Room, camera: &Camera) -> Vec<SurfacePoint> {
    let k = &camera.intrinsics();
    let mut points = Vec::with_capacity(PROBE * PROBE);
    for j in 0..PROBE {
        for i in 0..PROBE {
            let share = Vec2::new(i as f32 + 0.5, j as f32 + 0.5) / PROBE as f32;
            let px = share * Vec2::new(k.width as f32, k.height as f32);
            let direction = camera.rotation() * k.unproject(px);
            let ray = Ray { origin: camera.position(), direction };
            if let Some((_, t)) = room.nearest(&ray) {
                points.push(SurfacePoint { in_world: ray.at(t), depth: t });
            }
        }
    }
    points
}

/// Returns the share of the points that `camera` sees: in front, inside the picture and not
/// occluded.
fn visible_share(room: &Room, points: &[SurfacePoint], camera: &Camera) -> f32 {
    let (w, h) = (camera.intrinsics().width as f32, camera.intrinsics().height as f32);
    let sees = |point: Vec3| {
        let inside = camera
            .project(point)
            .is_some_and(|p| p.cmpge(Vec2::ZERO).all() && p.x <= w && p.y <= h);
        let ray = Ray { origin: camera.position(), direction: point - camera.position() };
        inside && room.nearest(&ray).is_none_or(|hit| hit.1 > 0.99)
    };
    points.iter().filter(|p| sees(p.in_world)).count() as f32 / points.len().max(1) as f32
}
