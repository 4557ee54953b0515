//! Relative pose of two calibrated cameras: essential matrix, residuals, triangulation.
//!
//! Source: R. Hartley and A. Zisserman, "Multiple View Geometry", sections 9.6, 11.4 and 12.

use glam::{DMat3, DVec2, DVec3};

/// A match as points of the planes z = 1 of both cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bearings {
    /// Point of the first camera.
    pub a: DVec2,
    /// Point of the second camera.
    pub b: DVec2,
    /// Standard deviation of the distance to the epipolar geometry, units of the planes.
    pub deviation: f64,
    /// Rotations from the axes of both cameras to those of the views whose planes have the points: of cameras
    /// with several views ([`super::photo::PosePhoto::from_views`]). `None` for the cameras' own planes.
    pub views: Option<[DMat3; 2]>,
}

/// Relative pose: x_b = R·x_a + t with |t| = 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Relative {
    /// R.
    pub rotation: DMat3,
    /// t: the first camera's position in the second one's axes, of unit length.
    pub translation: DVec3,
}

/// Returns the matrix of `v ×`.
pub(super) fn cross_matrix(v: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, v.z, -v.y),
        DVec3::new(-v.z, 0.0, v.x),
        DVec3::new(v.y, -v.x, 0.0),
    )
}

/// Returns the rotation by the vector `w` (axis times angle, radians).
pub(super) fn rotation(w: DVec3) -> DMat3 {
    let angle = w.length();
    if angle < 1e-300 {
        return DMat3::IDENTITY;
    }
    DMat3::from_axis_angle(w / angle, angle)
}

/// Returns the angle of a rotation matrix, radians. Sine and cosine together keep small angles
/// exact.
pub(super) fn rotation_angle(r: &DMat3) -> f64 {
    let axis =
        DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    axis.length().atan2(r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0)
}

impl Bearings {
    /// Returns the match for focal lengths `s` times as long.
    pub(super) fn rescaled(&self, s: f64) -> Self {
        Self { a: self.a / s, b: self.b / s, deviation: self.deviation / s, views: self.views }
    }

    /// Returns the directions of both points in the axes of their cameras, of any length.
    pub(super) fn rays(&self) -> [DVec3; 2] {
        let rays = [self.a.extend(1.0), self.b.extend(1.0)];
        match &self.views {
            None => rays,
            Some([a, b]) => [a.transpose() * rays[0], b.transpose() * rays[1]],
        }
    }

    /// Distance between the second point and the first one turned by `rotation`, units of the plane; infinite
    /// where that direction lies behind the second point's view.
    pub(super) fn shift(&self, rotation: &DMat3) -> f64 {
        let seen = *rotation * self.rays()[0];
        match &self.views {
            None => (seen.truncate() / seen.z).distance(self.b),
            Some([_, view]) => {
                let seen = *view * seen;
                let front = seen.z > 1e-9;
                if front { (seen.truncate() / seen.z).distance(self.b) } else { f64::INFINITY }
            }
        }
    }
}

impl Relative {
    /// Returns E = [t]ₓ R, with x_bᵀ E x_a = 0.
    pub(super) fn essential(&self) -> DMat3 {
        cross_matrix(self.translation) * self.rotation
    }

    /// Returns the pose with both cameras exchanged.
    #[cfg(test)]
    pub(super) fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Depths (camera z, in baselines) at which the two rays of a match are closest.
    pub(super) fn depths(&self, m: &Bearings) -> [f64; 2] {
        // The pose of a view against another one has the same translation, in that view's axes.
        if let Some([a, b]) = &m.views {
            let rotation = *b * self.rotation * a.transpose();
            let between = Self { rotation, translation: *b * self.translation };
            return between.depths(&Bearings { views: None, ..*m });
        }
        let a = self.rotation * m.a.extend(1.0);
        let b = m.b.extend(1.0);
        let normal = a.cross(b);
        let n2 = normal.length_squared().max(1e-300);
        [-self.translation.cross(b).dot(normal) / n2, -self.translation.cross(a).dot(normal) / n2]
    }

    /// Returns the four relative poses of an essential matrix, or none of a matrix without one.
    pub(super) fn of_essential(e: &DMat3) -> Vec<Self> {
        let m = nalgebra::Matrix3::from_column_slice(&e.to_cols_array());
        let svd = m.svd(true, true);
        let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return Vec::new() };
        let to_glam = |m: &nalgebra::Matrix3<f64>| {
            let m = DMat3::from_cols_slice(m.as_slice());
            if m.determinant() < 0.0 { m * -1.0 } else { m }
        };
        let (u, vt) = (to_glam(&u), to_glam(&vt));
        if !(u.is_finite() && vt.is_finite()) {
            return Vec::new();
        }
        let w = DMat3::from_cols(DVec3::Y, -DVec3::X, DVec3::Z);
        let mut poses = Vec::with_capacity(4);
        for rotation in [u * w * vt, u * w.transpose() * vt] {
            for translation in [u.z_axis, -u.z_axis] {
                poses.push(Self { rotation, translation });
            }
        }
        poses
    }

    /// Of the four poses of `e` the one with most of `points` in front of both cameras, and their
    /// number.
    pub(super) fn in_front(e: &DMat3, points: &[Bearings]) -> Option<(Self, usize)> {
        let count =
            |pose: &Self| points.iter().filter(|m| pose.depths(m).iter().all(|z| *z > 0.0)).count();
        Self::of_essential(e)
            .into_iter()
            .map(|p| (p, count(&p)))
            .reduce(|a, b| if b.1 > a.1 { b } else { a })
    }

    /// Largest angle between this pose and `other`: of the rotations or of the translations,
    /// radians.
    pub(super) fn distance(&self, other: &Self) -> f64 {
        let turn = rotation_angle(&(self.rotation.transpose() * other.rotation));
        turn.max(self.translation.angle_between(other.translation))
    }
}

