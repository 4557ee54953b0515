//! Refines a relative pose, and a shared focal length where it is free, on the matches.
//!
//! The robust sum of squared Sampson distances is minimised by Levenberg-Marquardt steps over five
//! parameters of the pose and one of the focal length. Source: Hartley and Zisserman, appendix 6;
//! Cauchy's loss: Triggs et al., "Bundle adjustment - a modern synthesis", section 3.

use super::two_view::{Bearings, Relative, rotation, sampson};
use glam::{DMat3, DVec3};
use nalgebra::{SMatrix, SVector};

/// Parameters: rotation (3), direction of the translation (2), logarithm of the focal length (1).
const PARAMETERS: usize = 6;
type Matrix = SMatrix<f64, PARAMETERS, PARAMETERS>;
type Vector = SVector<f64, PARAMETERS>;

/// Residual at which Cauchy's loss begins to grow slowly, standard deviations.
const LOSS_SCALE: f64 = 2.0;

/// Normal distribution of the logarithm of the focal length over that of the bearings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FocalPrior {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub deviation: f64,
}

/// A refined relative pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    /// The pose.
    pub relative: Relative,
    /// Focal length over that of the bearings; 1 where it is kept.
    pub focal_scale: f64,
    /// Σ JᵀWJ at the solution: the inverse, times the variance of the residuals, is the covariance
    /// of rotation (3), translation (2) and logarithm of the focal length (1), radians.
    pub information: Matrix,
}

/// Cauchy's loss.
fn loss(r: f64) -> f64 {
    0.5 * LOSS_SCALE * LOSS_SCALE * (r / LOSS_SCALE).powi(2).ln_1p()
}

/// A pose with the focal length, as the minimiser moves it.
#[derive(Clone, Copy)]
struct State {
    relative: Relative,
    log_focal: f64,
}

impl State {
    /// Moves along `step` in the tangent space: rotation from the left, translation on its sphere.
    fn moved(&self, step: &Vector) -> Self {
        let Relative { rotation: r, translation: t } = self.relative;
        let (u, v) = t.any_orthonormal_pair();
        let turn = rotation(DVec3::new(step[0], step[1], step[2]));
        let translation = (t + u * step[3] + v * step[4]).normalize();
        let relative = Relative { rotation: turn * r, translation };
        Self { relative, log_focal: self.log_focal + step[5] }
    }

    fn cost(&self, points: &[Bearings], prior: Option<FocalPrior>) -> f64 {
        let (e, s) = (self.relative.essential(), self.log_focal.exp());
        let data: f64 = points.iter().map(|m| loss(sampson(&e, &m.rescaled(s)))).sum();
        data + prior.map_or(0.0, |p| 0.5 * p.distance(self.log_focal).powi(2))
    }
}

impl FocalPrior {
    /// Distance of the logarithm of a focal length from the mean, standard deviations.
    pub(super) fn distance(&self, log_focal: f64) -> f64 {
        (log_focal - self.mean) / self.deviation
    }
}

/// Refines `start` on `points` in at most `steps` steps. With a prior the focal length is free and
/// starts at `focal_scale` times that of the bearings.
pub(super) fn refine(
    start: &Relative,
    focal_scale: f64,
    points: &[Bearings],
    prior: Option<FocalPrior>,
    steps: usize,
) -> Refined {
    let mut state = State { relative: *start, log_focal: focal_scale.ln() };
    let mut cost = state.cost(points, prior);
    let mut damping = 1e-4;
    let (mut information, mut gradient) = linearise(&state, points, prior);
    for _ in 0..steps {
        let mut damped = information;
        (0..PARAMETERS).for_each(|i| damped[(i, i)] += damping * information[(i, i)] + 1e-12);
        let Some(factor) = damped.cholesky() else { break };
        let step = -factor.solve(&gradient);
        let next = state.moved(&step);
        let next_cost = next.cost(points, prior);
        if next_cost < cost {
            let gain = cost - next_cost;
            (state, cost) = (next, next_cost);
            damping = (damping * 0.2).max(1e-9);
            (information, gradient) = linearise(&state, points, prior);
            if gain < 1e-9 * (1e-12 + cost) {
                break;
            }
        } else {
            damping *= 8.0;
            if damping > 1e6 {
                break;
            }
        }
    }
    // Rounding accumulates in the product of rotations.
    let q = glam::DQuat::from_mat3(&state.relative.rotation).normalize();
    state.relative.rotation = DMat3::from_quat(q);
    Refined { relative: state.relative, focal_scale: state.log_focal.exp(), information }
}

