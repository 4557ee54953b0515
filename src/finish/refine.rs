//! Refines Gaussians on the photographs that they were made from: means, rotations, scales,
//! opacities and colour offsets, by gradient steps through the rasterizer.
//!
//! [`fit`](super::fit()) changes sizes, opacities and colours alone and ends after four steps. A
//! refinement changes the geometry too: each photograph shows surfaces whose depth the others
//! predict. The method is the optimisation of *3D Gaussian Splatting for
//! Real-Time Radiance Field Rendering* (Kerbl et al. 2023), from the network's Gaussians instead
//! of sparse points, hence some dozens of steps instead of 30,000.
//!
//! Of three photographs or more, parents are removed first that show little of all of them
//! ([`RefineOptions::least_share`]): they lie behind the surfaces of other photographs, or repeat them.
//!
//! A photograph tells little about a scene that was optimised to give it back. The measure of two
//! photographs is therefore each of them drawn from the other's Gaussians alone, where these cover it. This
//! picture is also part of the loss ([`RefineOptions::across`]), because two alone do not tell a wrong depth
//! that gives both of them back. Steps end where the error no longer falls, and a set whose error has not
//! fallen at all stays unchanged.
//!
//! Of more photographs each Gaussian moves for all of them, and the measure is the photographs drawn from all
//! Gaussians. Drawn from the others' alone, five photographs of a clip fell from 25.0 to 23.2 dB in 400 steps
//! while new views rose from 28.6 to 29.4 dB: Gaussians of the others make way for a photograph's own.
//!
//! Of three photographs or more, SH coefficients of degree 1 move too, where each Gaussian has a set of its own,
//! and each step leaves some Gaussians out ([`RefineOptions::dropout`]). New views of scenes of
//! `../shared/photos` at 128 → 256, PSNR / SSIM. SH, on the scenes that chose the numbers: five photographs 23.82 /
//! .791 without, 23.92 / .792 with it, nine 29.33 / .883 and 29.56 / .883. Gaussians left out: five 23.93 / .793
//! without, 23.97 / .799 with it, on other scenes 25.28 / .848 and 25.31 / .857; nine 29.56 / .884 and 29.51 /
//! .888. Pairs lose 0.08 and 0.03 dB by it, so two photographs draw all.
//!
//! One step draws one photograph, in an order that depends on their number only. The same input
//! gives the same bytes on any number of threads, unless [`RefineOptions::time`] limits the steps.

use super::phase::Phase;
use super::phase_run::{Outcome, PhaseRun, run};
use super::removal::{Groups, LEAST_SHARE};
use super::targets::{MaskedView, whole};
use super::{FinishError, TargetView};
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use std::ops::ControlFlow;
use std::time::Duration;
use subsplat_kernels::layout::RasterOptions;

/// Options of a refinement. The rates were chosen on six scenes of `../shared/photos` at
/// 128 → 256 with five photographs, targets between them.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct RefineOptions {
    /// Most gradient steps; 0 leaves the Gaussians as they are. Default: 40.
    pub steps: usize,
    /// Step of the means, px of the photograph that shows the Gaussian at the largest scale. Default: 0.3.
    pub mean_rate: f32,
    /// Step of the unit quaternions' elements. Default: 0.03.
    pub rotation_rate: f32,
    /// Step of ln σ, each axis of its own. Default: 0.06.
    pub scale_rate: f32,
    /// Step of the opacities' logits. Default: 0.15.
    pub opacity_rate: f32,
    /// Step of the colour offsets δ, display values. Default: 0.012.
    pub colour_rate: f32,
    /// Step of the SH coefficients of degree 1, where each Gaussian has its own and there are three photographs
    /// or more. Default: 0.02.
    pub sh_rate: f32,
    /// Weight of (1 − SSIM)/2 beside the mean squared difference. Default: 0.2.
    pub dssim: f64,
    /// Weight of the loss of each of two photographs, drawn from the other's Gaussians alone. It
    /// changes geometry and opacity, not colours. No effect on other numbers of photographs, or
    /// without `grouped`. Default: 1.
    pub across: f32,
    /// Least share of a parent in the photographs: the weight of its children in all pixels, over
    /// that of an average parent. Parents below it are removed, where `grouped` is set and there are
    /// three photographs or more. Two photographs show most places twice at most, so nothing is
    /// removed. 0 keeps all. Default: 0.3.
    pub least_share: f32,
    /// Each step of N photographs, three or more, leaves out this share over N of the Gaussians, a tenth at
    /// most, and others in the next step. 0 draws all. Default: 0.5.
    pub dropout: f32,
    /// Longest duration of the steps; the rates fall over it, or over `steps` where these end first. The result
    /// then depends on the machine. Refused where there is no clock (WebAssembly without an operating
    /// system). Default: none.
    pub time: Option<Duration>,
    /// The Gaussians are in equal groups, one for each photograph in their order, as
    /// [`Reconstruction::splats`](crate::Reconstruction::splats) has them. Without groups, nothing is removed,
    /// and the measure of two photographs is the pictures of all Gaussians. Default: false.
    pub grouped: bool,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            steps: 40,
            mean_rate: 0.3,
            rotation_rate: 0.03,
            scale_rate: 0.06,
            opacity_rate: 0.15,
            colour_rate: 0.012,
            sh_rate: 0.02,
            dssim: 0.2,
            across: 1.0,
            least_share: LEAST_SHARE,
            dropout: 0.5,
            time: None,
            grouped: false,
        }
    }
}

