//! The steps of a phase in the memory of a GPU: only the number of pairs of a frame, the measure
//! and the Gaussians are read back ([`subsplat_kernels::gpu::SceneOptimiser`]).
//!
//! Not every phase fits a device: scene and frames need a binding each. After an error the state of
//! the device is unknown. In both cases the caller takes the steps with [`super::optimiser`], from
//! the Gaussians that it has. Without the feature `gpu`: `on_device_absent.rs`. Tests:
//! tests/gpu/refine.rs.

use super::dropout::Dropout;
use super::loss::ssim_window;
use super::optimiser::{Numbers, Optimiser, corrections};
use super::phase::{LossWeights, Measure};
use super::targets::{COVERAGE_MIN, Target};
use crate::scene::render::Renderer;
use std::cell::RefCell;
use std::ops::Range;
use subsplat_kernels::gpu::{
    GpuError, LossRules, MeasuredSplats, OptimiserRules, OptimiserStep, OptimiserTarget,
    PixelWeights, Rates, SceneOptimiser,
};
use subsplat_kernels::layout::RasterOptions;

/// Gaussians under optimisation on a device.
pub(super) struct OnDevice {
    /// `None` after an error.
    optimiser: RefCell<Option<SceneOptimiser>>,
    steps: i32,
}

impl OnDevice {
    /// Copies the Gaussians of `optimiser`, before its first step, to the GPU of `renderer`.
    /// `across` returns the Gaussians that a photograph draws alone. `None` without a GPU, or where
    /// it is too small.
    pub fn new(
        renderer: &Renderer,
        optimiser: &Optimiser<'_>,
        targets: &[Target<'_>],
        across: impl Fn(usize) -> Range<usize>,
        raster: &RasterOptions,
        weights: LossWeights,
    ) -> Option<Self> {
        let gpu = renderer.gpu()?;
        let loss =
            LossRules { dssim: weights.dssim, window: ssim_window(), coverage_min: COVERAGE_MIN };
        let rules = OptimiserRules { raster, loss, across: weights.across };
        let copied = || {
            let targets = targets.iter().enumerate().map(|(i, target)| {
                let (camera, picture) = (target.camera, target.picture(gpu)?);
                Ok(OptimiserTarget { camera, picture, across: across(i) })
            });
            let targets = targets.collect::<Result<_, GpuError>>()?;
            SceneOptimiser::new(gpu.clone(), &optimiser.for_device(), targets, &rules)
        };
        Some(Self { optimiser: RefCell::new(Some(copied().ok()?)), steps: 0 })
    }

    /// Calls `f`; `None` after an error, this one or an earlier one.
    fn try_with<T>(&self, f: impl FnOnce(&mut SceneOptimiser) -> Result<T, GpuError>) -> Option<T> {
        let mut optimiser = self.optimiser.borrow_mut();
        let result = f(optimiser.as_mut()?);
        if result.is_err() {
            *optimiser = None;
        }
        result.ok()
    }

    /// Takes a step on some photographs; `factor` multiplies all rates. Returns whether the device
    /// could.
    pub fn step(&mut self, targets: Range<usize>, factor: f32, dropout: Option<&Dropout>) -> bool {
        self.steps = self.steps.saturating_add(1);
        let rates = Rates { factor, corrections: corrections(self.steps) };
        let left_out = dropout.map(Dropout::for_device);
        let step = OptimiserStep { targets, rates, left_out };
        self.try_with(|optimiser| optimiser.step(step)).is_some()
    }

    /// The numbers of the Gaussians after all steps; `None` where the device lost them.
    pub fn numbers(&self) -> Option<Numbers> {
        self.try_with(SceneOptimiser::numbers).map(Numbers::from)
    }

    /// The measure of photograph `view` and the share of it that counts; without the Gaussians
    /// `own`, where these are given. `None` where the device lost them.
    pub fn measure(
        &self,
        view: usize,
        measure: Measure,
        own: Option<Range<usize>>,
    ) -> Option<[f64; 2]> {
        let (splats, weights) = match own {
            Some(own) => (MeasuredSplats::Without(own), PixelWeights::Covered),
            None => (MeasuredSplats::All, PixelWeights::Equal),
        };
        let loss = self.try_with(|optimiser| optimiser.loss(view, &splats, weights))?;
        Some(match measure {
            Measure::Loss => [loss.value, 1.0],
            Measure::Difference => [loss.error, loss.covered],
        })
    }
}