/// Returns Σ JᵀWJ and Σ JᵀWr. A focal length that is kept gets the information 1 and no gradient.
fn linearise(state: &State, points: &[Bearings], prior: Option<FocalPrior>) -> (Matrix, Vector) {
    /// Step of the central differences: the cube root of f64's precision.
    const H: f64 = 6e-6;
    let free = if prior.is_some() { PARAMETERS } else { PARAMETERS - 1 };
    let shifted: Vec<[(DMat3, f64); 2]> = (0..free)
        .map(|i| {
            [H, -H].map(|h| {
                let mut step = Vector::zeros();
                step[i] = h;
                let s = state.moved(&step);
                (s.relative.essential(), s.log_focal.exp())
            })
        })
        .collect();
    let (e, s) = (state.relative.essential(), state.log_focal.exp());
    let (mut information, mut gradient) = (Matrix::zeros(), Vector::zeros());
    for m in points {
        let r = sampson(&e, &m.rescaled(s));
        let weight = 1.0 / (1.0 + (r / LOSS_SCALE).powi(2));
        let mut j = Vector::zeros();
        for (i, [plus, minus]) in shifted.iter().enumerate() {
            let at = |(e, s): &(DMat3, f64)| sampson(e, &m.rescaled(*s));
            j[i] = (at(plus) - at(minus)) / (2.0 * H);
        }
        information.ger(weight, &j, &j, 1.0);
        gradient.axpy(weight * r, &j, 1.0);
    }
    match prior {
        None => information[(5, 5)] = 1.0,
        Some(p) => {
            information[(5, 5)] += p.deviation.powi(-2);
            gradient[5] += p.distance(state.log_focal) / p.deviation;
        }
    }
    (information, gradient)
}

#[cfg(test)]
mod tests {
    use super::super::two_view::tests::scene;
    use super::*;

    #[test]
    fn a_disturbed_pose_returns_to_the_right_one_in_spite_of_wrong_matches() {
        for seed in 0..20 {
            let (pose, mut points) = scene(200, 0.2 / 500.0, seed);
            let n = points.len();
            (0..n / 5).for_each(|i| points.swap(i, n - 1 - i));
            for i in 0..n / 5 {
                points[i].b = points[(i + 1) % n].b;
            }
            let start = Relative {
                rotation: rotation(DVec3::new(0.02, -0.03, 0.01)) * pose.rotation,
                translation: rotation(DVec3::new(0.05, 0.1, -0.1)) * pose.translation,
            };
            let found = refine(&start, 1.0, &points, None, 50);
            assert!(
                found.relative.distance(&pose) < 6e-3,
                "{seed}: {}",
                found.relative.distance(&pose)
            );
            assert_eq!(found.focal_scale, 1.0);
        }
    }

    #[test]
    fn a_free_focal_length_is_found_where_the_prior_is_wide() {
        let (pose, points) = scene(400, 1e-9, 5);
        let wrong: Vec<Bearings> = points.iter().map(|m| m.rescaled(1.0 / 1.2)).collect();
        let prior = FocalPrior { mean: 0.0, deviation: 2.0 };
        let found = refine(&pose, 1.0, &wrong, Some(prior), 50);
        assert!((found.focal_scale - 1.2).abs() < 2e-3, "{}", found.focal_scale);
        assert!(found.relative.distance(&pose) < 2e-3);
        let kept = refine(&pose, 1.0, &wrong, None, 50);
        assert!(kept.relative.distance(&pose) > found.relative.distance(&pose));
    }
}
