//! How a parent's opacity is shared among its children, and the gradient.
//!
//! In: logits ℓ `[P,K]`; areas `[P,K]`; opacities α `[P]`.   Out: `[P,K]`.
//! With w = softmax(ℓ):
//!
//! | rule | α_k | areas |
//! |---|---|---|
//! | linear | α·softmax(ℓ_k − ln(A_k + ε)): Σ α_k = α (supp. A.3) | px² |
//! | optical depth | 1 − e^{−τ_k}, τ_k = τ·w_k / B_k, τ = −ln(1 − α): Σ B_k τ_k = τ | B = Ã_k/Ã |
//! | transmittance | 1 − (1 − α)^{w_k}: Π (1 − α_k) = 1 − α | unused |
//! | area | min(0.99, α·w_k / B_k) | B = A_k/A |
//! | none | α | unused |
//!
//! Ã is the footprint with the rasterizer's low-pass, A without. α is taken as at
//! most 0.9999 wherever a logarithm is. Twin: ops/redistribute.rs.

use super::real::Real;
use crate::abi::{AREA_EPS, AREA_RULE_OPACITY_MAX, OPACITY_CEILING};
use rayon::prelude::*;

/// How the parent's opacity is shared (module doc).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rule {
    /// Sums to the parent's.
    Linear,
    /// Conserves footprint-weighted optical depth.
    OpticalDepth,
    /// Conserves transmittance through all children.
    Transmittance,
    /// Conserves integrated opacity.
    Area,
    /// Every child has the parent's.
    None,
}

impl Rule {
    /// Whether areas are in units of the parent's own rather than px².
    pub fn areas_are_relative(self) -> bool {
        matches!(self, Rule::OpticalDepth | Rule::Area)
    }
}

/// Least relative area that is divided by.
const RELATIVE_AREA_MIN: f64 = 1e-12;
/// Parents per rayon task.
const BLOCK: usize = 256;

/// softmax of `logits` into `out`, by log-sum-exp.
fn softmax<T: Real>(logits: impl Iterator<Item = T> + Clone, out: &mut [T]) {
    let top = logits.clone().fold(T::of(f64::NEG_INFINITY), T::max);
    let mut sum = T::default();
    for (o, l) in out.iter_mut().zip(logits) {
        *o = (l - top).exp();
        sum += *o;
    }
    for o in out {
        *o = *o / sum;
    }
}

fn optical_depth<T: Real>(alpha: T) -> T {
    -(-alpha.min(T::of(OPACITY_CEILING))).ln_1p()
}

/// α_k of one parent's K children.
pub fn row<T: Real>(rule: Rule, logits: &[T], areas: &[T], alpha: T, out: &mut [T]) {
    let least = T::of(RELATIVE_AREA_MIN);
    match rule {
        Rule::None => return out.fill(alpha),
        Rule::Linear => {
            let eps = T::of(AREA_EPS);
            softmax(logits.iter().zip(areas).map(|(&l, &a)| l - (a + eps).ln()), out);
        }
        _ => softmax(logits.iter().copied(), out),
    }
    match rule {
        Rule::Linear | Rule::None => out.iter_mut().for_each(|o| *o *= alpha),
        Rule::OpticalDepth => {
            let tau = optical_depth(alpha);
            for (o, &b) in out.iter_mut().zip(areas) {
                *o = -(-(tau * *o / b.max(least))).exp_m1();
            }
        }
        Rule::Transmittance => {
            let tau = optical_depth(alpha);
            out.iter_mut().for_each(|o| *o = -(-(tau * *o)).exp_m1());
        }
        Rule::Area => {
            for (o, &b) in out.iter_mut().zip(areas) {
                *o = (alpha * *o / b.max(least)).min(T::of(AREA_RULE_OPACITY_MAX));
            }
        }
    }
}

/// One parent's arguments of [`row`].
#[derive(Clone, Copy)]
pub struct RowArgs<'a, T> {
    /// ℓ, `[K]`.
    pub logits: &'a [T],
    /// `[K]`.
    pub areas: &'a [T],
    /// α.
    pub alpha: T,
}