/// Signed Sampson distance of a match to E, in standard deviations of the match. The Sampson
/// distance is the first-order distance of both points to the nearest pair that satisfies
/// x_bᵀ E x_a = 0.
pub(super) fn sampson(e: &DMat3, m: &Bearings) -> f64 {
    match &m.views {
        None => sampson_on_planes(e, m),
        // The essential matrix between the two views.
        Some([a, b]) => sampson_on_planes(&(*b * *e * a.transpose()), m),
    }
}

fn sampson_on_planes(e: &DMat3, m: &Bearings) -> f64 {
    let (a, b) = (m.a.extend(1.0), m.b.extend(1.0));
    let line_b = *e * a;
    let line_a = DVec2::new(e.x_axis.dot(b), e.y_axis.dot(b));
    let norm = line_b.truncate().length_squared() + line_a.length_squared();
    b.dot(line_b) / (norm.max(1e-300).sqrt() * m.deviation)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::cameras::matches::random::SplitMix;

    /// A random relative pose of up to 0.5 rad and `n` matches of points at depths 2 to 6
    /// baselines, with normal noise of `noise` on the planes z = 1.
    pub(in crate::cameras::estimation) fn scene(
        n: usize,
        noise: f64,
        seed: u64,
    ) -> (Relative, Vec<Bearings>) {
        let mut random = SplitMix(seed);
        let mut uniform = |low: f64, high: f64| low + (high - low) * random.uniform();
        let mut vector = |s: f64| DVec3::from_array(std::array::from_fn(|_| uniform(-s, s)));
        let rotation = rotation(vector(0.3));
        let translation = (vector(1.0) + DVec3::new(0.3, 0.0, 0.0)).normalize();
        let relative = Relative { rotation, translation };
        let mut points = Vec::new();
        let mut random = SplitMix(seed ^ 0xABCD);
        while points.len() < n {
            let a = DVec2::new(random.uniform() - 0.5, random.uniform() - 0.5);
            let z = 2.0 + 4.0 * random.uniform();
            let b = rotation * (a.extend(1.0) * z) + translation;
            if b.z > 0.5 {
                let mut jitter = || noise * DVec2::new(random.normal(), random.normal());
                let b = b.truncate() / b.z + jitter();
                let deviation = noise.max(1e-3);
                points.push(Bearings { a: a + jitter(), b, deviation, views: None });
            }
        }
        (relative, points)
    }

    #[test]
    fn projections_satisfy_the_constraint_and_give_their_depths() {
        let (pose, points) = scene(40, 0.0, 7);
        let e = pose.essential();
        for m in &points {
            assert!(sampson(&e, m).abs() < 1e-12);
            let [za, zb] = pose.depths(m);
            let b = pose.rotation * (m.a.extend(1.0) * za) + pose.translation;
            assert!((b - m.b.extend(1.0) * zb).length() < 1e-9);
            let [back_b, back_a] = pose.inverse().depths(&Bearings { a: m.b, b: m.a, ..*m });
            assert!((back_a - za).abs() < 1e-9 && (back_b - zb).abs() < 1e-9);
        }
        let (found, n) = Relative::in_front(&e, &points).unwrap();
        assert_eq!(n, 40);
        assert!(found.distance(&pose) < 1e-9, "{}", found.distance(&pose));
        let tilted = Relative { translation: rotation(DVec3::X * 0.02) * pose.translation, ..pose };
        assert!(points.iter().any(|m| sampson(&tilted.essential(), m).abs() > 1e-3));
    }

    #[test]
    fn sampson_is_the_distance_to_the_nearest_pair() {
        // A point moved by d across its line has the distance d where the other point is exact to
        // the same degree: the correction is shared, so that it is below d and above d/√2 − ε.
        let (pose, points) = scene(20, 0.0, 11);
        let e = pose.essential();
        for m in &points {
            let line = (e * m.a.extend(1.0)).truncate().normalize();
            let moved = Bearings { b: m.b + 1e-4 * line, ..*m };
            let s = sampson(&e, &moved).abs() * m.deviation;
            assert!(s < 1.0e-4 && s > 0.3e-4, "{s}");
        }
    }
}
