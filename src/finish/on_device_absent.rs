//! Stands in for `on_device.rs` without the feature `gpu`: no device takes the steps of a phase.

use super::dropout::Dropout;
use super::optimiser::{Numbers, Optimiser};
use super::phase::{LossWeights, Measure};
use super::targets::Target;
use crate::scene::render::Renderer;
use std::ops::Range;
use subsplat_kernels::layout::RasterOptions;

/// Gaussians under optimisation on a device; there are none.
pub(super) enum OnDevice {}

impl OnDevice {
    /// Returns `None`.
    pub fn new(
        _: &Renderer,
        _: &Optimiser<'_>,
        _: &[Target<'_>],
        _: impl Fn(usize) -> Range<usize>,
        _: &RasterOptions,
        _: LossWeights,
    ) -> Option<Self> {
        None
    }

    pub fn step(&mut self, _: Range<usize>, _: f32, _: Option<&Dropout>) -> bool {
        match *self {}
    }

    pub fn numbers(&self) -> Option<Numbers> {
        match *self {}
    }

    pub fn measure(&self, _: usize, _: Measure, _: Option<Range<usize>>) -> Option<[f64; 2]> {
        match *self {}
    }
}
