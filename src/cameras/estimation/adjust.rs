//! Adjusts cameras that are nearly right, such as a headset's, by points matched between the
//! photographs.
//!
//! The relative poses of pairs are estimated from matches alone. Pairs that contradict the given
//! cameras by more than [`MAX_TURN_DEG`] are wrong and left out. The other pairs' matches become
//! points, and bundle adjustment moves cameras and points together, from the given cameras. One
//! similarity then moves the cameras back, so that other cameras of the same scene stay valid.
//!
//! Poses as parameters of the refinement were tried instead: 0.03 to 0.3 px a step change an error of 0.5° by a tenth
//! only, because Gaussians follow wrong poses faster. Measurements: `tools/lab/tried.md`, "The refinement".

use super::absolute::Absolute;
use super::edges::{Edge, edges};
use super::photo::PosePhoto;
use super::reconstruct;
use super::two_view::rotation_angle;
use glam::{DMat3, DQuat, DVec3, Mat4};
use subsplat_kernels::camera::Camera;

/// Largest difference of a pair's estimated rotation from the given one, degrees.
const MAX_TURN_DEG: f64 = 4.0;
/// The adjusted cameras are kept where their error is at most this share of the given ones'.
const MAX_ERROR_SHARE: f64 = 0.8;
/// Median error of cameras that fit, working px, where fewer than [`CERTAIN_POINTS`] tell.
const FITTING_PX: f64 = 1.0;
/// Points for each photograph that tell median errors below a working pixel. Chosen on five photographs of eight
/// scenes of `../shared/photos`, of which one has fewer points: 18.6 dB adjusted, 20.3 dB as given.
pub const CERTAIN_POINTS: usize = 100;

/// Result of [`adjust_poses`].
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PoseAdjustment {
    /// The cameras in the order of the photographs. A photograph with too few points keeps its own.
    pub cameras: Vec<Camera>,
    /// Median distance of the points from their matches with the given cameras, working px.
    pub before_px: f64,
    /// The same with the adjusted cameras.
    pub after_px: f64,
    /// Largest change of a rotation, degrees.
    pub turned_deg: f64,
    /// Number of points.
    pub points: usize,
}

/// Adjusts `cameras`, one for each photograph, whose intrinsics are exact. `None` where too few
/// points are matched, where the cameras fit them already, or where there is not one camera for
/// each photograph. `seed` starts the random samples of the pairs' poses.
pub fn adjust_poses(photos: &[PosePhoto], cameras: &[Camera], seed: u64) -> Option<PoseAdjustment> {
    if photos.len() != cameras.len() {
        return None;
    }
    let given: Vec<Absolute> = cameras.iter().map(absolute).collect();
    let mut edges = edges(photos, seed);
    edges.retain(|e| agrees(e, &given));
    let adjusted = reconstruct::adjust(photos, &edges, &given)?;
    let few = adjusted.points < CERTAIN_POINTS * photos.len();
    let fit = few && adjusted.before < FITTING_PX;
    if fit || !(adjusted.after <= MAX_ERROR_SHARE * adjusted.before) {
        return None;
    }
    let placed: Vec<usize> = (0..photos.len()).filter(|&i| adjusted.cameras[i].is_some()).collect();
    let moved: Vec<Absolute> = placed.iter().filter_map(|&i| adjusted.cameras[i]).collect();
    let kept: Vec<Absolute> = placed.iter().map(|&i| given[i]).collect();
    let back = Similarity::new(&moved, &kept);
    let mut out = cameras.to_vec();
    let mut turned_deg = 0.0f64;
    for (&photo, pose) in placed.iter().zip(&moved) {
        let (rotation, _) = back.pose(pose);
        let turn = rotation * given[photo].rotation;
        turned_deg = turned_deg.max(rotation_angle(&turn).to_degrees());
        out[photo] = back.camera(pose, &cameras[photo])?;
    }
    let (before_px, after_px, points) = (adjusted.before, adjusted.after, adjusted.points);
    Some(PoseAdjustment { cameras: out, before_px, after_px, turned_deg, points })
}

