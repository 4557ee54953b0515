//! LayerNorm. Each pass covers several rows, because the steps of one row depend on one
//! another.

use crate::cpu::simd::{Kernel, LANES, Mask, Simd};
use crate::cpu::uninit::UninitSlice;
use std::array::from_fn;
use std::mem::MaybeUninit;

/// Rows per pass.
const TOGETHER: usize = 8;
/// Numbers that f32 lanes add before an f64 takes their sum.
const BLOCK: usize = 512;

/// Computes w·(x − mean)/σ + b of rows of `n` numbers; `affine` holds w and b, both of `n`
/// numbers or both empty.
pub(super) struct Layer<'a> {
    pub n: usize,
    pub eps: f32,
    pub x: &'a [f32],
    pub y: &'a mut UninitSlice<f32>,
    pub affine: [&'a [f32]; 2],
}

impl Kernel for Layer<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { n, eps, x, y, affine: [w, b] } = self;
        assert!(x.len() == y.len() && w.len() == b.len() && (w.len() == n || w.is_empty()));
        for (x, y) in x.chunks(TOGETHER * n).zip(y.chunks_mut(TOGETHER * n)) {
            let (mut means, mut inverses) = ([0.0; TOGETHER], [0.0; TOGETHER]);
            for (x, mean) in x.chunks_exact(n).zip(&mut means) {
                let sum = total(
                    s,
                    x,
                    #[inline(always)]
                    |v| v,
                );
                *mean = (sum / n as f64) as f32;
            }
            for ((x, mean), inverse) in x.chunks_exact(n).zip(means).zip(&mut inverses) {
                let mean = s.splat(mean);
                let sum = total(
                    s,
                    x,
                    #[inline(always)]
                    |v| (v - mean) * (v - mean),
                );
                *inverse = (1.0 / (sum / n as f64 + f64::from(eps)).sqrt()) as f32;
            }
            let rows = x.chunks_exact(n).zip(y.chunks_exact_mut(n));
            for ((x, y), (mean, inverse)) in rows.zip(means.into_iter().zip(inverses)) {
                let (mean, inverse) = (s.splat(mean), s.splat(inverse));
                for (at, y) in (0..n).step_by(LANES).zip(y.chunks_mut(LANES)) {
                    let mut v = (part(s, x, at) - mean) * inverse;
                    if !w.is_empty() {
                        v = v * part(s, w, at) + part(s, b, at);
                    }
                    match y.first_chunk_mut() {
                        Some(y) => s.store_uninit(v, y),
                        None => {
                            let mut lanes = [0.0; LANES];
                            s.store(v, &mut lanes);
                            let lanes = lanes.map(MaybeUninit::new);
                            y.iter_mut().zip(lanes).for_each(|(y, v)| *y = v);
                        }
                    }
                }
            }
        }
    }
}

/// Loads sixteen numbers of a row from `at` on, zeros past its end.
#[inline(always)]
fn part<S: Simd>(s: S, row: &[f32], at: usize) -> S::F {
    match row[at..].first_chunk() {
        Some(v) => s.load(v),
        None => s.load(&from_fn(|i| row.get(at + i).copied().unwrap_or(0.0))),
    }
}

/// Σ f(xᵢ).
#[inline(always)]
fn total<S: Simd>(s: S, x: &[f32], f: impl Fn(S::F) -> S::F) -> f64 {
    let mut total = 0.0;
    for x in x.chunks(BLOCK) {
        let mut sum = s.splat(0.0);
        for at in (0..x.len()).step_by(LANES) {
            let inside = (x.len() - at).min(LANES);
            let v = f(part(s, x, at));
            // Lanes past the end do not count: f of 0 need not be 0.
            let v = if inside < LANES {
                s.mask_from_bits((1 << inside) - 1).select_or_zero(v)
            } else {
                v
            };
            sum = sum + v;
        }
        total += f64::from(s.sum(sum));
    }
    total
}
