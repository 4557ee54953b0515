//! Softmax over rows, with its gradient.
//! Oracle: the definition in f64 (`model::layers`' tests).

use super::simd::elementary::exp2_by_sums;
use super::simd::vectorize;
use super::simd::{Kernel, LANES, Mask, Simd, SimdLevel, Vector, first_lanes_bits};
use super::uninit::{UninitBuffer, UninitSlice};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements per task.
const CHUNK: usize = 16_384;
/// Exponentials that one single-precision sum adds, and numbers of a pass.
const SUM: usize = 4096;

/// Replaces a row by e^{x − max} and returns the sum. Call it inside a kernel.
#[inline(always)]
pub(super) fn exp_row<S: Simd>(s: S, row: &mut [f32]) -> f32 {
    let mut tops = [s.splat(f32::NEG_INFINITY); LANES];
    tops[0] = largest(s, row);
    let mut most = [0.0; LANES];
    s.store(across(s, tops), &mut most);
    // SAFETY: `exps` writes numbers to these places.
    let places = unsafe { super::uninit::as_uninit(row) }.as_mut_ptr();
    // SAFETY: source and destination are the same row.
    unsafe { exps(s, places.cast(), places, row.len(), most[0]) }
}

/// Computes the maximum of a row lane by lane, −∞ in lanes without a number; ignores NaN.
#[inline(always)]
fn largest<S: Simd>(s: S, row: &[f32]) -> S::F {
    let mut tops = [s.splat(f32::NEG_INFINITY); 4];
    let (chunks, tail) = row.as_chunks::<LANES>();
    let (fours, rest) = chunks.as_chunks::<4>();
    for four in fours {
        for (top, v) in tops.iter_mut().zip(four) {
            *top = top.max(s.load(v));
        }
    }
    for v in rest {
        tops[0] = tops[0].max(s.load(v));
    }
    if !tail.is_empty() {
        let bits = first_lanes_bits(tail.len());
        // SAFETY: `bits` selects the floats of `tail`.
        let v = unsafe { s.load_masked(tail.as_ptr(), bits) };
        let v = s.mask_from_bits(u32::from(bits)).select(v, tops[1]);
        tops[1] = tops[1].max(v);
    }
    tops[3].max(tops[2]).max(tops[1].max(tops[0]))
}

/// Computes the maximum lane of each vector.
#[inline(always)]
fn across<S: Simd>(s: S, v: [S::F; LANES]) -> S::F {
    let mut v = s.transpose(v);
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            v[i] = v[i].max(v[i + half]);
        }
    }
    v[0]
}

/// e^d for d ≤ 0 or NaN, to 1e-6 where the result is above 1e-5; 0 below 2⁻¹²⁵, so that no
/// denormal arises. One product replaces the two-part range reduction of
/// [`super::simd::elementary::exp`]: weights of attention do not need its last bits.
#[inline(always)]
fn exp_negative<S: Simd>(s: S, d: S::F) -> S::F {
    let p = d * s.splat(std::f32::consts::LOG2_E);
    p.lt(s.splat(-125.0)).select(s.splat(0.0), exp2_by_sums(p))
}

/// Writes e^{x − max} of `n` numbers at `x` to `y` and returns the sum.
///
/// # Safety
/// As of [`exp_part`].
#[inline(always)]
unsafe fn exps<S: Simd>(s: S, x: *const f32, y: *mut MaybeUninit<f32>, n: usize, max: f32) -> f32 {
    let (max, mut total) = (s.splat(max), 0.0);
    for at in (0..n).step_by(SUM) {
        // SAFETY: a part of both ranges.
        let sum = unsafe { exp_part(s, x.add(at), y.add(at), SUM.min(n - at), max) };
        total += f64::from(s.sum(sum));
    }
    total as f32
}

/// Writes e^{x − max} of `n` numbers at `x` to `y` and returns sums by lanes.
///
/// # Safety
/// `x` points to n numbers, `y` to as many places; the ranges are equal or disjoint.
#[inline(always)]
unsafe fn exp_part<S: Simd>(
    s: S,
    x: *const f32,
    y: *mut MaybeUninit<f32>,
    n: usize,
    max: S::F,
) -> S::F {
    let mut sum = s.splat(0.0);
    let whole = n / LANES * LANES;
    for at in (0..whole).step_by(LANES) {
        // SAFETY: 16 places inside both ranges.
        unsafe {
            let e = exp_negative(s, s.load(&*x.add(at).cast()) - max);
            sum = sum + e;
            s.store_uninit(e, &mut *y.add(at).cast());
        }
    }
    if whole < n {
        let bits = first_lanes_bits(n - whole);
        // SAFETY: the rest of both ranges.
        unsafe {
            let e = exp_negative(s, s.load_masked(x.add(whole), bits) - max);
            let e = s.mask_from_bits(u32::from(bits)).select_or_zero(e);
            sum = sum + e;
            s.store_masked(e, y.add(whole), bits);
        }
    }
    sum
}

