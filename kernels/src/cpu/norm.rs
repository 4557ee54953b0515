//! Normalisation of rows to zero mean and unit (biased) variance with a scale and a shift per
//! channel, and its gradient. GroupNorm, InstanceNorm and LayerNorm differ in their rows and
//! channels only. A pointwise function may follow in the same pass.

mod layer;
mod silu;

use super::activation::{Activation, by_kind};
use super::simd::SimdLevel;
use super::simd::vectorize;
use super::sums::{sum_of, sums_of};
use super::uninit::{UninitBuffer, UninitSlice};
use layer::Layer;
use rayon::prelude::*;
use silu::Silu;
use std::mem::MaybeUninit;

/// Layout of rows and channels: element i of row r belongs to channel
/// (r mod `groups`)·(`len` / `run`) + i / `run`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rows {
    /// Elements of a row.
    pub len: usize,
    /// Neighbouring elements that share a channel (pixels; 1 for LayerNorm).
    pub run: usize,
    /// Rows after which the channels repeat (groups; 1 for LayerNorm).
    pub groups: usize,
    /// ε under the square root.
    pub eps: f32,
    /// Function f of the result, if any.
    pub activation: Option<Activation>,
}

impl Rows {
    /// Channels of one row.
    fn per_row(&self) -> usize {
        self.len / self.run
    }

    /// First channel of row `r`.
    fn channel(&self, r: usize) -> usize {
        (r % self.groups) * self.per_row()
    }

    /// Rows per task: about 16 thousand elements.
    fn batch(&self) -> usize {
        16_384usize.div_ceil(self.len.max(1))
    }

    /// Mean and 1/σ of a row.
    #[inline(always)]
    fn moments(&self, x: &[f32]) -> (f32, f32) {
        let n = self.len as f64;
        let mean = (sum_of(x, |v| v) / n) as f32;
        let variance = sum_of(x, |v| (v - mean) * (v - mean)) / n;
        (mean, (1.0 / (variance + f64::from(self.eps)).sqrt()) as f32)
    }
}

/// Computes f(w·(x − mean)/σ + b) into new memory; `w` and `b` are `[channels]`, or empty.
pub fn forward(rows: &Rows, x: &[f32], w: &[f32], b: &[f32]) -> Vec<f32> {
    let mut buffer = UninitBuffer::new(x.len());
    forward_to(rows, x, w, b, buffer.as_mut_slice());
    // SAFETY: every element of every row was written.
    unsafe { buffer.assume_init() }
}

/// Computes [`forward`] into `y` and writes all of it.
///
/// # Panics
/// If the sizes do not fit.
pub(super) fn forward_to(rows: &Rows, x: &[f32], w: &[f32], b: &[f32], y: &mut UninitSlice<f32>) {
    assert!(x.len() == y.len() && x.len().is_multiple_of(rows.len), "normalisation: rows");
    assert!(rows.len.is_multiple_of(rows.run) && w.len() == b.len(), "normalisation: channels");
    assert!(w.is_empty() || w.len() == rows.groups * rows.per_row(), "normalisation: channels");
    let batch = rows.batch();
    let chunk = batch * rows.len;
    let layer = rows.run == 1 && rows.groups == 1 && rows.activation.is_none();
    x.par_chunks(chunk).zip(y.par_chunks_mut(chunk)).enumerate().for_each(|(at, (x, y))| {
        if layer {
            return SimdLevel::best().run(Layer {
                n: rows.len,
                eps: rows.eps,
                x,
                y,
                affine: [w, b],
            });
        }
        if rows.activation == Some(Activation::Silu) {
            let (first, affine) = (at * batch, [w, b]);
            return SimdLevel::best().run(Silu { rows, first, x, y, affine });
        }
        vectorize(
            #[inline(always)]
            || {
                let pairs = x.chunks_exact(rows.len).zip(y.chunks_exact_mut(rows.len));
                for (r, (x, y)) in pairs.enumerate() {
                    let moments = rows.moments(x);
                    let c = rows.channel(at * batch + r);
                    let affine = w.get(c..).zip(b.get(c..)).filter(|(w, _)| !w.is_empty());
                    macro_rules! run {
                        ($value:expr, $slope:expr) => {
                            affine_row(rows, x, y, moments, affine, $value)
                        };
                    }
                    match rows.activation {
                        Some(kind) => by_kind!(kind, run),
                        None => run!(
                            #[inline(always)]
                            |v| v,
                            ()
                        ),
                    }
                }
            },
        );
    });
}

#[inline(always)]
fn affine_row(
    rows: &Rows,
    x: &[f32],
    y: &mut UninitSlice<f32>,
    (mean, inverse): (f32, f32),
    affine: Option<(&[f32], &[f32])>,
    f: impl Fn(f32) -> f32,
) {
    match affine {
        Some((w, b)) => {
            let runs = x.chunks_exact(rows.run).zip(y.chunks_exact_mut(rows.run));
            for ((x, y), (w, b)) in runs.zip(w.iter().zip(b)) {
                for (y, x) in y.iter_mut().zip(x) {
                    *y = MaybeUninit::new(f((x - mean) * inverse * w + b));
                }
            }
        }
        None => {
            for (y, x) in y.iter_mut().zip(x) {
                *y = MaybeUninit::new(f((x - mean) * inverse));
            }
        }
    }
}

