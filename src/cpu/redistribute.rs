//! How a parent's opacity is shared among its children, and the gradient.
//!
//! In: logits ℓ `[P,K]`; areas A `[P,K]`, px²; opacities α `[P]`; the parents' own
//! areas `[P]` where the rule asks for them.   Out: `[P,K]`.
//! With w = softmax(ℓ) and B = A_k / own area:
//!
//! | rule | α_k | areas |
//! |---|---|---|
//! | linear | α·softmax(ℓ_k − ln(A_k + ε)): Σ α_k = α (supp. A.3) | px² |
//! | optical depth | 1 − e^{−τ_k}, τ_k = τ·w_k / B_k, τ = −ln(1 − α): Σ B_k τ_k = τ | with the low-pass |
//! | transmittance | 1 − (1 − α)^{w_k}: Π (1 − α_k) = 1 − α | unused |
//! | area | min(0.99, α·w_k / B_k) | without the low-pass |
//! | none | α | unused |
//!
//! α is taken as at most 0.9999 wherever a logarithm is. Parents are the lanes of a
//! vector ([`super::lanes`]), so that a sum over children is a loop. Twin:
//! ops/redistribute.rs.

use super::lanes::{Kernel, LaneReal, Lanes, Machine, WIDTH_MAX};
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
    /// Whether areas count in units of the parent's own.
    pub fn areas_are_relative(self) -> bool {
        matches!(self, Rule::OpticalDepth | Rule::Area)
    }
}

/// Least relative area that is divided by.
const RELATIVE_AREA_MIN: f64 = 1e-12;
/// Parents per rayon task.
const BLOCK: usize = 1024;

/// eˣ⁻ᵐᵃˣ of `x` in place; returns one over their sum.
#[inline(always)]
fn exponentials<V: Lanes>(x: &mut [V]) -> V {
    let mut top = x[0];
    for &v in &x[1..] {
        top = top.max(v);
    }
    let mut sum = top.of(0.0);
    for v in x.iter_mut() {
        *v = (*v - top).exp();
        sum = sum + *v;
    }
    sum.of(1.0) / sum
}

#[inline(always)]
fn optical_depth<V: Lanes>(alpha: V) -> V {
    -(-alpha.min(alpha.of(OPACITY_CEILING))).ln_1p()
}

/// What the rule divides by, where it divides.
#[inline(always)]
fn divisor<V: Lanes>(rule: Rule, area: V, per_own: V) -> V {
    match rule {
        Rule::Transmittance => area.of(1.0),
        _ => (area * per_own).max(area.of(RELATIVE_AREA_MIN)),
    }
}

/// α_k of K children in the lanes of their parents. `own` is read by the relative
/// rules only. K = `areas.len()` ≥ 1; `alphas` comes in with the logits.
#[inline(always)]
pub(super) fn share<V: Lanes>(rule: Rule, areas: &[V], alpha: V, own: V, alphas: &mut [V]) {
    if rule == Rule::None {
        alphas.fill(alpha);
        return;
    }
    if rule == Rule::Linear {
        let eps = alpha.of(AREA_EPS);
        for (l, &a) in alphas.iter_mut().zip(areas) {
            *l = *l - (a + eps).ln();
        }
        let factor = alpha * exponentials(alphas);
        alphas.iter_mut().for_each(|o| *o = *o * factor);
        return;
    }
    let one = alpha.of(1.0);
    let inverse = exponentials(alphas);
    let per_own = if rule.areas_are_relative() { one / own } else { one };
    let whole = if rule == Rule::Area { alpha } else { optical_depth(alpha) };
    let factor = whole * inverse;
    for (o, &a) in alphas.iter_mut().zip(areas) {
        let x = factor * *o / divisor(rule, a, per_own);
        *o = match rule {
            Rule::Area => x.min(one.of(AREA_RULE_OPACITY_MAX)),
            _ => -(-x).exp_m1(),
        };
    }
}

/// Gradients of [`share`]: `logits` and `areas` are overwritten by theirs, those of
/// alpha and of the own area are returned. `grads` comes in with those of the result
/// and is used up.
#[inline(always)]
pub(super) fn share_backward<V: Lanes>(
    rule: Rule,
    (alpha, own): (V, V),
    grads: &mut [V],
    logits: &mut [V],
    areas: &mut [V],
) -> (V, V) {
    let zero = alpha.of(0.0);
    match rule {
        Rule::None => {
            logits.fill(zero);
            areas.fill(zero);
            (grads.iter().fold(zero, |sum, &g| sum + g), zero)
        }
        Rule::Linear => {
            let eps = alpha.of(AREA_EPS);
            for (l, &a) in logits.iter_mut().zip(areas.iter()) {
                *l = *l - (a + eps).ln();
            }
            let inverse = exponentials(logits);
            let weighted = logits.iter().zip(&*grads).fold(zero, |sum, (&w, &g)| w.fma(g, sum));
            let mean = weighted * inverse;
            let factor = alpha * inverse;
            for ((l, a), &mut g) in logits.iter_mut().zip(areas.iter_mut()).zip(grads) {
                *l = factor * *l * (g - mean);
                *a = -*l / (*a + eps);
            }
            (mean, zero)
        }
        _ => weighted_backward(rule, (alpha, own), grads, logits, areas),
    }
}

