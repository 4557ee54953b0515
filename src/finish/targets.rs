//! The photographs that a scene is to give: their loss, and what they tell about the Gaussians.

use super::FinishError;
use super::loss::{Scored, dssim, mse};
use super::phase::LossWeights;
use crate::scene::pictures::Rgb;
use crate::scene::splats::Splats;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{MEAN_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};

/// A picture that the Gaussians are to give.
#[derive(Clone, Copy, Debug)]
pub struct TargetView<'a> {
    /// The picture's camera.
    pub camera: &'a Camera,
    /// The picture, of the camera's size.
    pub image: &'a Rgb,
}

/// Coverage up to which a picture of some of the Gaussians does not count; above it, the weight of a
/// pixel grows linearly to 1.
const COVERAGE_MIN: f32 = 0.7;

/// A view with its truth as planes.
pub(super) struct Target<'a> {
    pub camera: &'a Camera,
    /// `[3, H, W]`.
    pub truth: Vec<f32>,
    weights: LossWeights,
}

impl<'a> Target<'a> {
    /// Refuses a picture of another size than its camera. `index` names the view.
    pub fn check(index: usize, view: &TargetView<'_>) -> Result<(), FinishError> {
        let k = view.camera.intrinsics();
        if (k.width, k.height) != (view.image.width, view.image.height) {
            let expected = format!("{}x{}", k.width, k.height);
            let got = format!("{}x{}", view.image.width, view.image.height);
            return Err(FinishError::Size { view: index, expected, got });
        }
        Ok(())
    }

    /// Converts a picture to planes.
    ///
    /// # Errors
    /// Those of [`Target::check`].
    pub fn new(
        index: usize,
        view: &TargetView<'a>,
        weights: LossWeights,
    ) -> Result<Self, FinishError> {
        Self::check(index, view)?;
        Ok(Self { camera: view.camera, truth: view.image.to_planes(), weights })
    }

    /// The loss of rendered planes `[5, H, W]`, with its gradient by R, G and B.
    pub fn loss(&self, planes: &[f32]) -> Scored {
        self.loss_to(planes, &self.truth)
    }

    /// [`Target::loss`] with another `truth`.
    fn loss_to(&self, planes: &[f32], truth: &[f32]) -> Scored {
        let k = self.camera.intrinsics();
        let rgb = &planes[..truth.len()];
        let mut loss = mse(rgb, truth);
        if self.weights.dssim > 0.0 {
            loss.add(&dssim(rgb, truth, k.width, k.height), self.weights.dssim);
        }
        loss
    }

    /// [`Target::loss`] where Gaussians cover the picture.
    pub fn loss_where_covered(&self, planes: &[f32]) -> Scored {
        let mut truth = self.truth.clone();
        let pixels = truth.len() / 3;
        for (i, weight) in coverage_weights(planes, pixels).enumerate() {
            for j in [i, i + pixels, i + 2 * pixels] {
                truth[j] = planes[j] + weight * (truth[j] - planes[j]);
            }
        }
        self.loss_to(planes, &truth)
    }

    /// Mean squared difference of rendered planes `[5, H, W]`.
    pub fn error(&self, planes: &[f32]) -> f64 {
        mse(&planes[..self.truth.len()], &self.truth).value
    }

    /// Mean squared difference of planes `[5, H, W]` where Gaussians cover the picture, 0 where they
    /// cover nothing, and the share of the picture that they cover.
    pub fn error_where_covered(&self, planes: &[f32]) -> [f64; 2] {
        let pixels = self.truth.len() / 3;
        let (mut sum, mut weights) = (0.0, 0.0);
        for (i, weight) in coverage_weights(planes, pixels).enumerate() {
            let elements = [i, i + pixels, i + 2 * pixels];
            let squares = elements.map(|j| f64::from(planes[j] - self.truth[j]).powi(2));
            sum += f64::from(weight) * squares.iter().sum::<f64>();
            weights += 3.0 * f64::from(weight);
        }
        let error = if weights > 0.0 { sum / weights } else { 0.0 };
        [error, weights / (3 * pixels).max(1) as f64]
    }
}

/// Weight of each pixel of planes `[5, H, W]` by its coverage, 0 to 1.
fn coverage_weights(planes: &[f32], pixels: usize) -> impl Iterator<Item = f32> + '_ {
    let weight = |alpha: &f32| ((alpha - COVERAGE_MIN) / (1.0 - COVERAGE_MIN)).clamp(0.0, 1.0);
    planes[3 * pixels..4 * pixels].iter().map(weight)
}

/// Returns the gradient of a loss by planes `[5, H, W]`: alpha and Σ w·z have no loss.
pub(super) fn by_planes(loss: Scored, planes: &[f32]) -> Vec<f32> {
    let mut gradient = loss.gradient;
    gradient.resize(planes.len(), 0.0);
    gradient
}

/// Size of a pixel at each Gaussian, in the photograph where it is smallest, world units.
pub(super) fn pixel_sizes(splats: &Splats, views: &[TargetView<'_>]) -> Vec<f32> {
    let size = |mean: Vec3, camera: &Camera| {
        mean.distance(camera.position()) / camera.intrinsics().fx.max(camera.intrinsics().fy)
    };
    let rows = splats.rows.par_chunks_exact(SPLAT_STRIDE);
    rows.map(|row| {
        let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
        views.iter().map(|v| size(mean, v.camera)).fold(f32::INFINITY, f32::min)
    })
    .collect()
}

/// Marks the Gaussians that reach beyond the photographs: none of them shows all of 3σ. The part
/// that a photograph shows would shrink and move it, and leave a black strip at the edge of new views.
/// Of five photographs this costs 0.04 dB, because the others show such Gaussians from elsewhere.
pub(super) fn beyond(splats: &Splats, views: &[TargetView<'_>]) -> Vec<bool> {
    let shown = |row: &[f32], camera: &Camera| {
        let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
        let Some(p) = camera.project(mean) else { return false };
        let k = camera.intrinsics();
        let sigma = row[SCALE_OFFSET..SCALE_OFFSET + 3].iter().fold(0.0f32, |m, s| m.max(*s));
        let reach = 3.0 * sigma * k.fx.max(k.fy) / camera.to_camera(mean).z;
        let size = Vec2::new(k.width as f32, k.height as f32);
        p.cmpge(Vec2::splat(reach)).all() && p.cmple(size - reach).all()
    };
    let rows = splats.rows.par_chunks_exact(SPLAT_STRIDE);
    rows.map(|row| !views.iter().any(|v| shown(row, v.camera))).collect()
}