impl RefineOptions {
    /// Sets [`RefineOptions::steps`].
    #[must_use]
    pub fn with_steps(mut self, steps: usize) -> Self {
        self.steps = steps;
        self
    }

    /// Sets [`RefineOptions::across`].
    #[must_use]
    pub fn with_across(mut self, weight: f32) -> Self {
        self.across = weight;
        self
    }

    /// Sets [`RefineOptions::least_share`].
    #[must_use]
    pub fn with_least_share(mut self, share: f32) -> Self {
        self.least_share = share;
        self
    }

    /// Sets [`RefineOptions::time`], and no limit of steps.
    #[must_use]
    pub fn with_time(mut self, time: Duration) -> Self {
        (self.time, self.steps) = (Some(time), usize::MAX);
        self
    }

    /// Sets [`RefineOptions::grouped`].
    #[must_use]
    pub fn with_groups(mut self, grouped: bool) -> Self {
        self.grouped = grouped;
        self
    }
}

impl RefineOptions {
    /// Returns whether a [`fit`](super::fit()) before this refinement of Gaussians on a number of photographs improves
    /// new views: not with three photographs or more and enough steps.
    ///
    /// New views of `../shared/photos`, 128 → 256, with the fit and without: sixteen pairs 19.96 dB / .731 and 19.82 /
    /// .720; four scenes with three photographs (40 steps) 18.52 / .653 and 18.51 / .652, five 23.49 / .790 and 23.48 /
    /// .790, nine 25.57 / .832 and 25.59 / .832. It takes an eighth of the time of three photographs. A limit of time
    /// does not count it: seventeen photographs of `fox` at 512² with a limit of 60 s have 29.00 dB / .870 with it (17 s
    /// on two cores of an EPYC with AVX2), 28.82 dB without.
    pub fn needs_fit(&self, photographs: usize) -> bool {
        /// Steps of the scenes above, less a quarter.
        const STEPS: usize = 30;
        photographs < 3 || self.steps < STEPS || self.time.is_some()
    }
}

/// Result of a refinement: mean squared difference of the photographs, display values. With
/// [`RefineOptions::grouped`], each of two is drawn from the other's Gaussians alone.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct RefineReport {
    /// Steps that were taken.
    pub steps: usize,
    /// Before the first step.
    pub before: f64,
    /// After the last step; equal to `before` where the Gaussians stayed as they were.
    pub after: f64,
    /// Gaussians that were removed ([`RefineOptions::least_share`]).
    pub removed: usize,
}

/// Refines `splats` on `views` in place. `progress` receives the refinement after each step, whose
/// [`PhaseRun::splats`] a caller can show; [`PhaseRun::end`] ends the steps and keeps what they gave;
/// [`ControlFlow::Break`] cancels. The colour offsets are added to the δ of
/// [`Splats::gain`], which has four numbers a Gaussian afterwards.
///
/// # Errors
/// A picture of another size than its camera; [`RefineOptions::time`] where there is no clock; a
/// cancelled refinement. The Gaussians are then unchanged.
pub fn refine(
    splats: &mut Splats,
    views: &[TargetView<'_>],
    raster: &RasterOptions,
    options: &RefineOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
) -> Result<RefineReport, FinishError> {
    let mut groups = Groups::equal(splats, views.len(), options.grouped);
    refine_groups(splats, &mut groups, &whole(views), raster, options, renderer, progress)
}

/// [`refine`] on the pixels that masks keep, with the Gaussians of each photograph in `groups`, which follow the
/// removal.
///
/// # Errors
/// Those of [`refine`]; a mask of another size than its camera.
pub(crate) fn refine_groups(
    splats: &mut Splats,
    groups: &mut Groups,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    options: &RefineOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
) -> Result<RefineReport, FinishError> {
    let phase = Phase::refine(options);
    let Outcome { steps, before, after, removed } =
        run(splats, groups, views, raster, &phase, renderer, progress)?;
    Ok(RefineReport { steps, before, after, removed })
}