/// Moves `others` by the similarity that moves the cameras `from` onto `to`: the mean rotation between
/// them, then the scale and translation that fit their centres best. Thereby views of a scene follow
/// cameras that were adjusted. `None` without a camera, where there is not one in `to` for each one in
/// `from`, or where a camera is not finite.
pub fn move_along(from: &[Camera], to: &[Camera], others: &[Camera]) -> Option<Vec<Camera>> {
    if from.is_empty() || from.len() != to.len() {
        return None;
    }
    let [from, to] = [from, to].map(|all| all.iter().map(absolute).collect::<Vec<_>>());
    let similarity = Similarity::new(&from, &to);
    others.iter().map(|c| similarity.camera(&absolute(c), c)).collect()
}

/// Locates photographs among the points that others with the cameras `known` show, from matches alone.
/// `photos`: first those with `known` cameras, then one for each of `others`, whose intrinsics are
/// exact. `None` for a photograph that shows too few points, whose match turns its camera in `others`
/// by more than 4°, or where there is not one camera for each photograph.
#[must_use]
pub fn locate_photos(
    photos: &[PosePhoto],
    known: &[Camera],
    others: &[Camera],
    seed: u64,
) -> Vec<Option<Camera>> {
    if photos.len() != known.len() + others.len() {
        return vec![None; others.len()];
    }
    let known: Vec<Absolute> = known.iter().map(absolute).collect();
    let found = reconstruct::locate_others(photos, &known, seed);
    let camera = |(pose, like): (Option<Absolute>, &Camera)| {
        let pose = pose?;
        let turn = pose.rotation * absolute(like).rotation.transpose();
        let near = rotation_angle(&turn).to_degrees() < MAX_TURN_DEG;
        near.then(|| camera_at(pose.rotation.transpose(), pose.position(), like))?
    };
    found.into_iter().zip(others).map(camera).collect()
}

/// A camera with these axes and this position in the world and the intrinsics of `like`; `None` where
/// it is not finite.
fn camera_at(axes: DMat3, position: DVec3, like: &Camera) -> Option<Camera> {
    let matrix = Mat4::from_mat3_translation(axes.as_mat3(), position.as_vec3());
    Camera::new(like.intrinsics(), matrix).ok()
}

fn absolute(camera: &Camera) -> Absolute {
    let rotation = camera.rotation().as_dmat3().transpose();
    Absolute { rotation, translation: -(rotation * camera.position().as_dvec3()) }
}

/// Returns whether a pair's estimated rotation is near that of the given cameras.
fn agrees(edge: &Edge, given: &[Absolute]) -> bool {
    let [a, b] = edge.photos.map(|i| given[i].rotation);
    let turn = edge.estimate.refined.relative.rotation.transpose() * (b * a.transpose());
    rotation_angle(&turn).to_degrees() < MAX_TURN_DEG
}

/// The similarity that moves cameras onto others: the mean rotation between them, then the scale
/// and translation that fit the centres best.
struct Similarity {
    turn: DMat3,
    scale: f64,
    from: DVec3,
    to: DVec3,
}

impl Similarity {
    fn new(from: &[Absolute], to: &[Absolute]) -> Self {
        let sum = from.iter().zip(to).fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, (f, t)| {
            let q = DQuat::from_mat3(&(t.rotation.transpose() * f.rotation));
            // The rotations are close to one another: each with the sign of the sum.
            if q.dot(sum) < 0.0 { sum - q } else { sum + q }
        });
        let turn = DMat3::from_quat(sum.normalize());
        let mean = |all: &[Absolute]| {
            all.iter().map(Absolute::position).sum::<DVec3>() / all.len().max(1) as f64
        };
        let (origin, target) = (mean(from), mean(to));
        let (mut shared, mut square) = (0.0, 0.0);
        for (f, t) in from.iter().zip(to) {
            let offset = turn * (f.position() - origin);
            shared += offset.dot(t.position() - target);
            square += offset.length_squared();
        }
        let scale = if shared > 0.0 && square > 0.0 { shared / square } else { 1.0 };
        Self { turn, scale, from: origin, to: target }
    }

    /// A camera that was moved, with the intrinsics of `like`.
    fn camera(&self, camera: &Absolute, like: &Camera) -> Option<Camera> {
        let (axes, position) = self.pose(camera);
        camera_at(axes, position, like)
    }

    /// Axes and position of a camera in the world.
    fn pose(&self, camera: &Absolute) -> (DMat3, DVec3) {
        let position = self.turn * (camera.position() - self.from) * self.scale + self.to;
        (self.turn * camera.rotation.transpose(), position)
    }
}
