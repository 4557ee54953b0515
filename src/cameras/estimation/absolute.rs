//! The pose of one camera from points whose positions are known.
//!
//! Source: R. Haralick et al., "Review and analysis of solutions of the three point perspective
//! pose estimation problem", 1994 (Grunert's solution).

use super::five_point::real_roots;
use super::two_view::{Relative, cross_matrix, rotation};
use crate::cameras::matches::random::SplitMix;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// Pose of a camera: x_camera = R·x_world + t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Absolute {
    /// R.
    pub rotation: DMat3,
    /// t.
    pub translation: DVec3,
}

impl Absolute {
    /// The world's axes and origin.
    pub(super) const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// The second camera of a relative pose whose first camera is this one.
    pub(super) fn followed_by(&self, relative: &Relative, baseline: f64) -> Self {
        Self {
            rotation: relative.rotation * self.rotation,
            translation: relative.rotation * self.translation + relative.translation * baseline,
        }
    }

    /// A point in the camera's axes.
    pub(super) fn to_camera(self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The camera's position.
    pub(super) fn position(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// Moves along six tangent parameters: rotation from the left, then translation.
    pub(super) fn moved(&self, step: &[f64]) -> Self {
        let turn = rotation(DVec3::new(step[0], step[1], step[2]));
        let q = glam::DQuat::from_mat3(&(turn * self.rotation)).normalize();
        Self {
            rotation: DMat3::from_quat(q),
            translation: self.translation + DVec3::new(step[3], step[4], step[5]),
        }
    }
}

/// A known point as a camera sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    /// Position in the world.
    pub point: DVec3,
    /// The point's picture on the plane z = 1.
    pub bearing: DVec2,
    /// Standard deviation of the bearing, units of the plane.
    pub deviation: f64,
    /// Rotation from the camera's axes to those of the view whose plane has the picture; `None` for the camera's
    /// own plane.
    pub view: Option<DMat3>,
}

/// A point of the camera's axes in those of a view.
pub(super) fn in_view(view: Option<DMat3>, point: DVec3) -> DVec3 {
    view.map_or(point, |view| view * point)
}

impl Sight {
    /// Distance between the point's picture and its projection, standard deviations; infinite
    /// behind the camera.
    fn residual(&self, pose: &Absolute) -> f64 {
        let p = in_view(self.view, pose.to_camera(self.point));
        if p.z < 1e-9 {
            return f64::INFINITY;
        }
        (p.truncate() / p.z).distance(self.bearing) / self.deviation
    }
}

/// Largest number of samples of three sights.
const SAMPLES: usize = 1500;

/// Finds the pose that most of `sights` support within `limit` standard deviations. Returns the
/// pose and the indices of its sights.
pub(super) fn locate(sights: &[Sight], limit: f64, seed: u64) -> Option<(Absolute, Vec<usize>)> {
    if sights.len() < 6 {
        return None;
    }
    let mut random = SplitMix(seed);
    let score = |pose: &Absolute| -> f64 {
        sights.iter().map(|s| (1.0 - (s.residual(pose) / limit).powi(2)).max(0.0)).sum()
    };
    let mut best: Option<(f64, Absolute)> = None;
    let (mut needed, mut drawn) = (SAMPLES, 0);
    while drawn < needed {
        drawn += 1;
        let sample = random.sample::<3>(sights.len()).map(|i| sights[i]);
        for pose in three_points(&sample) {
            let s = score(&pose);
            if best.as_ref().is_none_or(|b| s > b.0) {
                let refined = refine(&pose, sights, 2.0 * limit, 5);
                let after = score(&refined);
                best = Some(if after > s { (after, refined) } else { (s, pose) });
                let share = best.map_or(0.0, |b| b.0) / sights.len() as f64;
                let right = share.powi(3).clamp(1e-9, 1.0 - 1e-9);
                needed = ((1e-5f64).ln() / (1.0 - right).ln()).ceil().clamp(60.0, 1500.0) as usize;
            }
        }
    }
    let pose = refine(&best?.1, sights, limit, 20);
    let inside = (0..sights.len()).filter(|&i| sights[i].residual(&pose) < limit).collect();
    Some((pose, inside))
}

/// Refines a pose on the sights within `limit`, by Gauss-Newton steps with Cauchy's weights.
fn refine(start: &Absolute, sights: &[Sight], limit: f64, steps: usize) -> Absolute {
    let mut pose = *start;
    for _ in 0..steps {
        let mut h = SMatrix::<f64, 6, 6>::identity() * 1e-9;
        let mut g = SVector::<f64, 6>::zeros();
        for s in sights.iter().filter(|s| s.residual(&pose) < limit) {
            let (r, j) = linear(&pose, s);
            let weight = 1.0 / (1.0 + 0.25 * r.norm_squared());
            h += j.transpose() * j * weight;
            g += j.transpose() * r * weight;
        }
        let Some(factor) = h.cholesky() else { break };
        let step = -factor.solve(&g);
        if !step.iter().all(|v| v.is_finite()) {
            break;
        }
        pose = pose.moved(step.as_slice());
        if step.norm() < 1e-10 {
            break;
        }
    }
    pose
}

/// Residual of a sight, standard deviations, and its derivative by the pose's six parameters.
fn linear(pose: &Absolute, s: &Sight) -> (SVector<f64, 2>, SMatrix<f64, 2, 6>) {
    let p = in_view(s.view, pose.to_camera(s.point));
    let off = (p.truncate() / p.z - s.bearing) / s.deviation;
    (SVector::<f64, 2>::new(off.x, off.y), projection_slope(pose, s.view, s.point) / s.deviation)
}

/// Derivative of the projection on the plane z = 1, the camera's or a view's, by the pose's six parameters.
pub(super) fn projection_slope(
    pose: &Absolute,
    view: Option<DMat3>,
    point: DVec3,
) -> SMatrix<f64, 2, 6> {
    let p = in_view(view, pose.to_camera(point));
    let slope = match view {
        None => slope_in_camera(p),
        Some(view) => slope_in_camera(p) * matrix(view),
    };
    let turn = cross_matrix(pose.rotation * point) * -1.0;
    let turn = matrix(turn);
    let mut out = SMatrix::<f64, 2, 6>::zeros();
    out.fixed_view_mut::<2, 3>(0, 0).copy_from(&(slope * turn));
    out.fixed_view_mut::<2, 3>(0, 3).copy_from(&slope);
    out
}

/// nalgebra's form of a matrix.
pub(super) fn matrix(m: DMat3) -> SMatrix<f64, 3, 3> {
    SMatrix::<f64, 3, 3>::from_column_slice(&m.to_cols_array())
}

/// Derivative of p ↦ (p.x, p.y) / p.z.
pub(super) fn slope_in_camera(p: DVec3) -> SMatrix<f64, 2, 3> {
    let z = 1.0 / p.z;
    SMatrix::<f64, 2, 3>::new(z, 0.0, -p.x * z * z, 0.0, z, -p.y * z * z)
}

/// Returns the poses, at most four, from which three points appear at their bearings.
fn three_points(sights: &[Sight; 3]) -> Vec<Absolute> {
    let points = sights.map(|s| s.point);
    let ray = |s: &Sight| {
        let ray = s.bearing.extend(1.0).normalize();
        s.view.map_or(ray, |view| view.transpose() * ray)
    };
    let rays = [ray(&sights[0]), ray(&sights[1]), ray(&sights[2])];
    let squared = |i: usize, j: usize| points[i].distance_squared(points[j]);
    let (a2, b2, c2) = (squared(1, 2), squared(0, 2), squared(0, 1));
    if !(a2.min(b2).min(c2) > 0.0) {
        return Vec::new();
    }
    let (ca, cb, cc) = (rays[1].dot(rays[2]), rays[0].dot(rays[2]), rays[0].dot(rays[1]));
    let (d, sum) = ((a2 - c2) / b2, (a2 + c2) / b2);
    let (ratio_a, ratio_c) = (a2 / b2, c2 / b2);
    // Grunert's quartic in v = s3/s1, the ratio of distances (Haralick, table 1).
    let quartic = [
        (d - 1.0).powi(2) - 4.0 * ratio_c * ca * ca,
        4.0 * (d * (1.0 - d) * cb - (1.0 - sum) * ca * cc + 2.0 * ratio_c * ca * ca * cb),
        2.0 * (d * d - 1.0 + 2.0 * d * d * cb * cb + 2.0 * (1.0 - ratio_c) * ca * ca
            - 4.0 * sum * ca * cb * cc
            + 2.0 * (1.0 - ratio_a) * cc * cc),
        4.0 * (-d * (1.0 + d) * cb + 2.0 * ratio_a * cc * cc * cb - (1.0 - sum) * ca * cc),
        (1.0 + d).powi(2) - 4.0 * ratio_a * cc * cc,
    ];
    real_roots(&quartic)
        .into_iter()
        .filter_map(|v| {
            let u = ((d - 1.0) * v * v - 2.0 * d * cb * v + 1.0 + d) / (2.0 * (cc - v * ca));
            let s1 = (b2 / (1.0 + v * v - 2.0 * v * cb)).sqrt();
            let distances = [s1, u * s1, v * s1];
            if !distances.iter().all(|s| s.is_finite() && *s > 0.0) {
                return None;
            }
            align(&points, &std::array::from_fn(|i| rays[i] * distances[i]))
        })
        .collect()
}

/// Returns the pose that moves three points to their places in the camera.
fn align(world: &[DVec3; 3], camera: &[DVec3; 3]) -> Option<Absolute> {
    let axes = |p: &[DVec3; 3]| {
        let x = (p[1] - p[0]).try_normalize()?;
        let z = x.cross(p[2] - p[0]).try_normalize()?;
        Some(DMat3::from_cols(x, z.cross(x), z))
    };
    let rotation = axes(camera)? * axes(world)?.transpose();
    Some(Absolute { rotation, translation: camera[0] - rotation * world[0] })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sights(n: usize, noise: f64, seed: u64) -> (Absolute, Vec<Sight>) {
        let mut random = SplitMix(seed);
        let mut next = |s: f64| s * (2.0 * random.uniform() - 1.0);
        let pose = Absolute {
            rotation: rotation(DVec3::new(next(1.0), next(1.0), next(1.0))),
            translation: DVec3::new(next(1.0), next(1.0), next(1.0)),
        };
        let all = (0..n)
            .map(|_| {
                let p = DVec3::new(next(1.0), next(1.0), 4.0 + next(2.0));
                let jitter = DVec2::new(next(noise), next(noise));
                let point = pose.rotation.transpose() * (p - pose.translation);
                Sight { point, bearing: p.truncate() / p.z + jitter, deviation: 1e-3, view: None }
            })
            .collect();
        (pose, all)
    }

    #[test]
    fn one_of_the_three_point_solutions_is_the_pose() {
        for seed in 0..100 {
            let (pose, s) = sights(3, 0.0, seed);
            let off = |p: &Absolute| (p.position() - pose.position()).length();
            let best = three_points(&[s[0], s[1], s[2]]).iter().map(off).fold(9.0, f64::min);
            assert!(best < 1e-5, "seed {seed}: {best}");
        }
        let (_, s) = sights(1, 0.0, 1);
        assert!(three_points(&[s[0]; 3]).is_empty());
    }

    #[test]
    fn a_camera_is_located_among_wrong_sights() {
        let (pose, mut s) = sights(90, 1e-3, 4);
        for i in 0..40 {
            s[i].bearing = s[i + 45].bearing;
        }
        let (found, inside) = locate(&s, 4.0, 1).unwrap();
        assert!((found.position() - pose.position()).length() < 5e-3);
        assert!(inside.iter().all(|&i| i >= 40) && inside.len() >= 48, "{}", inside.len());
        assert!(locate(&s[..5], 4.0, 1).is_none());
    }

    #[test]
    fn slopes_are_those_of_finite_differences() {
        let (pose, s) = sights(1, 0.0, 9);
        let turned = DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.2);
        for view in [None, Some(turned)] {
            let slope = projection_slope(&pose, view, s[0].point);
            for i in 0..6 {
                let at = |h: f64| {
                    let mut step = [0.0; 6];
                    step[i] = h;
                    let p = in_view(view, pose.moved(&step).to_camera(s[0].point));
                    p.truncate() / p.z
                };
                let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
                let off = (numeric - DVec2::new(slope[(0, i)], slope[(1, i)])).length();
                assert!(off < 1e-6, "{view:?}, {i}: {off}");
            }
        }
    }
}