/// [`share_backward`] of the rules α_k = F(x_k), x_k = s·w_k / B_k, with s = τ(α) or α.
#[inline(always)]
fn weighted_backward<V: Lanes>(
    rule: Rule,
    (alpha, own): (V, V),
    grads: &mut [V],
    logits: &mut [V],
    areas: &mut [V],
) -> (V, V) {
    let (zero, one) = (alpha.of(0.0), alpha.of(1.0));
    let inverse = exponentials(logits);
    let per_own = if rule.areas_are_relative() { one / own } else { one };
    let s = if rule == Rule::Area { alpha } else { optical_depth(alpha) };
    let (mut by_s, mut mean, mut by_own) = (zero, zero, zero);
    for ((l, a), g) in logits.iter_mut().zip(areas.iter_mut()).zip(grads.iter_mut()) {
        let inverse_b = one / divisor(rule, *a, per_own);
        *l = *l * inverse;
        let share = *l * inverse_b;
        let x = s * share;
        let dx = match rule {
            Rule::Area => V::select(x.lt(one.of(AREA_RULE_OPACITY_MAX)), *g, zero),
            _ => *g * (-x).exp(),
        };
        by_s = dx.fma(share, by_s);
        *g = dx * x;
        mean = mean + *g;
        let d_b = match rule {
            Rule::Transmittance => zero,
            _ => {
                let free = one.of(RELATIVE_AREA_MIN).lt(*a * per_own);
                V::select(free, -*g * inverse_b, zero)
            }
        };
        by_own = d_b.fma(*a, by_own);
        *a = d_b * per_own;
    }
    // ∂x_k/∂ℓ_j = x_k(δ_kj − w_j).
    for (l, &mut g) in logits.iter_mut().zip(grads) {
        *l = g - *l * mean;
    }
    let d_alpha = match rule {
        Rule::Area => by_s,
        _ => {
            let free = alpha.lt(one.of(OPACITY_CEILING));
            by_s * V::select(free, one / (one - alpha), zero)
        }
    };
    (d_alpha, -by_own * per_own * per_own)
}

/// Arguments of the whole rule, K = `k` children for each of P parents.
#[derive(Clone, Copy, Debug)]
pub struct Args<'a, T> {
    /// How.
    pub rule: Rule,
    /// K, at least 1.
    pub k: usize,
    /// ℓ, `[P, K]`.
    pub logits: &'a [T],
    /// `[P, K]`.
    pub areas: &'a [T],
    /// α, `[P]`.
    pub alphas: &'a [T],
    /// `[P]` for the rules whose areas are relative; else not read.
    pub own: &'a [T],
}

impl<'a, T: LaneReal> Args<'a, T> {
    /// Those of the parents from `first` on, at most `count`.
    fn parents(self, first: usize, count: usize) -> Self {
        let span = |s: &'a [T], per: usize| {
            &s[(first * per).min(s.len())..((first + count) * per).min(s.len())]
        };
        let Self { rule, k, .. } = self;
        Self {
            rule,
            k,
            logits: span(self.logits, k),
            areas: span(self.areas, k),
            alphas: span(self.alphas, 1),
            own: span(self.own, 1),
        }
    }
}

/// `[parent][k]` of `count` parents from `first` on to a vector per child; lanes
/// above `count` repeat the last parent.
#[inline(always)]
fn gather<M: Machine>(
    m: M,
    from: &[M::Scalar],
    (first, count): (usize, usize),
    out: &mut [M::V],
    tile: &mut [[M::Scalar; WIDTH_MAX]],
) {
    let k = out.len();
    for lane in 0..M::WIDTH {
        let row = &from[(first + lane.min(count - 1)) * k..][..k];
        for (tile, &v) in tile.iter_mut().zip(row) {
            tile[lane] = v;
        }
    }
    for (out, tile) in out.iter_mut().zip(&*tile) {
        *out = m.load(tile);
    }
}