/// Multiplies `row` by `by`.
#[inline(always)]
fn times<S: Simd>(s: S, row: &mut [f32], by: f32) {
    let (vectors, rest) = row.as_chunks_mut();
    let factor = s.splat(by);
    for v in vectors {
        s.store(s.load(v) * factor, v);
    }
    rest.iter_mut().for_each(
        #[inline(always)]
        |v| *v *= by,
    );
}

/// Computes the softmax of every row of `x` `[rows, n]` into new memory.
pub fn softmax(n: usize, x: &[f32]) -> Vec<f32> {
    let chunk = CHUNK.div_ceil(n.max(1)) * n.max(1);
    let mut buffer = UninitBuffer::new(x.len());
    buffer.par_chunks_mut(chunk).zip(x.par_chunks(chunk)).for_each(|(y, x)| {
        SimdLevel::best().run(Softmax { n, x, y });
    });
    // SAFETY: the loop above wrote every block.
    unsafe { buffer.assume_init() }
}

struct Softmax<'a> {
    n: usize,
    x: &'a [f32],
    y: &'a mut UninitSlice<f32>,
}

impl Kernel for Softmax<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { n, x, y } = self;
        assert_eq!(x.len(), y.len(), "softmax: lengths");
        // Each pass covers several rows, which stay in the first-level cache: the steps of
        // one row depend on one another.
        let few = (SUM / n).clamp(1, LANES) * n;
        for (x, y) in x.chunks(few).zip(y.chunks_mut(few)) {
            let mut tops = [s.splat(0.0); LANES];
            for (x, top) in x.chunks_exact(n).zip(&mut tops) {
                *top = largest(s, x);
            }
            let mut kept = [0.0; LANES];
            s.store(across(s, tops), &mut kept);
            let rows = x.chunks_exact(n).zip(y.chunks_exact_mut(n));
            if n <= SUM {
                let mut sums = [s.splat(1.0); LANES];
                for ((x, y), (sum, max)) in rows.zip(sums.iter_mut().zip(kept)) {
                    let max = s.splat(max);
                    // SAFETY: n numbers and n places in disjoint slices.
                    *sum = unsafe { exp_part(s, x.as_ptr(), y.as_mut_ptr(), n, max) };
                }
                kept = s.sums(sums);
            } else {
                for ((x, y), kept) in rows.zip(&mut kept) {
                    // SAFETY: as above.
                    *kept = unsafe { exps(s, x.as_ptr(), y.as_mut_ptr(), n, *kept) };
                }
            }
            let mut inverses = [0.0; LANES];
            s.store(s.splat(1.0) / s.load(&kept), &mut inverses);
            for (y, inverse) in y.chunks_exact_mut(n).zip(inverses) {
                // SAFETY: the loops above wrote it.
                times(s, unsafe { &mut *(y as *mut UninitSlice<f32> as *mut [f32]) }, inverse);
            }
        }
    }
}

/// Computes dx = y·(dy − Σ y·dy) row by row; y is the softmax.
pub fn backward(n: usize, y: &[f32], dy: &[f32], dx: &mut [f32]) {
    let chunk = CHUNK.div_ceil(n.max(1)) * n.max(1);
    let rows = y.par_chunks(chunk).zip(dy.par_chunks(chunk));
    rows.zip(dx.par_chunks_mut(chunk)).for_each(|((y, dy), dx)| {
        vectorize(
            #[inline(always)]
            || {
                let pairs = y.chunks_exact(n).zip(dy.chunks_exact(n));
                for ((y, dy), dx) in pairs.zip(dx.chunks_exact_mut(n)) {
                    let mean = super::sums::dot(y, dy);
                    for ((dx, y), dy) in dx.iter_mut().zip(y).zip(dy) {
                        *dx = y * (dy - mean);
                    }
                }
            },
        );
    });
}
