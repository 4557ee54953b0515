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
//! A [`FitView`] is a picture with its camera. [`fit`] changes [`Splats`] in place.

use crate::files::image::Rgb;
use crate::loss;
use crate::loss::Scored;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use rayon::prelude::*;
use std::ops::ControlFlow;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{
    Geometry, Gradients, OPACITY_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, SplatSlices,
    gain_with_offsets,
};
use thiserror::Error;

/// Options of [`fit`]. The defaults were chosen on nine of the sixteen pairs of photographs that
/// `src/network/shipped/README.md` reports (scenes fox, hololens_table, re10k_0bf and re10k_0f68).
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

/// A picture that the Gaussians are to give.
#[derive(Clone, Copy, Debug)]
pub struct FitView<'a> {
    /// The picture's camera.
    pub camera: &'a Camera,
    /// The picture, of the camera's size.
    pub image: &'a Rgb,
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

/// Reason for which a fit ends without a result; the Gaussians are as before.
#[derive(Debug, Error)]
pub enum FitError {
    /// A picture does not have its camera's size.
    #[error("view {view}: expected a picture of {expected}, got {got}")]
    Size {
        /// Index of the view.
        view: usize,
        /// Size of the camera, px.
        expected: String,
        /// Size of the picture, px.
        got: String,
    },
    /// The callback ended the fit.
    #[error("cancelled")]
    Cancelled,
}

/// The Gaussians as predicted.
const PREDICTED: Start = Start { scale: 1.0, density: 1.0 };
/// Factors that are tried on children before the first step ([`has_sharper_start`]). The trained heads are twice as wide
/// and less than half as dense as children that tile their pixel.
const SHARPER: Start = Start { scale: 0.7, density: 2.0 };

/// Factors on σ and on the density −ln(1 − α).
#[derive(Clone, Copy, Debug)]
struct Start {
    scale: f32,
    density: f32,
}

/// Opacities are moved into [this, 1 − this], where the logit is finite.
const OPACITY_MARGIN: f32 = 1e-4;
/// Decay rates of Adam's means of the gradient and of its square.
const BETAS: [f32; 2] = [0.9, 0.99];
/// Keeps the quotient of a Gaussian without gradient finite.
const EPSILON: f32 = 1e-15;
/// Gaussians per parallel task.
const CHUNK: usize = 4096;
/// Parameters of one Gaussian: logit of the opacity, Δ ln σ, δ (RGB).
const PARAMETERS: usize = 5;

/// One Gaussian's parameters with Adam's state.
#[derive(Clone, Copy, Default)]
struct State {
    value: [f32; PARAMETERS],
    gradient: [f32; PARAMETERS],
    mean: [f32; PARAMETERS],
    square: [f32; PARAMETERS],
}

/// Copies of the buffers that a fit changes.
struct Fitted {
    rows: Vec<f32>,
    /// `[N, 4]`.
    gain: Vec<f32>,
}

impl Fitted {
    fn new(splats: &Splats) -> Self {
        Self { rows: splats.rows.clone(), gain: gain_with_offsets(&splats.gain, splats.len()) }
    }

    fn slices<'a>(&'a self, splats: &'a Splats) -> SplatSlices<'a> {
        SplatSlices {
            geometry: Geometry::Packed(&self.rows),
            sh: &splats.sh,
            gain: &self.gain,
            sh_degree: splats.sh_degree,
        }
    }

    /// Writes scales and opacities of `splats`, changed by `start`; opacities keep away from 0
    /// and 1.
    fn begin(&mut self, splats: &Splats, start: Start) {
        let rows = self.rows.par_chunks_exact_mut(SPLAT_STRIDE);
        rows.zip(splats.rows.par_chunks_exact(SPLAT_STRIDE)).for_each(|(row, predicted)| {
            for i in SCALE_OFFSET..SCALE_OFFSET + 3 {
                row[i] = predicted[i] * start.scale;
            }
            let free = 1.0 - predicted[OPACITY_OFFSET].clamp(0.0, 1.0);
            let alpha = 1.0 - free.powf(start.density);
            row[OPACITY_OFFSET] = alpha.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        });
    }

