//! Normalisation of rows to zero mean and unit (biased) variance with a scale and a
//! shift per channel, and its gradient: GroupNorm, InstanceNorm and LayerNorm are
//! this with different readings of "row" and "channel".

use super::math::{sum_of, vectorised};
use rayon::prelude::*;

/// How rows lie and which channel an element has: element i of row r belongs to
/// channel (r mod `groups`)·(`len` / `run`) + i / `run`.
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

/// y = w·(x − mean)/σ + b; `w` and `b` are `[channels]`, or empty for none.
pub fn forward(rows: &Rows, x: &[f32], w: &[f32], b: &[f32], y: &mut [f32]) {
    let batch = rows.batch();
    let chunk = batch * rows.len;
    x.par_chunks(chunk).zip(y.par_chunks_mut(chunk)).enumerate().for_each(|(at, (x, y))| {
        vectorised(
            #[inline(always)]
            || {
                let pairs = x.chunks_exact(rows.len).zip(y.chunks_exact_mut(rows.len));
                for (r, (x, y)) in pairs.enumerate() {
                    let (mean, inverse) = rows.moments(x);
                    let c = rows.channel(at * batch + r);
                    affine_row(rows, x, y, (mean, inverse), w.get(c..).zip(b.get(c..)));
                }
            },
        );
    });
}

#[inline(always)]
fn affine_row(
    rows: &Rows,
    x: &[f32],
    y: &mut [f32],
    (mean, inverse): (f32, f32),
    affine: Option<(&[f32], &[f32])>,
) {
    match affine {
        Some((w, b)) if !w.is_empty() && rows.run == 1 => {
            for (((y, x), w), b) in y.iter_mut().zip(x).zip(w).zip(b) {
                *y = (x - mean) * inverse * w + b;
            }
        }
        Some((w, b)) if !w.is_empty() => {
            let runs = x.chunks_exact(rows.run).zip(y.chunks_exact_mut(rows.run));
            for ((x, y), (w, b)) in runs.zip(w.iter().zip(b)) {
                for (y, x) in y.iter_mut().zip(x) {
                    *y = (x - mean) * inverse * w + b;
                }
            }
        }
        _ => {
            for (y, x) in y.iter_mut().zip(x) {
                *y = (x - mean) * inverse;
            }
        }
    }
}

/// (dx, dw, db) from dy. With g = dy·w and x̂ the normalised x:
/// dx = (g − mean(g) − x̂·mean(g·x̂))/σ, dw = Σ dy·x̂, db = Σ dy.
pub fn backward(rows: &Rows, x: &[f32], w: &[f32], dy: &[f32]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (per_row, n) = (rows.per_row(), rows.len as f64);
    let mut dx = vec![0f32; x.len()];
    // Per row and channel: Σ dy·x̂ and Σ dy.
    let sums: Vec<Vec<[f64; 2]>> = x
        .par_chunks_exact(rows.len)
        .zip(dy.par_chunks_exact(rows.len))
        .zip(dx.par_chunks_exact_mut(rows.len))
        .enumerate()
        .map(|(r, ((x, dy), dx))| {
            let (mean, inverse) = rows.moments(x);
            let weight = |i: usize| w.get(rows.channel(r) + i).copied().unwrap_or(1.0);
            let mut sums = vec![[0f64; 2]; per_row];
            let (mut mean_g, mut mean_gx) = (0f64, 0f64);
            for (i, (x, dy)) in x.chunks_exact(rows.run).zip(dy.chunks_exact(rows.run)).enumerate()
            {
                for (x, dy) in x.iter().zip(dy) {
                    sums[i][0] += f64::from(dy * (x - mean) * inverse);
                    sums[i][1] += f64::from(*dy);
                }
                mean_g += sums[i][1] * f64::from(weight(i)) / n;
                mean_gx += sums[i][0] * f64::from(weight(i)) / n;
            }
            let (mean_g, mean_gx) = (mean_g as f32, mean_gx as f32);
            let triples = dx.chunks_exact_mut(rows.run).zip(x.chunks_exact(rows.run));
            for (i, ((dx, x), dy)) in triples.zip(dy.chunks_exact(rows.run)).enumerate() {
                let w = weight(i);
                for ((dx, x), dy) in dx.iter_mut().zip(x).zip(dy) {
                    *dx = (dy * w - mean_g - (x - mean) * inverse * mean_gx) * inverse;
                }
            }
            sums
        })
        .collect();
    let mut totals = vec![[0f64; 2]; w.len()];
    if !w.is_empty() {
        for (r, row) in sums.iter().enumerate() {
            for (i, s) in row.iter().enumerate() {
                totals[rows.channel(r) + i][0] += s[0];
                totals[rows.channel(r) + i][1] += s[1];
            }
        }
    }
    let lane = |k: usize| totals.iter().map(|s| s[k] as f32).collect();
    (dx, lane(0), lane(1))
}
