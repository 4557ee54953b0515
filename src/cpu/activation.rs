//! Pointwise functions and softmax over rows, with gradients.

use super::fresh::{Block, Fresh, fill};
use super::math::{erf, exp, vectorised};
use super::simd::{Kernel, LANES, Simd, Tier, exp as exp_lanes};
use rayon::prelude::*;
use std::mem::MaybeUninit;

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

/// f(x), new memory.
pub fn forward(kind: Activation, x: &[f32]) -> Vec<f32> {
    let mut fresh = Fresh::new(x.len());
    fresh.blocks(CHUNK).zip(x.par_chunks(CHUNK)).for_each(|(y, x)| {
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
    // SAFETY: the loop above wrote every block.
    unsafe { fresh.finish() }
}

#[inline(always)]
fn map(x: &[f32], y: &mut Block<f32>, f: impl Fn(f32) -> f32) {
    assert_eq!(x.len(), y.len(), "activation: lengths");
    for (y, x) in y.iter_mut().zip(x) {
        *y = MaybeUninit::new(f(*x));
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

/// Rows of a pass of [`softmax`].
const TOGETHER: usize = 16;
/// Elements whose exponentials are one sum in single precision.
const SUM: usize = 4096;

/// A row to e^{x − max}; returns the sum. To be called inside a kernel.
#[inline(always)]
pub(super) fn exp_row<S: Simd>(s: S, row: &mut [f32]) -> f32 {
    let most = largest(s, row);
    exp_below(s, row, most)
}

/// The largest number of a row; NaN are passed over.
#[inline(always)]
fn largest<S: Simd>(s: S, row: &[f32]) -> f32 {
    let mut tops = [s.splat(f32::NEG_INFINITY); 4];
    let (chunks, tail) = row.as_chunks::<LANES>();
    let (fours, rest) = chunks.as_chunks::<4>();
    for four in fours {
        for (top, v) in tops.iter_mut().zip(four) {
            *top = s.max(s.load(v), *top);
        }
    }
    for v in rest {
        tops[0] = s.max(s.load(v), tops[0]);
    }
    let mut top = s.max(s.max(tops[0], tops[1]), s.max(tops[2], tops[3]));
    if !tail.is_empty() {
        let mut last = [f32::NEG_INFINITY; LANES];
        last[..tail.len()].copy_from_slice(tail);
        top = s.max(s.load(&last), top);
    }
    let mut lanes = [0.0; LANES];
    s.store(top, &mut lanes);
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            let other = lanes[i + half];
            lanes[i] = if other > lanes[i] { other } else { lanes[i] };
        }
    }
    lanes[0]
}

/// A row to e^{x − max}; returns the sum.
#[inline(always)]
fn exp_below<S: Simd>(s: S, row: &mut [f32], max: f32) -> f32 {
    let (max, mut total) = (s.splat(max), 0.0);
    for part in row.chunks_mut(SUM) {
        let (chunks, tail) = part.as_chunks_mut::<LANES>();
        let mut sum = s.splat(0.0);
        for v in chunks {
            let e = exp_lanes(s, s.load(v) - max);
            sum = sum + e;
            s.store(e, v);
        }
        if !tail.is_empty() {
            let mut last = [f32::NEG_INFINITY; LANES];
            last[..tail.len()].copy_from_slice(tail);
            let e = exp_lanes(s, s.load(&last) - max);
            sum = sum + e;
            s.store(e, &mut last);
            tail.copy_from_slice(&last[..tail.len()]);
        }
        total += f64::from(s.sum(sum));
    }
    total as f32
}

/// Softmax of every row of `x` `[rows, n]`, new memory.
pub fn softmax(n: usize, x: &[f32]) -> Vec<f32> {
    let chunk = CHUNK.div_ceil(n.max(1)) * n.max(1);
    let mut fresh = Fresh::new(x.len());
    fresh.blocks(chunk).zip(x.par_chunks(chunk)).for_each(|(block, x)| {
        // A few rows at a time stay in the first-level cache.
        let few = (SUM / n.max(1)).max(1) * n.max(1);
        for (block, x) in block.chunks_mut(few).zip(x.chunks(few)) {
            let y = fill(block, x);
            Tier::best().run(Softmax { n, y });
        }
    });
    // SAFETY: the loop above filled every block.
    unsafe { fresh.finish() }
}

struct Softmax<'a> {
    n: usize,
    y: &'a mut [f32],
}

impl Kernel for Softmax<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        // Pass by pass over some rows: within one each step waits for the last.
        for rows in self.y.chunks_mut(TOGETHER * self.n) {
            let mut kept = [0.0; TOGETHER];
            for (row, most) in rows.chunks_exact(self.n).zip(&mut kept) {
                *most = largest(s, row);
            }
            for (row, kept) in rows.chunks_exact_mut(self.n).zip(&mut kept) {
                *kept = exp_below(s, row, *kept);
            }
            for (row, sum) in rows.chunks_exact_mut(self.n).zip(&kept) {
                let inverse = 1.0 / sum;
                for v in row {
                    *v *= inverse;
                }
            }
        }
    }
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
