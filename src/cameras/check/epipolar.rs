//! Epipolar geometry of two views, in f64.
//!
//! The module computes the fundamental matrix of two cameras, the distance of a match to its
//! epipolar lines, and the triangulated depths. Points are px of their photographs, with x_bᵀ F x_a
//! = 0.
//!
//! Source: R. Hartley and A. Zisserman, "Multiple View Geometry", sections 9.2, 11.1 and 12.

use glam::{DMat3, DVec2, DVec3, Mat4};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// One matched pair of points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// Point in the first photograph, px.
    pub a: DVec2,
    /// Point in the second photograph, px.
    pub b: DVec2,
}

impl Match {
    /// Returns the match with the two photographs exchanged.
    pub(super) fn swapped(&self) -> Self {
        Self { a: self.b, b: self.a }
    }
}

/// Two calibrated views: intrinsics and the relative pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct TwoViews {
    /// Intrinsics of the first camera.
    pub k_a: DMat3,
    /// Intrinsics of the second camera.
    pub k_b: DMat3,
    /// Rotation from the first camera's axes to the second's.
    pub rotation: DMat3,
    /// Origin of the first camera in the second's axes, world units.
    pub translation: DVec3,
}

/// Returns the matrix K in f64.
fn matrix(k: &Intrinsics) -> DMat3 {
    k.matrix().as_dmat3()
}

/// Returns the rotation of a pose, made orthonormal in f64. Camera files hold few digits.
fn rotation(pose: &Mat4) -> DMat3 {
    let m = pose.as_dmat4();
    let x = m.x_axis.truncate().normalize_or(DVec3::X);
    let y = m.y_axis.truncate();
    let y = (y - x * x.dot(y)).normalize_or(x.any_orthonormal_vector());
    DMat3::from_cols(x, y, x.cross(y))
}

impl TwoViews {
    /// Computes the relative pose of two cameras.
    pub(super) fn new(a: &Camera, b: &Camera) -> Self {
        let (pose_a, pose_b) = (a.world_from_camera(), b.world_from_camera());
        let (ra, rb) = (rotation(&pose_a), rotation(&pose_b));
        let eyes = pose_a.w_axis.as_dvec4() - pose_b.w_axis.as_dvec4();
        Self {
            k_a: matrix(&a.intrinsics()),
            k_b: matrix(&b.intrinsics()),
            rotation: rb.transpose() * ra,
            translation: rb.transpose() * eyes.truncate(),
        }
    }

    /// Returns F = K_b⁻ᵀ [t]ₓ R K_a⁻¹ for px coordinates; all zeros without a baseline.
    pub(super) fn fundamental(&self) -> DMat3 {
        let t = self.translation.normalize_or_zero();
        let cross = DMat3::from_cols(
            DVec3::new(0.0, t.z, -t.y),
            DVec3::new(-t.z, 0.0, t.x),
            DVec3::new(t.y, -t.x, 0.0),
        );
        self.k_b.inverse().transpose() * cross * self.rotation * self.k_a.inverse()
    }

    /// Projects an infinitely distant point of the first picture into the second. Returns `None`
    /// behind the second camera.
    pub(super) fn at_infinity(&self, a: DVec2) -> Option<DVec2> {
        let p = self.k_b * (self.rotation * (self.k_a.inverse() * a.extend(1.0)));
        (p.z > 1e-9).then(|| p.truncate() / p.z)
    }

    /// Triangulates a match: depths (camera z) where the two rays are closest, and the angle
    /// between them.
    pub(super) fn triangulate(&self, m: &Match) -> Triangulated {
        let ray_a = self.rotation * (self.k_a.inverse() * m.a.extend(1.0));
        let ray_b = self.k_b.inverse() * m.b.extend(1.0);
        let normal = ray_a.cross(ray_b);
        let n2 = normal.length_squared().max(1e-300);
        // The cross product of z_a·ray_a + t = z_b·ray_b with one ray, dotted with the normal.
        Triangulated {
            z_a: -self.translation.cross(ray_b).dot(normal) / n2,
            z_b: -self.translation.cross(ray_a).dot(normal) / n2,
            angle: ray_a.angle_between(ray_b),
        }
    }

    /// Returns whether a match lies in front of both cameras. Rays that are parallel within the
    /// `noise` of a point, px, count as in front, because their intersection is not defined.
    pub(super) fn in_front(&self, m: &Match, noise: f64) -> bool {
        let t = self.triangulate(m);
        (t.z_a > 0.0 && t.z_b > 0.0) || t.angle < noise * self.radians_per_px()
    }

