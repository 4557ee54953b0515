//! Pointwise functions and softmax over rows, with gradients.

use super::math::{erf, exp, sum_of, vectorised};
use rayon::prelude::*;

/// Elements per task: long enough to hide the scheduling, short enough to balance.
const CHUNK: usize = 16_384;

/// A function of one number.
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
/// `$run` is compiled for each function.
macro_rules! by_kind {
    ($kind:expr, $run:ident) => {
        match $kind {
            // Written so that NaN stays NaN.
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
                    + x * 0.398_942_3 * $crate::cpu::math::exp(-0.5 * x * x)
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

/// y = f(x).
pub fn forward(kind: Activation, x: &[f32], y: &mut [f32]) {
    x.par_chunks(CHUNK).zip(y.par_chunks_mut(CHUNK)).for_each(|(x, y)| {
        vectorised(
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
}

#[inline(always)]
fn map(x: &[f32], y: &mut [f32], f: impl Fn(f32) -> f32) {
    for (y, x) in y.iter_mut().zip(x) {
        *y = f(*x);
    }
}

/// dx = dy·f′(x).
pub fn backward(kind: Activation, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    let chunks = x.par_chunks(CHUNK).zip(dy.par_chunks(CHUNK));
    chunks.zip(dx.par_chunks_mut(CHUNK)).for_each(|((x, dy), dx)| {
        vectorised(
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

/// y = f(y), on the caller's thread.
pub(super) fn in_place(kind: Activation, y: &mut [f32]) {
    vectorised(
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

/// x = dy·f′(x), on the caller's thread.
pub(super) fn slopes_in_place(kind: Activation, x: &mut [f32], dy: &[f32]) {
    vectorised(
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

/// One row to e^{x − max}; returns the sum. To be called inside `vectorised`.
#[inline(always)]
pub(super) fn exp_row(row: &mut [f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; 16];
    let chunks = row.chunks_exact(16);
    let tail = chunks.remainder().iter().fold(f32::NEG_INFINITY, |m, &v| m.max(v));
    for c in chunks {
        for i in 0..16 {
            lanes[i] = if c[i] > lanes[i] { c[i] } else { lanes[i] };
        }
    }
    let max = lanes.iter().fold(tail, |m, &v| m.max(v));
    for v in row.iter_mut() {
        *v = exp(*v - max);
    }
    sum_of(row, |v| v) as f32
}

/// Softmax of every row of `x` `[rows, n]`.
pub fn softmax(n: usize, x: &[f32], y: &mut [f32]) {
    let rows = CHUNK.div_ceil(n.max(1));
    x.par_chunks(rows * n.max(1)).zip(y.par_chunks_mut(rows * n.max(1))).for_each(|(x, y)| {
        y.copy_from_slice(x);
        vectorised(
            #[inline(always)]
            || {
                for row in y.chunks_exact_mut(n) {
                    let inverse = 1.0 / exp_row(row);
                    row.iter_mut().for_each(|v| *v *= inverse);
                }
            },
        );
    });
}

/// dx = y·(dy − Σ y·dy) row by row, y the softmax.
pub fn softmax_backward(n: usize, y: &[f32], dy: &[f32], dx: &mut [f32]) {
    let chunk = CHUNK.div_ceil(n.max(1)) * n.max(1);
    let rows = y.par_chunks(chunk).zip(dy.par_chunks(chunk));
    rows.zip(dx.par_chunks_mut(chunk)).for_each(|((y, dy), dx)| {
        vectorised(
            #[inline(always)]
            || {
                let pairs = y.chunks_exact(n).zip(dy.chunks_exact(n));
                for ((y, dy), dx) in pairs.zip(dx.chunks_exact_mut(n)) {
                    let mean = super::math::dot(y, dy);
                    for ((dx, y), dy) in dx.iter_mut().zip(y).zip(dy) {
                        *dx = y * (dy - mean);
                    }
                }
            },
        );
    });
}
