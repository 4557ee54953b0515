//! Pointwise functions and softmax over rows, with gradients.

use super::fresh::{Block, Fresh};
use super::math::{erf, exp, vectorised};
use super::simd::{Kernel, LANES, Simd, Tier, exp2};
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
    let (most, n) = (largest(s, row), row.len());
    let row = row.as_mut_ptr();
    // SAFETY: the row itself.
    unsafe { exp_below(s, row, row, n, most) }
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

/// e^d for d ≤ 0 or NaN, to 1e-6 where the result is above 1e-5; 0 below 2⁻¹²⁵, so that
/// no denormals arise.
#[inline(always)]
fn exp_negative<S: Simd>(s: S, d: S::F) -> S::F {
    let (p, least) = (d * s.splat(std::f32::consts::LOG2_E), s.splat(-125.0));
    // The second operand is what comes out where the first is compared with NaN.
    s.select(s.lt(p, least), s.splat(0.0), exp2(s, s.max(least, p)))
}

/// e^{x − max} of `n` numbers at `x` to `y`; returns the sum.
///
/// # Safety
/// `x` points to n numbers, `y` to as many places, written or not: the same ones, or none
/// of them.
#[inline(always)]
unsafe fn exp_below<S: Simd>(s: S, x: *const f32, y: *mut f32, n: usize, max: f32) -> f32 {
    let (max, mut total) = (s.splat(max), 0.0);
    for part in (0..n).step_by(SUM) {
        let end = n.min(part + SUM);
        let mut sum = s.splat(0.0);
        for at in (part..end).step_by(LANES) {
            let mut lanes = [f32::NEG_INFINITY; LANES];
            if at + LANES <= end {
                // SAFETY: 16 places inside both.
                unsafe {
                    let e = exp_negative(s, s.load(&*x.add(at).cast()) - max);
                    sum = sum + e;
                    s.store(e, &mut lanes);
                    y.add(at).cast::<[f32; LANES]>().write(lanes);
                }
            } else {
                // SAFETY: the rest of both, fewer than 16.
                unsafe { x.add(at).copy_to_nonoverlapping(lanes.as_mut_ptr(), end - at) };
                let e = exp_negative(s, s.load(&lanes) - max);
                sum = sum + e;
                s.store(e, &mut lanes);
                // SAFETY: as above.
                unsafe { y.add(at).copy_from_nonoverlapping(lanes.as_ptr(), end - at) };
            }
        }
        total += f64::from(s.sum(sum));
    }
    total as f32
}

/// Softmax of every row of `x` `[rows, n]`, new memory.
pub fn softmax(n: usize, x: &[f32]) -> Vec<f32> {
    let chunk = CHUNK.div_ceil(n.max(1)) * n.max(1);
    let mut fresh = Fresh::new(x.len());
    fresh.blocks(chunk).zip(x.par_chunks(chunk)).for_each(|(y, x)| {
        Tier::best().run(Softmax { n, x, y });
    });
    // SAFETY: the loop above wrote every block.
    unsafe { fresh.finish() }
}

struct Softmax<'a> {
    n: usize,
    x: &'a [f32],
    y: &'a mut Block<f32>,
}

impl Kernel for Softmax<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { n, x, y } = self;
        assert_eq!(x.len(), y.len(), "softmax: lengths");
        // Pass by pass over some rows, which stay in the first-level cache: within one
        // each step waits for the last.
        let few = (SUM / n).clamp(1, TOGETHER) * n;
        for (x, y) in x.chunks(few).zip(y.chunks_mut(few)) {
            let mut kept = [0.0; TOGETHER];
            for (x, most) in x.chunks_exact(n).zip(&mut kept) {
                *most = largest(s, x);
            }
            let rows = x.chunks_exact(n).zip(y.chunks_exact_mut(n));
            for ((x, y), kept) in rows.zip(&mut kept) {
                // SAFETY: n numbers and n places apart from them.
                *kept = unsafe { exp_below(s, x.as_ptr(), y.as_mut_ptr().cast(), n, *kept) };
            }
            for (y, sum) in y.chunks_exact_mut(n).zip(&kept) {
                let inverse = 1.0 / sum;
                for v in y {
                    // SAFETY: written by the loop above.
                    *v = MaybeUninit::new(unsafe { v.assume_init() } * inverse);
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