    /// Returns the point of depth `z` at pixel `a` of the first picture, in the axes of the second
    /// camera.
    pub(super) fn in_second(&self, a: DVec2, z: f64) -> DVec3 {
        self.rotation * (self.k_a.inverse() * a.extend(1.0) * z) + self.translation
    }

    /// Returns the same two views in the opposite order.
    pub(super) fn swapped(&self) -> Self {
        let r = self.rotation.transpose();
        Self { k_a: self.k_b, k_b: self.k_a, rotation: r, translation: -(r * self.translation) }
    }

    /// Returns the angle of the relative rotation, radians.
    pub(super) fn rotation_angle(&self) -> f64 {
        let c = 0.5 * (self.rotation.col(0).x + self.rotation.col(1).y + self.rotation.col(2).z);
        (c - 0.5).clamp(-1.0, 1.0).acos()
    }

    /// Returns the angle of one pixel of the coarser camera, radians.
    pub(super) fn radians_per_px(&self) -> f64 {
        let f = self.k_a.x_axis.x.min(self.k_a.y_axis.y);
        1.0 / f.min(self.k_b.x_axis.x.min(self.k_b.y_axis.y)).max(1e-9)
    }
}

/// A triangulated match.
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangulated {
    /// Depth in the first camera, world units.
    pub z_a: f64,
    /// Depth in the second camera, world units.
    pub z_b: f64,
    /// Angle between both rays, radians.
    pub angle: f64,
}

/// Returns the root mean square of the distances of both points to their epipolar lines, px. The
/// result is infinite where F defines no line.
pub(super) fn distance(f: &DMat3, m: &Match) -> f64 {
    let (a, b) = (m.a.extend(1.0), m.b.extend(1.0));
    let line_b = *f * a;
    let line_a = f.transpose() * b;
    let residual = b.dot(line_b);
    let (na, nb) = (line_a.truncate().length_squared(), line_b.truncate().length_squared());
    if na <= 0.0 || nb <= 0.0 || !residual.is_finite() {
        return f64::INFINITY;
    }
    (0.5 * residual * residual * (1.0 / na + 1.0 / nb)).sqrt()
}

/// Returns the median, or `None` without values.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    quantile(&mut values, 0.5)
}

/// Returns the value below which the share `q` lies; sorts `values`.
pub(super) fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    values.get((q * last as f64).round() as usize).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec2, Vec3};

    fn cameras() -> (Camera, Camera) {
        let k = Intrinsics { fx: 500.0, fy: 480.0, cx: 310.0, cy: 250.0, width: 640, height: 480 };
        let pose = |yaw: f32, eye: Vec3| {
            Mat4::from_rotation_translation(
                Quat::from_rotation_y(yaw) * Quat::from_rotation_x(0.1),
                eye,
            )
        };
        let a = Camera::new(k, pose(0.1, Vec3::new(5.0, 1.0, -2.0))).unwrap();
        let b = Camera::new(k, pose(-0.2, Vec3::new(6.0, 1.2, -2.3))).unwrap();
        (a, b)
    }

    #[test]
    fn projections_of_one_point_satisfy_the_epipolar_constraint() {
        let (a, b) = cameras();
        let views = TwoViews::new(&a, &b);
        let f = views.fundamental();
        for p in [Vec3::new(5.5, 0.5, 3.0), Vec3::new(6.5, 2.0, 4.0), Vec3::new(5.0, 1.0, 9.0)] {
            let (pa, pb) = (a.project(p).unwrap(), b.project(p).unwrap());
            let m = Match { a: pa.as_dvec2(), b: pb.as_dvec2() };
            assert!(distance(&f, &m) < 1e-3);
            let t = views.triangulate(&m);
            assert!((t.z_a - f64::from(a.to_camera(p).z)).abs() < 1e-3);
            assert!((t.z_b - f64::from(b.to_camera(p).z)).abs() < 1e-3);
            let back = views.in_second(m.a, t.z_a);
            assert!((back - b.to_camera(p).as_dvec3()).length() < 1e-3);
            let shifted = Match { b: m.b + DVec2::new(0.0, 4.0), ..m };
            assert!(distance(&f, &shifted) > 1.0);
            assert!((distance(&views.swapped().fundamental(), &m.swapped())) < 1e-3);
        }
        assert!((views.rotation_angle() - 0.3).abs() < 1e-3);
    }

    #[test]
    fn far_points_project_close_to_infinity() {
        let (a, b) = cameras();
        let views = TwoViews::new(&a, &b);
        let px = Vec2::new(300.0, 200.0);
        let far = a.unproject(px, 1e5);
        let expected = b.project(far).unwrap().as_dvec2();
        assert!((views.at_infinity(px.as_dvec2()).unwrap() - expected).length() < 0.02);
    }
}
