//! Fits Gaussians to the photographs that they were made from: sizes, opacities and colour
//! offsets, by a few gradient steps through the rasterizer. Means, rotations and SH stay.
//!
//! A network that is unsure of depth predicts wide, transparent Gaussians, because a mean
//! squared error prefers blur to displaced edges. The photographs are known when a scene is
//! made, so the Gaussians can be fitted to them. The method is the optimisation of
//! *3D Gaussian Splatting for Real-Time Radiance Field Rendering* (Kerbl et al. 2023: L2 with
//! D-SSIM, Adam's step sizes), restricted to parameters that keep the geometry, and stopped
//! early: more steps give the photographs back better and new views worse.
//!
//! A [`TargetView`] is a picture with its camera. [`fit`] changes [`Splats`] in place.

use super::phase::Phase;
use super::phase_run::{Outcome, PhaseRun, run};
use super::removal::Groups;
use super::targets::{MaskedView, whole};
use super::{FinishError, TargetView};
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use std::ops::ControlFlow;
use subsplat_kernels::layout::RasterOptions;

/// Options of [`fit`]. The defaults were chosen on nine of the sixteen pairs of photographs that
/// `tools/lab/tried.md` reports (scenes fox, hololens_table, re10k_0bf and re10k_0f68).
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct FitOptions {
    /// Number of gradient steps; 0 leaves the Gaussians as they are. Default: 4.
    pub steps: usize,
    /// Step of the opacities' logits. Default: 0.3.
    pub opacity_rate: f32,
    /// Step of ln σ, one for the three axes of a Gaussian. Default: 0.25.
    pub scale_rate: f32,
    /// Step of the colour offsets δ, display values. Default: 0.018.
    pub colour_rate: f32,
    /// Largest |Δ ln σ|. Default: 0.5.
    pub scale_limit: f32,
    /// Weight of (1 − SSIM)/2 beside the mean squared difference. Default: 0.2.
    pub dssim: f64,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            steps: 4,
            opacity_rate: 0.3,
            scale_rate: 0.25,
            colour_rate: 0.018,
            scale_limit: 0.5,
            dssim: 0.2,
        }
    }
}

impl FitOptions {
    /// Options that change nothing.
    pub fn off() -> Self {
        Self { steps: 0, ..Self::default() }
    }

    /// Sets [`FitOptions::steps`].
    #[must_use]
    pub fn with_steps(mut self, steps: usize) -> Self {
        self.steps = steps;
        self
    }
}

/// Loss at the views before and after a fit: mean over the views of the mean squared difference
/// plus the weighted dissimilarity.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct FitReport {
    /// Before the first step.
    pub before: f64,
    /// After the last step.
    pub after: f64,
}

/// Fits `splats` to `views`, which are rendered by the rules `raster` in the splats' own SH basis.
/// `progress` receives the number of steps done; [`ControlFlow::Break`] cancels.
///
/// Children of a primary (K > 1), no more of them than pixels, start with 0.7 of their σ and twice
/// their density where that decreases the loss. A set whose loss would not decrease stays
/// unchanged. The colour offsets are added to the δ of [`Splats::gain`], which has four numbers a
/// Gaussian afterwards.
///
/// # Errors
/// A picture of another size than its camera; a cancelled fit. The Gaussians are then unchanged.
pub fn fit(
    splats: &mut Splats,
    views: &[TargetView<'_>],
    raster: &RasterOptions,
    options: &FitOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> Result<FitReport, FinishError> {
    fit_masked(splats, &whole(views), raster, options, renderer, progress)
}

/// [`fit`] to the pixels that masks keep.
///
/// # Errors
/// Those of [`fit`]; a mask of another size than its camera.
pub(crate) fn fit_masked(
    splats: &mut Splats,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    options: &FitOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> Result<FitReport, FinishError> {
    let phase = Phase::fit(options, has_sharper_start(splats, views));
    let mut groups = Groups::default();
    let mut step = |phase: &PhaseRun<'_>| progress(phase.steps());
    let Outcome { before, after, .. } =
        run(splats, &mut groups, views, raster, &phase, renderer, &mut step)?;
    Ok(FitReport { before, after })
}

/// Returns whether the sharper start is for these Gaussians: children of a primary (K > 1), of
/// which the pictures have no fewer pixels. Gaussians with different numbers of siblings have an SH
/// set each and start as predicted: new views gain 0.1 dB and lose .05 of sharpness. Where Gaussians
/// are denser than pixels, their widths cannot be seen.
fn has_sharper_start(splats: &Splats, views: &[MaskedView<'_>]) -> bool {
    let pixels: usize = views.iter().map(MaskedView::pixels).sum();
    splats.children_per_parent() > 1 && splats.len() <= pixels
}
