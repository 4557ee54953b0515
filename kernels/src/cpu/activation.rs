//! Pointwise functions, with gradients.

use super::simd::elementary::{erf, exp};
use super::simd::vectorize;
use super::uninit::{UninitBuffer, UninitSlice};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements per task: a compromise between overhead and balance.
const CHUNK: usize = 16_384;

/// A function of one number. NaN gives NaN; ±∞ gives what the formula's terms give.
///
/// `cpu/norm/silu.rs` joins SiLU to GroupNorm in one pass; other functions need no such file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// max(0, x).
    Relu,
    /// x·σ(x).
    Silu,
    /// x·Φ(x), exact form.
    Gelu,
    /// σ(x) = 1/(1 + e⁻ˣ).
    Sigmoid,
}

#[inline(always)]
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

#[inline(always)]
pub(super) fn normal_cdf(x: f32) -> f32 {
    0.5 * (1.0 + erf(x * std::f32::consts::FRAC_1_SQRT_2))
}

/// Calls `$run!(value, slope)` with f and f′ of `$kind` as closures, so that the loop in
/// `$run` is compiled for each function. Paths are absolute, because other modules use the macro;
/// a `$run` that needs values alone ignores the slope.
macro_rules! by_kind {
    ($kind:expr, $run:ident) => {
        match $kind {
            // This comparison keeps NaN.
            $crate::cpu::activation::Activation::Relu => $run!(
                #[inline(always)]
                |x: f32| if x < 0.0 { 0.0 } else { x },
                #[inline(always)]
                |x: f32| if x > 0.0 { 1.0 } else { 0.0 }
            ),
            $crate::cpu::activation::Activation::Silu => $run!(
                #[inline(always)]
                |x: f32| x * $crate::cpu::activation::sigmoid(x),
                #[inline(always)]
                |x: f32| {
                    let s = $crate::cpu::activation::sigmoid(x);
                    s * (1.0 + x * (1.0 - s))
                }
            ),
            $crate::cpu::activation::Activation::Gelu => $run!(
                #[inline(always)]
                |x: f32| x * $crate::cpu::activation::normal_cdf(x),
                // Φ(x) + x·φ(x), φ the normal density.
                #[inline(always)]
                |x: f32| $crate::cpu::activation::normal_cdf(x)
                    + x * 0.398_942_3 * $crate::cpu::simd::elementary::exp(-0.5 * x * x)
            ),
            $crate::cpu::activation::Activation::Sigmoid => $run!(
                #[inline(always)]
                |x: f32| $crate::cpu::activation::sigmoid(x),
                #[inline(always)]
                |x: f32| {
                    let s = $crate::cpu::activation::sigmoid(x);
                    s * (1.0 - s)
                }
            ),
        }
    };
}
pub(super) use by_kind;

/// Computes f(x) into new memory.
pub fn forward(kind: Activation, x: &[f32]) -> Vec<f32> {
    let mut buffer = UninitBuffer::new(x.len());
    buffer.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK)).for_each(|(y, x)| {
        vectorize(
            #[inline(always)]
            || {
                macro_rules! run {
                    ($value:expr, $slope:expr) => {
                        map(x, y, $value)
                    };
                }
                by_kind!(kind, run)
            },
        );
    });
    // SAFETY: the loop above wrote every block.
    unsafe { buffer.assume_init() }
}

#[inline(always)]
fn map(x: &[f32], y: &mut UninitSlice<f32>, f: impl Fn(f32) -> f32) {
    assert_eq!(x.len(), y.len(), "activation: lengths");
    for (y, x) in y.iter_mut().zip(x) {
        *y = MaybeUninit::new(f(*x));
    }
}

/// Computes dx = dy·f′(x).
pub fn backward(kind: Activation, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    let chunks = x.par_chunks(CHUNK).zip(dy.par_chunks(CHUNK));
    chunks.zip(dx.par_chunks_mut(CHUNK)).for_each(|((x, dy), dx)| {
        vectorize(
            #[inline(always)]
            || {
                macro_rules! run {
                    ($value:expr, $slope:expr) => {
                        scale(x, dy, dx, $slope)
                    };
                }
                by_kind!(kind, run)
            },
        );
    });
}

/// Replaces y by f(y), on the caller's thread.
pub(super) fn in_place(kind: Activation, y: &mut [f32]) {
    vectorize(
        #[inline(always)]
        || {
            macro_rules! run {
                ($value:expr, $slope:expr) => {
                    map_in_place(y, $value)
                };
            }
            by_kind!(kind, run)
        },
    );
}

/// Replaces x by dy·f′(x), on the caller's thread.
pub(super) fn slopes_in_place(kind: Activation, x: &mut [f32], dy: &[f32]) {
    vectorize(
        #[inline(always)]
        || {
            macro_rules! run {
                ($value:expr, $slope:expr) => {
                    scale_in_place(x, dy, $slope)
                };
            }
            by_kind!(kind, run)
        },
    );
}

#[inline(always)]
fn map_in_place(y: &mut [f32], f: impl Fn(f32) -> f32) {
    for y in y {
        *y = f(*y);
    }
}

#[inline(always)]
fn scale_in_place(x: &mut [f32], dy: &[f32], f: impl Fn(f32) -> f32) {
    for (x, dy) in x.iter_mut().zip(dy) {
        *x = dy * f(*x);
    }
}

#[inline(always)]
fn scale(x: &[f32], dy: &[f32], dx: &mut [f32], f: impl Fn(f32) -> f32) {
    for ((dx, dy), x) in dx.iter_mut().zip(dy).zip(x) {
        *dx = dy * f(*x);
    }
}
