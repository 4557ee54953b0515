//! The choice of the convolution algorithm, in each direction.
//!
//! [`choose_algorithm`] decides for y and ∂L/∂x, [`choose_weight_grad_algorithm`] for
//! ∂L/∂w. No other place decides. All thresholds below were measured. The choice depends on
//! sizes only, never on the number of threads or on the SIMD level.

use super::direct::{Direct, DirectWeightGrad, LaneAxis};
use super::plan::Plan;
use super::pointwise::{self, Pointwise};
use super::winograd::{Kind, SmallImages, Winograd, WinogradWeightGrad, tiles_per_image};
use crate::cpu::simd::{LANES, SimdLevel};
use crate::cpu::uninit::UninitSlice;

/// Minimum source channels, and grid positions of an image, of [`Algorithm::Pointwise`].
const MIN_POINTWISE_CHANNELS: usize = 16;
const MIN_POINTWISE_POSITIONS: usize = 256;
/// Minimum source and destination channels of the Winograd algorithms.
const MIN_WINOGRAD_CHANNELS: usize = 24;
/// Images of fewer tiles use [`Algorithm::WinogradSmallImages`].
const MIN_TILES_PER_IMAGE: usize = 48;
/// Minimum tiles, of all images together, of [`WeightGradAlgorithm::Winograd`].
const MIN_WEIGHT_GRAD_TILES: usize = 8;
/// Maximum output channels for which [`WeightGradAlgorithm::DirectNarrow`] is faster.
pub(super) const MAX_NARROW_CHANNELS: usize = 8;

/// Arguments of [`Convolve::convolve`].
#[derive(Clone, Copy)]
pub(super) struct ConvolveArgs<'a> {
    /// SIMD level.
    pub level: SimdLevel,
    /// Geometry and direction: forward or input gradient.
    pub plan: &'a Plan,
    /// Source images `[B, source channels, …]`.
    pub x: &'a [f32],
    /// Weights `[O, C, kd, kh, kw]` in either direction.
    pub w: &'a [f32],
    /// Empty, or one number per destination channel.
    pub bias: &'a [f32],
}

/// An algorithm for y = x ∗ w + bias, and for ∂L/∂x with a plan of that direction.
pub(super) trait Convolve {
    /// Overwrites the images `y` `[B, destination channels, …]`. `y` is not empty.
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>);
}

/// Arguments of [`WeightGrad::weight_grad`].
#[derive(Clone, Copy)]
pub(super) struct WeightGradArgs<'a> {
    /// SIMD level.
    pub level: SimdLevel,
    /// Geometry of the forward convolution.
    pub plan: &'a Plan,
    /// Images `[B, C, …]`.
    pub x: &'a [f32],
    /// ∂L/∂y `[B, O, …]`.
    pub dy: &'a [f32],
}

impl WeightGradArgs<'_> {
    /// Returns B.
    pub fn images(&self) -> usize {
        self.x.len() / (self.plan.src_channels * self.plan.src_pixels())
    }
}

/// An algorithm for ∂L/∂w.
pub(super) trait WeightGrad {
    /// Overwrites `dw` `[O, C, kd, kh, kw]`. No slice is empty.
    fn weight_grad(&self, args: &WeightGradArgs<'_>, dw: &mut [f32]);
}

/// The algorithm of a forward convolution or an input gradient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Algorithm {
    /// 1×1 kernels as a matrix product.
    Pointwise,
    /// 3×3 kernels by Winograd, one image at a time.
    Winograd(Kind),
    /// 3×3 kernels by Winograd, tiles of all images together.
    WinogradSmallImages(Kind),
    /// Sums over channels and taps as the definition has them.
    Direct,
}

/// Chooses the algorithm for a forward convolution or an input gradient.
pub(super) fn choose_algorithm(plan: &Plan) -> Algorithm {
    if pointwise_pays(plan) {
        return Algorithm::Pointwise;
    }
    match winograd_kind(plan) {
        Some(kind) if plan.dst_size[0] == 1 && tiles_per_image(plan) < MIN_TILES_PER_IMAGE => {
            Algorithm::WinogradSmallImages(kind)
        }
        Some(kind) => Algorithm::Winograd(kind),
        None => Algorithm::Direct,
    }
}

impl Convolve for Algorithm {
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
        match *self {
            Self::Pointwise => Pointwise.convolve(args, y),
            Self::Winograd(kind) => Winograd { kind }.convolve(args, y),
            Self::WinogradSmallImages(kind) => SmallImages { kind }.convolve(args, y),
            Self::Direct => Direct.convolve(args, y),
        }
    }
}

/// The algorithm of a weight gradient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WeightGradAlgorithm {
    /// 1×1 kernels as a matrix product.
    Pointwise,
    /// 3×3 kernels by the adjoint of Winograd's algorithm.
    Winograd(Kind),
    /// Direct sums; vectors hold output channels.
    DirectWide,
    /// Direct sums for few output channels; vectors hold neighbouring outputs.
    DirectNarrow,
}

/// Chooses the algorithm for ∂L/∂w over `images` images; `plan` is that of the forward
/// convolution.
pub(super) fn choose_weight_grad_algorithm(plan: &Plan, images: usize) -> WeightGradAlgorithm {
    let channels = plan.dst_channels;
    if pointwise_pays(plan) && channels > MAX_NARROW_CHANNELS {
        return WeightGradAlgorithm::Pointwise;
    }
    // Between one vector and one and a half, the last vector would be half empty or worse.
    let half_empty = LANES + 1..=LANES + MAX_NARROW_CHANNELS;
    if channels <= MAX_NARROW_CHANNELS || half_empty.contains(&channels) {
        return WeightGradAlgorithm::DirectNarrow;
    }
    match winograd_kind(plan) {
        Some(kind) if images * tiles_per_image(plan) >= MIN_WEIGHT_GRAD_TILES => {
            WeightGradAlgorithm::Winograd(kind)
        }
        _ => WeightGradAlgorithm::DirectWide,
    }
}

impl WeightGrad for WeightGradAlgorithm {
    fn weight_grad(&self, args: &WeightGradArgs<'_>, dw: &mut [f32]) {
        let direct = |lanes| DirectWeightGrad { lanes };
        match *self {
            Self::Pointwise => Pointwise.weight_grad(args, dw),
            Self::Winograd(kind) => WinogradWeightGrad { kind }.weight_grad(args, dw),
            Self::DirectWide => direct(LaneAxis::OutputChannels).weight_grad(args, dw),
            Self::DirectNarrow => direct(LaneAxis::Outputs).weight_grad(args, dw),
        }
    }
}

/// Returns whether the matrix product supports `plan` and is the fastest algorithm for it.
fn pointwise_pays(plan: &Plan) -> bool {
    pointwise::supports(plan)
        && plan.src_channels >= MIN_POINTWISE_CHANNELS
        && plan.grid().iter().product::<usize>() >= MIN_POINTWISE_POSITIONS
}

/// Returns the kind of Winograd algorithm that supports `plan`, if it is faster than direct
/// sums.
fn winograd_kind(plan: &Plan) -> Option<Kind> {
    let channels = plan.src_channels.min(plan.dst_channels);
    Kind::of(plan).filter(|_| channels >= MIN_WINOGRAD_CHANNELS)
}
