//! Errors of estimated cameras, after the alignment of both frames.

use glam::{DMat3, DQuat, DVec3, Mat4};
use subsplat_kernels::camera::Camera;

/// Rotation and position of a camera in f64.
fn pose(camera: &Camera) -> (DMat3, DVec3) {
    (camera.rotation().as_dmat3(), camera.position().as_dvec3())
}

/// Angle of a rotation, degrees. Sine and cosine together keep small angles exact.
fn angle_deg(r: DMat3) -> f64 {
    let axis =
        DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    axis.length().atan2(r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0).to_degrees()
}

/// Error of the relative rotation of two cameras, and of the direction from the first to the
/// second, degrees.
pub fn relative_errors(found: [&Camera; 2], truth: [&Camera; 2]) -> [f64; 2] {
    let relative = |cameras: [&Camera; 2]| {
        let [(ra, ta), (rb, tb)] = cameras.map(pose);
        (ra.transpose() * rb, ra.transpose() * (tb - ta))
    };
    let ((rf, tf), (rt, tt)) = (relative(found), relative(truth));
    [angle_deg(rf.transpose() * rt), tf.angle_between(tt).to_degrees()]
}

/// Area under the curve of the share of errors below e, for e from 0 to `limit`, over `limit`.
/// Infinite errors are failures. Source: Sarlin et al., "SuperGlue", 2020, section 5.
pub fn area_under_curve(errors: &[f64], limit: f64) -> f64 {
    let gains = errors.iter().map(|e| (1.0 - e / limit).max(0.0));
    gains.sum::<f64>() / errors.len().max(1) as f64
}

/// The middle value of an odd number of them, the mean of both of an even number.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    (sorted[(n - 1) / 2] + sorted[n / 2]) / 2.0
}

/// Errors of many cameras after the similarity that moves them onto the truth.
#[derive(Clone, Copy, Debug)]
pub struct AlignedErrors {
    /// Largest distance of a centre over the largest distance of two true centres.
    pub centre: f64,
    /// Largest error of a rotation, degrees.
    pub rotation_deg: f64,
}

/// The similarity that moves `found` onto `truth`: the mean rotation between the cameras, then the
/// scale and translation that fit the centres best.
struct Similarity {
    turn: DMat3,
    scale: f64,
    from: DVec3,
    to: DVec3,
}

impl Similarity {
    fn new(found: &[Camera], truth: &[Camera]) -> Self {
        let turns: Vec<DQuat> = found
            .iter()
            .zip(truth)
            .map(|(f, t)| DQuat::from_mat3(&(pose(t).0 * pose(f).0.transpose())))
            .collect();
        // Mean of quaternions that are close to one another: their sum, each with the sign of the
        // first.
        let sum = turns.iter().fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |s, q| {
            if q.dot(turns[0]) < 0.0 { s - *q } else { s + *q }
        });
        let turn = DMat3::from_quat(sum.normalize());
        let (f, t) = (centres(found), centres(truth));
        let mean = |v: &[DVec3]| v.iter().sum::<DVec3>() / v.len() as f64;
        let (from, to) = (mean(&f), mean(&t));
        let shared: f64 = f.iter().zip(&t).map(|(f, t)| (turn * (*f - from)).dot(*t - to)).sum();
        let scale = shared / f.iter().map(|f| (*f - from).length_squared()).sum::<f64>();
        Self { turn, scale, from, to }
    }

    fn point(&self, p: DVec3) -> DVec3 {
        self.turn * (p - self.from) * self.scale + self.to
    }
}

fn centres(cameras: &[Camera]) -> Vec<DVec3> {
    cameras.iter().map(|c| pose(c).1).collect()
}

/// Moves `found` onto `truth` by the similarity of [`aligned_errors`]. Intrinsics stay.
pub fn aligned_cameras(found: &[Camera], truth: &[Camera]) -> Vec<Camera> {
    let similarity = Similarity::new(found, truth);
    let moved = |c: &Camera| {
        let (rotation, centre) = pose(c);
        let rotation = (similarity.turn * rotation).as_mat3();
        let position = similarity.point(centre).as_vec3();
        let world_from_camera = Mat4::from_mat3_translation(rotation, position);
        Camera::new(c.intrinsics(), world_from_camera).expect("a camera")
    };
    found.iter().map(moved).collect()
}

/// Errors after the alignment of `found` with `truth` by one similarity.
pub fn aligned_errors(found: &[Camera], truth: &[Camera]) -> AlignedErrors {
    let similarity = Similarity::new(found, truth);
    let (f, t) = (centres(found), centres(truth));
    let distances = f.iter().zip(&t).map(|(f, t)| similarity.point(*f).distance(*t));
    let extent = t.iter().flat_map(|a| t.iter().map(|b| a.distance(*b))).fold(0.0, f64::max);
    let rotations = found
        .iter()
        .zip(truth)
        .map(|(f, t)| angle_deg(pose(t).0.transpose() * similarity.turn * pose(f).0));
    AlignedErrors {
        centre: distances.fold(0.0, f64::max) / extent,
        rotation_deg: rotations.fold(0.0, f64::max),
    }
}
