//! Losses of the network's outputs as functions of slices: a value, and its analytic gradient.
//! Those of pictures are in [`subsplat::finish::loss`].
//!
//! [`with_gradient`] inserts a loss into candle's graph as one scalar. No graph of small tensor
//! operations exists between a prediction and its loss, so that a loss costs about one pass over
//! the prediction.

use candle_core::{Result, Tensor};
use rayon::prelude::*;
pub use subsplat::finish::loss::{Scored, dssim, mse};
use subsplat::network::ops::precomputed_gradient::precomputed_gradient;
use subsplat_kernels::camera::NearFar;

/// Returns a scalar of value `scored.value` whose derivative with respect to `x` is
/// `scored.gradient`.
///
/// # Errors
/// A gradient whose length differs from that of `x`.
pub fn with_gradient(x: &Tensor, scored: Scored) -> Result<Tensor> {
    precomputed_gradient(x, scored.value, scored.gradient)
}

/// Number of elements summed together. The fixed size makes the sums independent of the number of
/// threads.
const CHUNK: usize = 4096;

/// Returns the cross-entropy of logits `[B, D, n]` to the two candidates around `target` `[B, n]`,
/// with its gradient by the logits.
///
/// A target is a candidate index; its fraction distributes the weight between the two candidates.
/// The mean is over pixels with a target in [0, D − 1]; NaN marks an unknown target.
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

/// Returns the sum of one item, and writes the derivatives over `count` to `g`.
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
            // Linear weights of the two candidates around the target; NaN gives 0.
            let expected = (1.0 - (k as f32 - target[p]).abs()).max(0.0);
            if expected > 0.0 && known[p] > 0.0 {
                sum += f64::from(expected * (total[p].ln() - (v - largest[p])));
            }
            *g = known[p] * (*g / total[p] - expected);
        }
    }
    sum
}

/// Returns the smooth L1 distance of `x` to `target` (e²/2 below 1, |e| − ½ above), with its
/// gradient by `x`. The mean is over pixels with a known target; NaN marks an unknown one.
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

/// Error, in candidates, at which the target confidence is 1/e.
const CONFIDENCE_SCALE: f32 = 1.5;
/// Smallest distance of a confidence from 0 and 1 in the logarithm and the derivative.
const CONFIDENCE_MARGIN: f32 = 1e-6;

/// Returns the binary cross-entropy of `confidence` in (0, 1) to exp(−|index − target|/1.5
/// candidates), with its gradient by the confidence. The error counts as constant. The mean is over
/// pixels with a known target.
pub fn confidence(confidence: &[f32], index: &[f32], target: &[f32]) -> Scored {
    let count = target.iter().filter(|t| t.is_finite()).count().max(1) as f64;
    let term = |((p, x), t): ((&f32, &f32), &f32)| -> (f64, f32) {
        if !t.is_finite() {
            return (0.0, 0.0);
        }
        let expected = (-(x - t).abs() / CONFIDENCE_SCALE).exp();
        let p = p.clamp(CONFIDENCE_MARGIN, 1.0 - CONFIDENCE_MARGIN);
        let value = -(expected * p.ln() + (1.0 - expected) * (1.0 - p).ln());
        (f64::from(value), ((f64::from(p - expected) / f64::from(p * (1.0 - p))) / count) as f32)
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

/// Converts inverse depths (1 / camera z) to candidate indices. The result is NaN without a
/// surface, or where the surface lies outside near and far by more than half a candidate.
pub fn candidate_index(inverse: &[f32], range: NearFar, candidates: usize) -> Vec<f32> {
    let (lo, hi) = (1.0 / range.far, 1.0 / range.near);
    let top = candidates.saturating_sub(1) as f32;
    let scale = top / (hi - lo);
    let index = |&i: &f32| {
        let at = (i - lo) * scale;
        if i > 0.0 && at > -0.5 && at < top + 0.5 { at.clamp(0.0, top) } else { f32::NAN }
    };
    inverse.iter().map(index).collect()
}

/// Returns the median of each 4×4 block of `[height, width]` over its known pixels; NaN where fewer
/// than half are known. Both sides are multiples of 4.
pub fn block_median(index: &[f32], width: usize) -> Vec<f32> {
    let w = width / 4;
    let h = index.len() / width.max(1) / 4;
    let mut out = Vec::with_capacity(w * h);
    for (y, x) in (0..h).flat_map(|y| (0..w).map(move |x| (y, x))) {
        let rows = (0..4).flat_map(|r| &index[(4 * y + r) * width + 4 * x..][..4]);
        let mut known: Vec<f32> = rows.copied().filter(|v| v.is_finite()).collect();
        known.sort_by(f32::total_cmp);
        // The lower of the two middle values, which is one of the inputs.
        out.push(if known.len() < 8 { f32::NAN } else { known[(known.len() - 1) / 2] });
    }
    out
}
