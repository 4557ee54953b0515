//! Convolutions (cross-correlations, as in PyTorch) over two or three axes: forward and both
//! gradients, any kernel, stride and zero padding, without an im2col matrix.
//!
//! ```text
//! y[b][o][p] = bias[o] + Σ_c Σ_tap w[o][c][tap] · x[b][c][stride·p + tap − padding]
//! ```
//!
//! Input: x `[B, C, D, H, W]`, w `[O, C, kd, kh, kw]`, bias `[O]` or empty. Output:
//! y `[B, O, D', H', W']`. In two dimensions D = 1 and kd = 1.
//! Invariant: the number of threads does not change a byte.
//! WGSL: none. Oracle and tests: conv/tests.rs (the definition in f64).
//!
//! `algorithm` chooses the algorithm, for each direction in one function:
//!
//! | algorithm | y and ∂L/∂x | ∂L/∂w | error bound | files |
//! |---|---|---|---|---|
//! | pointwise | 1×1 kernel, no padding, ≥ 16 source channels, ≥ 256 positions | the same, and > 8 output channels | 1.5e-6·√n | `pointwise` |
//! | Winograd | 3×3 kernel of stride 1 or 2, ≥ 24 channels on both sides | the same, ≥ 8 tiles | 3e-6·√n | `winograd` |
//! | direct | all others | all others; `narrow` for ≤ 8 or 17–24 output channels | 1.5e-6·√n | `direct` |
//!
//! The bound holds for numbers in ±1 and n products per sum; tests check it. Winograd for
//! images of fewer than 48 tiles is `winograd/small_images`.
//!
//! The path of a tile, for 8 destination channels at a time:
//!
//! ```text
//!  direct                           Winograd                         pointwise
//!
//!  source image [C][H][W]           source image [C][H][W]           source image [C][pixel]
//!  ┌──────────────────┐             ┌──────────────────┐             ┌──────────────────┐
//!  │   ┌──────┐       │             │ ┌┬┬┬┬┬┬┬┬┬┬┬┬┬┬┬┐│             │▒▒▒▒▒▒▒▒▒         │
//!  │   │ tile │       │             │ └┴┴┴┴┴┴┴┴┴┴┴┴┴┴┴┘│             │                  │
//!  │   └──────┘       │             │ 16 tiles         │             │ pixels           │
//!  └──────┬───────────┘             └──────┬───────────┘             └──────┬───────────┘
//!         │ copy with halo                 │ load with borders,             │ copy
//!         │ (packed_tile)                  │ Bᵀ·d·B (load_tiles)            │ (gemm)
//!         v                                v                                v
//!  packed tile, zero padding        transformed tiles                packed panels
//!  [C][plane][row][column]          [36 groups][C][tile]             [panel][C][64 pixels]
//!  ┌0─0─0─0─0─0┐                    (product_layout)                        │
//!  │0┌───────┐0│                           │                                │
//!  │0│ tile  │0│                           │                                │
//!  │0└───────┘0│                           │                                │
//!  └0─0─0─0─0─0┘                           │                                │
//!         │ shifted by each tap            │ weights G·g·Gᵀ                 │
//!         v                                v                                v
//!  register tile                    register tile                    register tile
//!  8 channels × 48 places           8 channels × 48 tiles            6 channels × 64 pixels
//!  Σ over C and taps                Σ over C, for each group         Σ over C
//!  (register_tile)                  (register_tile)                  (gemm)
//!         │                                v                                │
//!         │                         products [36 groups][8][tile]           │
//!         │                                │ Aᵀ·m·A + bias                  │
//!         │                                │ (products)                     │
//!         v                                v                                v
//!  destination [O][H'][W']          destination [O][H'][W']          destination [O][pixel]
//! ```
//!
//! ∂L/∂x is a convolution of ∂L/∂y and takes the same path (`plan`). ∂L/∂w multiplies the
//! packed or transformed tiles of x with those of ∂L/∂y and sums over all tiles
//! (`weight_grad_jobs`, `weight_grad_tile`).
//!
//! Vectors of a tile are written one by one. An array of vectors that is assigned as a whole is
//! copied through memory; without those copies a convolution took two thirds of the time.
//! Scratch memory that is used once per channel is cleared once per channel. Weights are
//! transformed or packed per call, for a few hundredths of the time: MVSplat's 8.3 M 3×3 weights,
//! kept in Winograd's form, would occupy 126 MiB, a quarter of the peak at 256 → 512.
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over register tiles unroll, iterators over them need not"
)]

mod algorithm;
mod bias_grad;
mod buffers;
mod direct;
mod packed_tile;
mod plan;
mod pointwise;
mod register_tile;
mod sizes;
#[cfg(test)]
mod tests;
mod weight_grad_jobs;
mod weight_grad_tile;
mod winograd;

use super::simd::SimdLevel;
use super::uninit::{UninitBuffer, UninitSlice};
use super::work;
use algorithm::{
    Algorithm, Convolve, ConvolveArgs, WeightGrad, WeightGradAlgorithm, WeightGradArgs,
    choose_algorithm, choose_weight_grad_algorithm,
};
use plan::Plan;

pub use bias_grad::bias_grad;
pub use sizes::{Axes, Sizes};

/// Computes y = x ∗ w + bias of `images` images; `bias` is empty or `[O]`.
pub fn forward(
    level: SimdLevel,
    s: &Sizes,
    images: usize,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    convolve(&ConvolveArgs { level, plan: &Plan::forward(s), x, w, bias }, images)
}

/// Computes ∂L/∂x from ∂L/∂y of `images` images.
pub fn input_grad(level: SimdLevel, s: &Sizes, images: usize, dy: &[f32], w: &[f32]) -> Vec<f32> {
    convolve(&ConvolveArgs { level, plan: &Plan::input_grad(s), x: dy, w, bias: &[] }, images)
}

/// Computes ∂L/∂w from x and ∂L/∂y; overwrites `dw`.
pub fn weight_grad(level: SimdLevel, s: &Sizes, x: &[f32], dy: &[f32], dw: &mut [f32]) {
    if dw.is_empty() || x.is_empty() || dy.is_empty() {
        dw.fill(0.0);
        return;
    }
    let args = WeightGradArgs { level, plan: &Plan::forward(s), x, dy };
    let algorithm = choose_weight_grad_algorithm(args.plan, args.images());
    if algorithm != WeightGradAlgorithm::Pointwise {
        work::add(args.plan.products(args.images()), x.len() + dy.len() + dw.len());
    }
    algorithm.weight_grad(&args, dw);
}

/// Convolves into new memory.
fn convolve(args: &ConvolveArgs<'_>, images: usize) -> Vec<f32> {
    let mut y = UninitBuffer::new(images * args.plan.dst_channels * args.plan.dst_pixels());
    convolve_into(args, y.as_mut_slice());
    // SAFETY: each algorithm writes every channel of every image, in tiles that cover it
    // (the tests run them over memory full of NaN).
    unsafe { y.assume_init() }
}

/// Convolves into `y`, by the algorithm that [`choose_algorithm`] returns.
fn convolve_into(args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
    if y.is_empty() {
        return;
    }
    let ConvolveArgs { plan, x, w, .. } = *args;
    let algorithm = choose_algorithm(plan);
    // The matrix product counts its own work.
    if algorithm != Algorithm::Pointwise {
        let images = y.len() / (plan.dst_channels * plan.dst_pixels());
        work::add(plan.products(images), x.len() + w.len() + y.len());
    }
    algorithm.convolve(args, y);
}
