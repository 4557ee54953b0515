//! Losses as plain functions of slices: a value, and its gradient written by hand.
//! [`with_gradient`] hangs them into candle's graph.
//!
//! No graph of small tensor operations stands between a prediction and its loss, so a
//! loss costs about one pass over the prediction.

use crate::metrics::{SSIM_C1, SSIM_C2, SSIM_COVARIANCE, SSIM_WINDOW, window};
use crate::ops::dssim;
use crate::ops::precomputed_gradient::precomputed_gradient;
use candle_core::{Result, Tensor};
use rayon::prelude::*;

/// A loss and its gradient by one of its arguments.
#[derive(Clone, Debug, PartialEq)]
pub struct Scored {
    /// The loss.
    pub value: f64,
    /// Its derivative by each element.
    pub gradient: Vec<f32>,
}

impl Scored {
    /// 0, without an influence, on `n` elements.
    pub fn zero(n: usize) -> Self {
        Self { value: 0.0, gradient: vec![0.0; n] }
    }

    /// This, times `factor`.
    #[must_use]
    pub fn scaled(mut self, factor: f64) -> Self {
        self.value *= factor;
        self.gradient.par_iter_mut().for_each(|g| *g *= factor as f32);
        self
    }

    /// Adds `factor` times `other`, of the same argument.
    pub fn add(&mut self, other: &Self, factor: f64) {
        self.value += factor * other.value;
        let pairs = self.gradient.par_iter_mut().zip(&other.gradient);
        pairs.for_each(|(a, b)| *a += factor as f32 * b);
    }
}

/// The scalar `scored.value` whose derivative by `x` is `scored.gradient`.
///
/// # Errors
/// A gradient of another length than `x`.
pub fn with_gradient(x: &Tensor, scored: Scored) -> Result<Tensor> {
    precomputed_gradient(x, scored.value, scored.gradient)
}

/// Mean squared difference of `x` and `target`.
pub fn mse(x: &[f32], target: &[f32]) -> Scored {
    let n = x.len().max(1) as f64;
    let sums: Vec<f64> = x
        .par_chunks(CHUNK)
        .zip(target.par_chunks(CHUNK))
        .map(|(x, t)| x.iter().zip(t).map(|(x, t)| f64::from(x - t).powi(2)).sum())
        .collect();
    let factor = (2.0 / n) as f32;
    let gradient = x.par_iter().zip(target).map(|(x, t)| factor * (x - t)).collect();
    Scored { value: sums.iter().sum::<f64>() / n, gradient }
}

/// Elements whose terms are summed together: the same sums for any number of threads.
const CHUNK: usize = 4096;

/// Structural dissimilarity (1 − SSIM)/2 of planes `[C, height, width]` in [0, 1], by
/// `x`. SSIM is that of [`crate::metrics::ssim`]: 11×11 Gaussian windows of σ = 1.5
/// that lie inside the picture, sample covariance.
pub fn dssim(x: &[f32], target: &[f32], width: usize, height: usize) -> Scored {
    if width < SSIM_WINDOW || height < SSIM_WINDOW {
        return Scored::zero(x.len());
    }
    let plane = width * height;
    let channels = (x.len() / plane).max(1);
    let windows = (width - SSIM_WINDOW + 1) * (height - SSIM_WINDOW + 1) * channels;
    let shape = dssim::Window {
        taps: window().map(|t| t as f32),
        c: [SSIM_C1 as f32, SSIM_C2 as f32],
        covariance: SSIM_COVARIANCE as f32,
    };
    let factor = (-0.5 / windows as f64) as f32;
    let mut gradient = vec![0.0; x.len()];
    let sums: Vec<f64> = gradient
        .par_chunks_mut(plane)
        .zip(x.par_chunks(plane).zip(target.par_chunks(plane)))
        .map(|(g, (x, t))| dssim::plane(&shape, [x, t], width, factor, g))
        .collect();
    Scored { value: 0.5 * (1.0 - sums.iter().sum::<f64>() / windows as f64), gradient }
}

/// Cross-entropy of logits `[B, D, n]` to the two candidates around `target` `[B, n]`
/// (a candidate index, shared between them by its fraction), mean over the pixels whose
/// target lies in [0, D − 1]; NaN is unknown. By the logits.
pub fn two_hot_cross_entropy(logits: &[f32], target: &[f32], [d, n]: [usize; 2]) -> Scored {
    let mut gradient = vec![0.0; logits.len()];
    let top = d.saturating_sub(1) as f32;
    let count = target.iter().filter(|t| (0.0..=top).contains(*t)).count().max(1) as f32;
    let sums: Vec<f64> = gradient
        .par_chunks_mut((d * n).max(1))
        .zip(logits.par_chunks((d * n).max(1)).zip(target.par_chunks(n.max(1))))
        .map(|(g, (logits, target))| cross_entropy_item(logits, target, count, g))
        .collect();
    Scored { value: sums.iter().sum::<f64>() / f64::from(count), gradient }
}