    /// Writes the parameters of `states`, which began at `start`.
    fn apply(&mut self, states: &[State], splats: &Splats, start: Start) {
        let channels = splats.gain_channels();
        let rows = self.rows.par_chunks_exact_mut(SPLAT_STRIDE);
        let rows = rows.zip(splats.rows.par_chunks_exact(SPLAT_STRIDE));
        let gains = self.gain.par_chunks_exact_mut(4).enumerate();
        states.par_iter().zip(rows.zip(gains)).with_min_len(CHUNK).for_each(
            |(state, ((row, predicted), (i, gain)))| {
                let factor = start.scale * state.value[1].exp();
                for i in SCALE_OFFSET..SCALE_OFFSET + 3 {
                    row[i] = predicted[i] * factor;
                }
                row[OPACITY_OFFSET] = 1.0 / (1.0 + (-state.value[0]).exp());
                for c in 0..3 {
                    let offset = if channels == 4 { splats.gain[4 * i + 1 + c] } else { 0.0 };
                    gain[1 + c] = offset + state.value[2 + c];
                }
            },
        );
    }
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
    views: &[FitView<'_>],
    raster: &RasterOptions,
    options: &FitOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> Result<FitReport, FitError> {
    let targets = views.iter().enumerate().map(|(i, v)| Target::new(i, v, options.dssim));
    let targets = targets.collect::<Result<Vec<_>, _>>()?;
    let raster = RasterOptions { sh_basis: splats.sh_basis, ..*raster };
    if options.steps == 0 || targets.is_empty() || splats.is_empty() {
        return Ok(FitReport { before: 0.0, after: 0.0 });
    }
    let mut scene = Scene { splats, targets: &targets, raster: &raster, renderer };
    let mut fitted = Fitted::new(splats);
    fitted.begin(splats, PREDICTED);
    let before = scene.loss(&fitted);
    let mut start = PREDICTED;
    if has_sharper_start(splats, views) {
        fitted.begin(splats, SHARPER);
        match scene.loss(&fitted) < before {
            true => start = SHARPER,
            false => fitted.begin(splats, PREDICTED),
        }
    }
    let rows = fitted.rows.par_chunks_exact(SPLAT_STRIDE);
    let mut states: Vec<State> = rows.map(|row| State::of(row[OPACITY_OFFSET])).collect();
    let mut gradients = Gradients::default();
    for step in 1..=options.steps {
        for target in &targets {
            scene.gradient(&fitted, target, &mut gradients);
            add_gradients(&mut states, &gradients, &fitted);
        }
        update(&mut states, step, options);
        fitted.apply(&states, splats, start);
        if progress(step).is_break() {
            return Err(FitError::Cancelled);
        }
    }
    drop((states, gradients));
    let after = scene.loss(&fitted);
    // A loss that is not a number fails the comparison as well.
    if !(after < before) {
        return Ok(FitReport { before, after: before });
    }
    splats.rows = fitted.rows;
    splats.gain = fitted.gain;
    Ok(FitReport { before, after })
}

/// Returns whether the start [`SHARPER`] is for these Gaussians: children of a primary (K > 1), of
/// which the pictures have no fewer pixels. Gaussians with different numbers of siblings have an SH
/// set each and start as predicted: new views gain 0.1 dB and lose .05 of sharpness. Where Gaussians
/// are denser than pixels, their widths cannot be seen.
fn has_sharper_start(splats: &Splats, views: &[FitView<'_>]) -> bool {
    let pixels: usize = views.iter().map(|v| v.image.width * v.image.height).sum();
    splats.children_per_parent() > 1 && splats.len() <= pixels
}

/// A view with its truth as planes.
pub(crate) struct Target<'a> {
    pub(crate) camera: &'a Camera,
    /// `[3, H, W]`.
    pub(crate) truth: Vec<f32>,
    dssim: f64,
}

impl<'a> Target<'a> {
    /// Refuses a picture of another size than its camera.
    pub(crate) fn check(view: usize, v: &FitView<'_>) -> Result<(), FitError> {
        let k = v.camera.intrinsics();
        if (k.width, k.height) != (v.image.width, v.image.height) {
            let expected = format!("{}x{}", k.width, k.height);
            let got = format!("{}x{}", v.image.width, v.image.height);
            return Err(FitError::Size { view, expected, got });
        }
        Ok(())
    }

    pub(crate) fn new(view: usize, v: &FitView<'a>, dssim: f64) -> Result<Self, FitError> {
        Self::check(view, v)?;
        Ok(Self { camera: v.camera, truth: v.image.to_planes(), dssim })
    }

    /// The loss of rendered planes `[5, H, W]`, with its gradient by R, G and B.
    pub(crate) fn loss(&self, planes: &[f32]) -> Scored {
        self.loss_to(planes, &self.truth)
    }

    /// [`Target::loss`] with another `truth`.
    pub(crate) fn loss_to(&self, planes: &[f32], truth: &[f32]) -> Scored {
        let k = self.camera.intrinsics();
        let rgb = &planes[..truth.len()];
        let mut loss = loss::mse(rgb, truth);
        if self.dssim > 0.0 {
            loss.add(&loss::dssim(rgb, truth, k.width, k.height), self.dssim);
        }
        loss
    }
}

/// Gaussians, views and rules of a fit, which no step changes, and the renderer.
struct Scene<'a> {
    splats: &'a Splats,
    targets: &'a [Target<'a>],
    raster: &'a RasterOptions,
    renderer: &'a mut Renderer,
}