/// Inputs of [`backward`].
pub struct Saved<'a> {
    /// Input of [`forward`].
    pub x: &'a [f32],
    /// Scales, or empty.
    pub w: &'a [f32],
    /// Shifts, or empty.
    pub b: &'a [f32],
    /// ∂L/∂y.
    pub dy: &'a [f32],
}

/// Computes (dx, dw, db). With g = dy·f′·w and x̂ the normalised x:
/// dx = (g − mean(g) − x̂·mean(g·x̂))/σ, dw = Σ dy·f′·x̂, db = Σ dy·f′.
pub fn backward(rows: &Rows, s: &Saved<'_>) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (per_row, batch) = (rows.per_row(), rows.batch());
    let chunk = batch * rows.len;
    let count = s.x.len() / rows.len.max(1);
    let mut dx = vec![0f32; s.x.len()];
    // Per row and channel: Σ dy·f′·x̂ and Σ dy·f′. A task adds its rows of a LayerNorm.
    let shared = rows.groups == 1 && rows.run == 1;
    let kept = if shared { count.div_ceil(batch) } else { count };
    let mut sums = vec![[0f64; 2]; kept * per_row];
    let per_task = if shared { per_row } else { batch * per_row };
    s.x.par_chunks(chunk)
        .zip(s.dy.par_chunks(chunk))
        .zip(dx.par_chunks_mut(chunk))
        .zip(sums.par_chunks_mut(per_task))
        .enumerate()
        .for_each(|(at, (((x, dy), dx), sums))| {
            vectorize(
                #[inline(always)]
                || {
                    let lines = x.chunks_exact(rows.len).zip(dy.chunks_exact(rows.len));
                    for (r, ((x, dy), dx)) in lines.zip(dx.chunks_exact_mut(rows.len)).enumerate() {
                        let c = rows.channel(at * batch + r);
                        let own = if shared { 0 } else { r * per_row };
                        let sums = &mut sums[own..own + per_row];
                        let (w, b) = (s.w.get(c..).unwrap_or(&[]), s.b.get(c..).unwrap_or(&[]));
                        macro_rules! run {
                            ($value:expr, $slope:expr) => {
                                backward_row(rows, (x, dy, dx), (w, b), sums, $slope)
                            };
                        }
                        match rows.activation {
                            Some(kind) => by_kind!(kind, run),
                            None => run!(
                                (),
                                #[inline(always)]
                                |_| 1.0
                            ),
                        }
                    }
                },
            );
        });
    let mut totals = vec![[0f64; 2]; s.w.len()];
    if !s.w.is_empty() {
        for (r, row) in sums.chunks_exact(per_row).enumerate() {
            let c = rows.channel(r);
            for (total, s) in totals[c..].iter_mut().zip(row) {
                total[0] += s[0];
                total[1] += s[1];
            }
        }
    }
    let lane = |k: usize| totals.iter().map(|s| s[k] as f32).collect();
    (dx, lane(0), lane(1))
}

/// Computes `dx` of one row and adds its channels' sums to `sums`. `w` and `b` begin at the
/// row's first channel.
#[inline(always)]
fn backward_row(
    rows: &Rows,
    (x, dy, dx): (&[f32], &[f32], &mut [f32]),
    (w, b): (&[f32], &[f32]),
    sums: &mut [[f64; 2]],
    slope: impl Fn(f32) -> f32,
) {
    let (n, (mean, inverse)) = (rows.len as f64, rows.moments(x));
    let (mut mean_g, mut mean_gx) = (0f64, 0f64);
    if let (1, Some(w), Some(b)) = (rows.run, w.get(..rows.len), b.get(..rows.len)) {
        // One element per channel: `dx` holds dy·f′·w until the means are known.
        let (x, dy, sums) = (&x[..rows.len], &dy[..rows.len], &mut sums[..rows.len]);
        let dx = &mut dx[..rows.len];
        for i in 0..rows.len {
            let unit = (x[i] - mean) * inverse;
            let g = dy[i] * slope(unit * w[i] + b[i]);
            sums[i][0] += f64::from(g * unit);
            sums[i][1] += f64::from(g);
            dx[i] = g * w[i];
        }
        let own = sums_of(
            dx,
            x,
            #[inline(always)]
            |g, x| [g, g * ((x - mean) * inverse)],
        );
        (mean_g, mean_gx) = (own[0] / n, own[1] / n);
    } else {
        let runs = x.chunks_exact(rows.run).zip(dy.chunks_exact(rows.run));
        for (i, ((x, dy), dx)) in runs.zip(dx.chunks_exact_mut(rows.run)).enumerate() {
            let (w, b) = (w.get(i).copied().unwrap_or(1.0), b.get(i).copied().unwrap_or(0.0));
            for ((x, dy), dx) in x.iter().zip(dy).zip(dx.iter_mut()) {
                *dx = dy * slope((x - mean) * inverse * w + b);
            }
            let own = sums_of(
                dx,
                x,
                #[inline(always)]
                |g, x| [g * ((x - mean) * inverse), g],
            );
            sums[i][0] += own[0];
            sums[i][1] += own[1];
            mean_gx += own[0] * f64::from(w) / n;
            mean_g += own[1] * f64::from(w) / n;
            dx.iter_mut().for_each(|g| *g *= w);
        }
    }
    let (mean_g, mean_gx) = (mean_g as f32, mean_gx as f32);
    for (dx, x) in dx.iter_mut().zip(x) {
        *dx = (*dx - mean_g - (x - mean) * inverse * mean_gx) * inverse;
    }
}