/// Gradients of [`row`] with respect to logits and areas (written, `[K]`) and to
/// alpha (returned), for gradients `grad` `[K]` of its result.
pub fn row_backward<T: Real>(
    rule: Rule,
    args: RowArgs<T>,
    grad: &[T],
    d_logits: &mut [T],
    d_areas: &mut [T],
) -> T {
    let RowArgs { logits, areas, alpha } = args;
    let zero = T::default();
    if rule == Rule::None {
        d_logits.fill(zero);
        d_areas.fill(zero);
        return grad.iter().copied().sum();
    }
    if rule == Rule::Linear {
        let eps = T::of(AREA_EPS);
        softmax(logits.iter().zip(areas).map(|(&l, &a)| l - (a + eps).ln()), d_logits);
        let mean: T = d_logits.iter().zip(grad).map(|(&p, &g)| p * g).sum();
        for k in 0..grad.len() {
            d_logits[k] = alpha * d_logits[k] * (grad[k] - mean);
            d_areas[k] = -d_logits[k] / (areas[k] + eps);
        }
        return mean;
    }
    // α_k = F(x_k), x_k = s·w_k / B_k with s = τ(α) or α.
    softmax(logits.iter().copied(), d_logits);
    let ceiling = T::of(OPACITY_CEILING);
    let depth = rule != Rule::Area;
    let (s, ds) = match depth {
        true if alpha < ceiling => (optical_depth(alpha), T::of(1.0) / (T::of(1.0) - alpha)),
        true => (optical_depth(alpha), zero),
        false => (alpha, T::of(1.0)),
    };
    let (mut d_s, mut mean) = (zero, zero);
    let least = T::of(RELATIVE_AREA_MIN);
    for k in 0..grad.len() {
        let w = d_logits[k];
        let b = if rule == Rule::Transmittance { T::of(1.0) } else { areas[k].max(least) };
        let x = s * w / b;
        let dx = match depth {
            true => grad[k] * (-x).exp(),
            false if x < T::of(AREA_RULE_OPACITY_MAX) => grad[k],
            false => zero,
        };
        d_s += dx * w / b;
        mean += dx * x;
        let free = rule != Rule::Transmittance && areas[k] > least;
        d_areas[k] = if free { -dx * x / b } else { zero };
        // ∂x_k/∂ℓ_j = x_k(δ_kj − w_j): the first half now, the mean below.
        d_logits[k] = dx * x;
    }
    let mut w = [zero; 64];
    let mut heap;
    let w = if grad.len() <= w.len() {
        &mut w[..grad.len()]
    } else {
        heap = vec![zero; grad.len()];
        &mut heap[..]
    };
    softmax(logits.iter().copied(), w);
    for (d, &w) in d_logits.iter_mut().zip(w.iter()) {
        *d = *d - w * mean;
    }
    d_s * ds
}

/// [`row`] for P parents of K = `k` children.
pub fn forward<T: Real>(
    rule: Rule,
    k: usize,
    logits: &[T],
    areas: &[T],
    alphas: &[T],
    out: &mut [T],
) {
    out.par_chunks_mut(k * BLOCK).enumerate().for_each(|(block, out)| {
        for (i, out) in out.chunks_exact_mut(k).enumerate() {
            let p = block * BLOCK + i;
            let span = p * k..(p + 1) * k;
            row(rule, &logits[span.clone()], &areas[span], alphas[p], out);
        }
    });
}

/// Gradients of [`forward`].
pub struct Gradients<T> {
    /// `[P, K]`.
    pub logits: Vec<T>,
    /// `[P, K]`.
    pub areas: Vec<T>,
    /// `[P]`.
    pub alphas: Vec<T>,
}

/// [`row_backward`] for P parents of K = `k` children.
pub fn backward<T: Real>(
    rule: Rule,
    k: usize,
    logits: &[T],
    areas: &[T],
    alphas: &[T],
    grad: &[T],
) -> Gradients<T> {
    let zero = T::default();
    let mut g = Gradients {
        logits: vec![zero; logits.len()],
        areas: vec![zero; areas.len()],
        alphas: vec![zero; alphas.len()],
    };
    let blocks = g
        .logits
        .par_chunks_mut(k * BLOCK)
        .zip(g.areas.par_chunks_mut(k * BLOCK))
        .zip(g.alphas.par_chunks_mut(BLOCK));
    blocks.enumerate().for_each(|(block, ((d_logits, d_areas), d_alphas))| {
        for (i, d_alpha) in d_alphas.iter_mut().enumerate() {
            let p = block * BLOCK + i;
            let (span, local) = (p * k..(p + 1) * k, i * k..(i + 1) * k);
            let args = RowArgs {
                logits: &logits[span.clone()],
                areas: &areas[span.clone()],
                alpha: alphas[p],
            };
            let (dl, da) = (&mut d_logits[local.clone()], &mut d_areas[local]);
            *d_alpha = row_backward(rule, args, &grad[span], dl, da);
        }
    });
    g
}