/// One item: its sum, and in `g` the derivatives over `count`.
fn cross_entropy_item(logits: &[f32], target: &[f32], count: f32, g: &mut [f32]) -> f64 {
    let n = target.len();
    let mut largest = vec![f32::NEG_INFINITY; n];
    for row in logits.chunks(n) {
        largest.iter_mut().zip(row).for_each(|(m, v)| *m = m.max(*v));
    }
    let mut total = vec![0f32; n];
    for (g, row) in g.chunks_mut(n).zip(logits.chunks(n)) {
        for (p, (g, v)) in g.iter_mut().zip(row).enumerate() {
            *g = (v - largest[p]).exp();
            total[p] += *g;
        }
    }
    let top = (logits.len() / n) as f32 - 1.0;
    let known: Vec<f32> =
        target.iter().map(|t| if (0.0..=top).contains(t) { 1.0 / count } else { 0.0 }).collect();
    let mut sum = 0.0;
    for (k, (g, row)) in g.chunks_mut(n).zip(logits.chunks(n)).enumerate() {
        for (p, (g, v)) in g.iter_mut().zip(row).enumerate() {
            // Two neighbours of the target share it by distance; NaN shares nothing.
            let wanted = (1.0 - (k as f32 - target[p]).abs()).max(0.0);
            if wanted > 0.0 && known[p] > 0.0 {
                sum += f64::from(wanted * (total[p].ln() - (v - largest[p])));
            }
            *g = known[p] * (*g / total[p] - wanted);
        }
    }
    sum
}

/// Smooth L1 (half the square below 1, the size less ½ above) of `x` to `target`, mean
/// over the pixels with a known target; NaN is unknown. By `x`.
pub fn smooth_l1(x: &[f32], target: &[f32]) -> Scored {
    let count = target.iter().filter(|t| t.is_finite()).count().max(1) as f64;
    let difference = |(x, t): (&f32, &f32)| if t.is_finite() { x - t } else { 0.0 };
    let gradient = x
        .par_iter()
        .zip(target)
        .map(|pair| (f64::from(difference(pair).clamp(-1.0, 1.0)) / count) as f32)
        .collect();
    let term = |pair: (&f32, &f32)| {
        let e = f64::from(difference(pair).abs());
        if e < 1.0 { 0.5 * e * e } else { e - 0.5 }
    };
    let sums: Vec<f64> = x
        .par_chunks(CHUNK)
        .zip(target.par_chunks(CHUNK))
        .map(|(x, t)| x.iter().zip(t).map(term).sum())
        .collect();
    Scored { value: sums.iter().sum::<f64>() / count, gradient }
}

/// Error, in candidates, at which the wanted confidence is 1/e.
const CONFIDENCE_SCALE: f32 = 1.5;
/// Least distance of a confidence from 0 and 1 under the logarithm and in the slope.
const CONFIDENCE_EDGE: f32 = 1e-6;

/// Binary cross-entropy of `confidence` in (0, 1) to exp(−|index − target|/1.5
/// candidates), mean over the pixels with a known target. By the confidence: the error
/// itself is taken as it is.
pub fn confidence(confidence: &[f32], index: &[f32], target: &[f32]) -> Scored {
    let count = target.iter().filter(|t| t.is_finite()).count().max(1) as f64;
    let term = |((p, x), t): ((&f32, &f32), &f32)| -> (f64, f32) {
        if !t.is_finite() {
            return (0.0, 0.0);
        }
        let wanted = (-(x - t).abs() / CONFIDENCE_SCALE).exp();
        let p = p.clamp(CONFIDENCE_EDGE, 1.0 - CONFIDENCE_EDGE);
        let value = -(wanted * p.ln() + (1.0 - wanted) * (1.0 - p).ln());
        (f64::from(value), ((f64::from(p - wanted) / f64::from(p * (1.0 - p))) / count) as f32)
    };
    let mut gradient = vec![0.0; confidence.len()];
    let sums: Vec<f64> = gradient
        .par_chunks_mut(CHUNK)
        .zip(
            confidence.par_chunks(CHUNK).zip(index.par_chunks(CHUNK)).zip(target.par_chunks(CHUNK)),
        )
        .map(|(g, ((p, x), t))| {
            let mut sum = 0.0;
            for (g, item) in g.iter_mut().zip(p.iter().zip(x).zip(t)) {
                let (value, slope) = term(item);
                sum += value;
                *g = slope;
            }
            sum
        })
        .collect();
    Scored { value: sums.iter().sum::<f64>() / count, gradient }
}

/// Candidate index of inverse depths (1 / camera z), NaN where there is no surface or
/// it lies outside near and far by more than half a candidate.
pub fn candidate_index(inverse: &[f32], (near, far): (f32, f32), candidates: usize) -> Vec<f32> {
    let (lo, hi) = (1.0 / far, 1.0 / near);
    let top = candidates.saturating_sub(1) as f32;
    let scale = top / (hi - lo);
    let index = |&i: &f32| {
        let at = (i - lo) * scale;
        if i > 0.0 && at > -0.5 && at < top + 0.5 { at.clamp(0.0, top) } else { f32::NAN }
    };
    inverse.iter().map(index).collect()
}

/// Median of each 4×4 block of `[height, width]`, unknown pixels left out; NaN where
/// fewer than half are known. Sides are multiples of 4.
pub fn block_median(index: &[f32], width: usize) -> Vec<f32> {
    let (w, h) = (width / 4, index.len() / width.max(1) / 4);
    let mut out = Vec::with_capacity(w * h);
    for (y, x) in (0..h).flat_map(|y| (0..w).map(move |x| (y, x))) {
        let rows = (0..4).flat_map(|r| &index[(4 * y + r) * width + 4 * x..][..4]);
        let mut known: Vec<f32> = rows.copied().filter(|v| v.is_finite()).collect();
        known.sort_by(f32::total_cmp);
        // The lower of the two middle values: one that occurs.
        out.push(if known.len() < 8 { f32::NAN } else { known[(known.len() - 1) / 2] });
    }
    out
}
