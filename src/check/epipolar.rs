//! Two views and their epipolar geometry, in f64: the fundamental matrix that
//! cameras give, the distance of a match to it, and triangulation (R. Hartley and
//! A. Zisserman, "Multiple View Geometry", sections 9.2, 11.1, 12).
//!
//! A match is (point in a, point in b), px of each photograph. xᵀ_b F x_a = 0.

use crate::camera::{Camera, Intrinsics};
use glam::{DMat3, DVec2, DVec3, Mat4};

/// One matched pair of points: (px of the first photograph, px of the second).
pub(super) type Match = (DVec2, DVec2);

/// Two calibrated views: intrinsics, and the second camera's axes and eye as seen
/// from the first.
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

/// `k` as a matrix in f64.
fn matrix(k: &Intrinsics) -> DMat3 {
    k.matrix().as_dmat3()
}

/// Rotation part, made orthonormal in f64: files carry few digits.
fn rotation(pose: &Mat4) -> DMat3 {
    let m = pose.as_dmat4();
    let x = m.x_axis.truncate().normalize_or(DVec3::X);
    let y = m.y_axis.truncate();
    let y = (y - x * x.dot(y)).normalize_or(x.any_orthonormal_vector());
    DMat3::from_cols(x, y, x.cross(y))
}

impl TwoViews {
    /// From two posed cameras.
    pub(super) fn new(a: &Camera, b: &Camera) -> Self {
        let (ra, rb) = (rotation(&a.world_from_camera), rotation(&b.world_from_camera));
        let eyes = a.world_from_camera.w_axis.as_dvec4() - b.world_from_camera.w_axis.as_dvec4();
        Self {
            k_a: matrix(&a.intrinsics),
            k_b: matrix(&b.intrinsics),
            rotation: rb.transpose() * ra,
            translation: rb.transpose() * eyes.truncate(),
        }
    }

    /// F = K_b⁻ᵀ [t]ₓ R K_a⁻¹ with px coordinates; all zeros without a baseline.
    pub(super) fn fundamental(&self) -> DMat3 {
        let t = self.translation.normalize_or_zero();
        let cross = DMat3::from_cols(
            DVec3::new(0.0, t.z, -t.y),
            DVec3::new(-t.z, 0.0, t.x),
            DVec3::new(t.y, -t.x, 0.0),
        );
        self.k_b.inverse().transpose() * cross * self.rotation * self.k_a.inverse()
    }

    /// Where a point of the first picture lies in the second if it is infinitely
    /// far away, or `None` behind the camera.
    pub(super) fn at_infinity(&self, a: DVec2) -> Option<DVec2> {
        let p = self.k_b * (self.rotation * (self.k_a.inverse() * a.extend(1.0)));
        (p.z > 1e-9).then(|| p.truncate() / p.z)
    }

    /// Depth (camera z) of the match's point in the first and in the second
    /// camera, each where the rays come nearest, and the angle between the rays.
    pub(super) fn triangulate(&self, m: &Match) -> Triangulated {
        let ray_a = self.rotation * (self.k_a.inverse() * m.0.extend(1.0));
        let ray_b = self.k_b.inverse() * m.1.extend(1.0);
        let normal = ray_a.cross(ray_b);
        let n2 = normal.length_squared().max(1e-300);
        // z_a·ray_a + t = z_b·ray_b, crossed with one ray and dotted with the normal.
        Triangulated {
            z_a: -self.translation.cross(ray_b).dot(normal) / n2,
            z_b: -self.translation.cross(ray_a).dot(normal) / n2,
            angle: ray_a.angle_between(ray_b),
        }
    }

    /// Point of depth `z` at pixel `a` of the first picture, in the second
    /// camera's axes.
    pub(super) fn in_second(&self, a: DVec2, z: f64) -> DVec3 {
        self.rotation * (self.k_a.inverse() * a.extend(1.0) * z) + self.translation
    }

    /// The same two views, named the other way round.
    pub(super) fn swapped(&self) -> Self {
        let r = self.rotation.transpose();
        Self { k_a: self.k_b, k_b: self.k_a, rotation: r, translation: -(r * self.translation) }
    }

    /// Angle between the two cameras' axes systems, radians.
    pub(super) fn turn(&self) -> f64 {
        let c = 0.5 * (self.rotation.col(0).x + self.rotation.col(1).y + self.rotation.col(2).z);
        (c - 0.5).clamp(-1.0, 1.0).acos()
    }

    /// Radians per pixel of the coarser of both cameras.
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

/// Root mean square of the distances of both points to their epipolar lines, px;
/// infinite where F gives no line.
pub(super) fn distance(f: &DMat3, m: &Match) -> f64 {
    let (a, b) = (m.0.extend(1.0), m.1.extend(1.0));
    let line_b = *f * a;
    let line_a = f.transpose() * b;
    let residual = b.dot(line_b);
    let (na, nb) = (line_a.truncate().length_squared(), line_b.truncate().length_squared());
    if na <= 0.0 || nb <= 0.0 || !residual.is_finite() {
        return f64::INFINITY;
    }
    (0.5 * residual * residual * (1.0 / na + 1.0 / nb)).sqrt()
}

/// Middle value, or `None` of nothing.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    quantile(&mut values, 0.5)
}

/// Value below which the share `q` lies; sorts.
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
    fn projections_of_one_point_satisfy_everything() {
        let (a, b) = cameras();
        let views = TwoViews::new(&a, &b);
        let f = views.fundamental();
        for p in [Vec3::new(5.5, 0.5, 3.0), Vec3::new(6.5, 2.0, 4.0), Vec3::new(5.0, 1.0, 9.0)] {
            let (pa, pb) = (a.project(p).unwrap(), b.project(p).unwrap());
            let m = (pa.as_dvec2(), pb.as_dvec2());
            assert!(distance(&f, &m) < 1e-3);
            let t = views.triangulate(&m);
            assert!((t.z_a - f64::from(a.to_camera(p).z)).abs() < 1e-3);
            assert!((t.z_b - f64::from(b.to_camera(p).z)).abs() < 1e-3);
            let back = views.in_second(m.0, t.z_a);
            assert!((back - b.to_camera(p).as_dvec3()).length() < 1e-3);
            let shifted = (m.0, m.1 + DVec2::new(0.0, 4.0));
            assert!(distance(&f, &shifted) > 1.0);
            assert!((distance(&views.swapped().fundamental(), &(m.1, m.0))) < 1e-3);
        }
        assert!((views.turn() - 0.3).abs() < 1e-3);
    }

    #[test]
    fn far_points_lie_where_infinity_says() {
        let (a, b) = cameras();
        let views = TwoViews::new(&a, &b);
        let px = Vec2::new(300.0, 200.0);
        let far = a.world_from_camera.transform_point3(a.intrinsics.unproject(px) * 1e5);
        let expected = b.project(far).unwrap().as_dvec2();
        assert!((views.at_infinity(px.as_dvec2()).unwrap() - expected).length() < 0.02);
    }
}