impl Scene<'_> {
    /// Mean loss over the views.
    fn loss(&mut self, fitted: &Fitted) -> f64 {
        let mut sum = 0.0;
        for target in self.targets {
            let slices = fitted.slices(self.splats);
            let planes = self.renderer.render_planes(&slices, target.camera, self.raster);
            sum += target.loss(&planes).value;
        }
        sum / self.targets.len() as f64
    }

    /// Gradients of the loss of one view.
    fn gradient(&mut self, fitted: &Fitted, target: &Target<'_>, out: &mut Gradients) {
        let slices = fitted.slices(self.splats);
        self.renderer.gradients_of(&slices, target.camera, self.raster, out, &mut |planes| {
            let mut gradient = target.loss(planes).gradient;
            // Alpha and Σ w·z have no loss.
            gradient.resize(planes.len(), 0.0);
            gradient
        });
    }
}

impl State {
    /// The state of a Gaussian with this opacity, before the first step.
    fn of(opacity: f32) -> Self {
        let logit = (opacity / (1.0 - opacity)).ln();
        Self { value: [logit, 0.0, 0.0, 0.0, 0.0], ..Self::default() }
    }
}

/// Adds one view's gradients by the parameters. A gradient that is not finite counts as 0.
fn add_gradients(states: &mut [State], gradients: &Gradients, fitted: &Fitted) {
    let rows = fitted.rows.par_chunks(CHUNK * SPLAT_STRIDE);
    let by_rows = gradients.rows.par_chunks(CHUNK * SPLAT_STRIDE);
    let by_gain = gradients.gain.par_chunks(CHUNK * 4);
    states.par_chunks_mut(CHUNK).zip(rows).zip(by_rows.zip(by_gain)).for_each(
        |((states, rows), (by_rows, by_gain))| {
            let rows = rows.chunks_exact(SPLAT_STRIDE).zip(by_rows.chunks_exact(SPLAT_STRIDE));
            for ((state, (row, g)), by_gain) in
                states.iter_mut().zip(rows).zip(by_gain.chunks_exact(4))
            {
                let alpha = row[OPACITY_OFFSET];
                let scale: f32 = (SCALE_OFFSET..SCALE_OFFSET + 3).map(|i| g[i] * row[i]).sum();
                let by_logit = g[OPACITY_OFFSET] * alpha * (1.0 - alpha);
                let all = [by_logit, scale, by_gain[1], by_gain[2], by_gain[3]];
                for (sum, g) in state.gradient.iter_mut().zip(all) {
                    *sum += if g.is_finite() { g } else { 0.0 };
                }
            }
        },
    );
}

/// One step of Adam with the summed gradients, which become 0.
fn update(states: &mut [State], step: usize, options: &FitOptions) {
    let [b1, b2] = BETAS;
    let n = i32::try_from(step).unwrap_or(i32::MAX);
    let (c1, c2) = (1.0 - b1.powi(n), 1.0 - b2.powi(n));
    let colour = options.colour_rate;
    let rates = [options.opacity_rate, options.scale_rate, colour, colour, colour];
    states.par_iter_mut().with_min_len(CHUNK).for_each(|s| {
        for (i, rate) in rates.into_iter().enumerate() {
            let g = s.gradient[i];
            s.mean[i] = b1 * s.mean[i] + (1.0 - b1) * g;
            s.square[i] = b2 * s.square[i] + (1.0 - b2) * g * g;
            s.value[i] -= rate * (s.mean[i] / c1) / ((s.square[i] / c2).sqrt() + EPSILON);
        }
        s.value[1] = s.value[1].clamp(-options.scale_limit, options.scale_limit);
        s.gradient = [0.0; PARAMETERS];
    });
}