/// The inverse of [`gather`].
#[inline(always)]
fn scatter<M: Machine>(
    m: M,
    from: &[M::V],
    (first, count): (usize, usize),
    to: &mut [M::Scalar],
    tile: &mut [[M::Scalar; WIDTH_MAX]],
) {
    let k = from.len();
    for (&v, tile) in from.iter().zip(tile.iter_mut()) {
        m.store(v, tile);
    }
    for lane in 0..count {
        let row = &mut to[(first + lane) * k..][..k];
        for (v, tile) in row.iter_mut().zip(&*tile) {
            *v = tile[lane];
        }
    }
}

/// One number per parent, `count` of them from `first` on; 1 where there is none.
#[inline(always)]
fn single<M: Machine>(m: M, from: &[M::Scalar], (first, count): (usize, usize)) -> M::V {
    let mut lanes = [M::Scalar::of(1.0); WIDTH_MAX];
    for (lane, out) in lanes[..M::WIDTH].iter_mut().enumerate() {
        if let Some(&v) = from.get(first + lane.min(count - 1)) {
            *out = v;
        }
    }
    m.load(&lanes)
}

/// A block of parents forward.
struct Forward<'a, T> {
    args: Args<'a, T>,
    out: &'a mut [T],
}

impl<T: LaneReal> Kernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        let mut tile = vec![[T::default(); WIDTH_MAX]; k];
        let (mut a, mut o) = (vec![m.of(0.0); k], vec![m.of(0.0); k]);
        for first in (0..alphas.len()).step_by(M::WIDTH) {
            let span = (first, M::WIDTH.min(alphas.len() - first));
            gather(m, logits, span, &mut o, &mut tile);
            gather(m, areas, span, &mut a, &mut tile);
            share(rule, &a, single(m, alphas, span), single(m, own, span), &mut o);
            scatter(m, &o, span, self.out, &mut tile);
        }
    }
}

/// Opacities `[P, K]` of the children into `out` (module doc).
pub fn forward<T: LaneReal>(args: Args<T>, out: &mut [T]) {
    out.par_chunks_mut(args.k * BLOCK).enumerate().for_each(|(block, out)| {
        T::dispatch(Forward { args: args.parents(block * BLOCK, BLOCK), out });
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
    /// `[P]`; zeros for the rules that do not read it.
    pub own: Vec<T>,
}

/// A block of parents backward; the slices are the block's own.
struct Backward<'a, T> {
    args: Args<'a, T>,
    grad: &'a [T],
    logits: &'a mut [T],
    areas: &'a mut [T],
    alphas: &'a mut [T],
    own: &'a mut [T],
}

impl<T: LaneReal> Kernel<T> for Backward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        let mut tile = vec![[T::default(); WIDTH_MAX]; k];
        let zeros = vec![m.of(0.0); k];
        let (mut l, mut a, mut g) = (zeros.clone(), zeros.clone(), zeros);
        for first in (0..alphas.len()).step_by(M::WIDTH) {
            let span = (first, M::WIDTH.min(alphas.len() - first));
            gather(m, logits, span, &mut l, &mut tile);
            gather(m, areas, span, &mut a, &mut tile);
            gather(m, self.grad, span, &mut g, &mut tile);
            let per_parent = (single(m, alphas, span), single(m, own, span));
            let (d_alpha, d_own) = share_backward(rule, per_parent, &mut g, &mut l, &mut a);
            scatter(m, &l, span, self.logits, &mut tile);
            scatter(m, &a, span, self.areas, &mut tile);
            for (v, out) in [(d_alpha, &mut *self.alphas), (d_own, &mut *self.own)] {
                let mut lanes = [T::default(); WIDTH_MAX];
                m.store(v, &mut lanes);
                out[first..first + span.1].copy_from_slice(&lanes[..span.1]);
            }
        }
    }
}

/// Gradients of [`forward`] for the gradient `grad` `[P, K]` of its result.
pub fn backward<T: LaneReal>(args: Args<T>, grad: &[T]) -> Gradients<T> {
    let (p, k) = (args.alphas.len(), args.k);
    let zeros = |n: usize| vec![T::default(); n];
    let mut g =
        Gradients { logits: zeros(p * k), areas: zeros(p * k), alphas: zeros(p), own: zeros(p) };
    g.logits
        .par_chunks_mut(k * BLOCK)
        .zip(g.areas.par_chunks_mut(k * BLOCK))
        .zip(g.alphas.par_chunks_mut(BLOCK).zip(g.own.par_chunks_mut(BLOCK)))
        .zip(grad.par_chunks(k * BLOCK))
        .enumerate()
        .for_each(|(block, (((logits, areas), (alphas, own)), grad))| {
            let args = args.parents(block * BLOCK, BLOCK);
            T::dispatch(Backward { args, grad, logits, areas, alphas, own });
        });
    g
}
