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
//! vector ([`super::lanes`]), so that a sum over children is a loop. Twins:
//! kernels/redistribute.wgsl, src/gpu/redistribute.rs. Op: ops/redistribute.rs.

use super::lanes::{Kernel, LaneReal, Lanes, Machine, WIDTH_MAX};
use super::real::Real;
use super::uninit::{UninitBuffer, UninitSlice, zeroed};
use crate::abi::{AREA_EPS, AREA_RULE_OPACITY_MAX, OPACITY_CEILING, RELATIVE_AREA_MIN};
use rayon::prelude::*;

pub use crate::abi::Rule;

/// Parents per rayon task: all that it reads and writes lies in the caches of a core.
const BLOCK: usize = 512;

/// Areas above count as this, px²: over [`AREA_EPS`] it is still far from overflow.
const AREA_MAX: f64 = 1e28;

/// B above counts as this: such a child gets less than 1e-17 of the parent, and the
/// product of two is far from overflow.
const RELATIVE_AREA_MAX: f64 = 1e18;

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

/// e^{ℓ_k − max ℓ}·(A_0 + ε)/(A_k + ε) in place of ℓ: softmax(ℓ − ln(A + ε)) before its
/// division by the sum, which is returned, without a logarithm. An only child gets 1.
#[inline(always)]
fn per_area<V: Lanes>(areas: &[V], logits: &mut [V]) -> V {
    let mut top = logits[0];
    for &v in &logits[1..] {
        top = top.max(v);
    }
    let (mut sum, eps) = (top.of(0.0), top.of(AREA_EPS));
    // Bounded, so that no quotient leaves f32.
    let bounded = |a: V| (a + eps).min(a.of(AREA_MAX));
    let first = bounded(areas[0]);
    for (l, &a) in logits.iter_mut().zip(areas) {
        *l = (*l - top).exp() * first / bounded(a);
        sum = sum + *l;
    }
    sum
}

#[inline(always)]
fn optical_depth<V: Lanes>(alpha: V) -> V {
    -(-alpha.min(alpha.of(OPACITY_CEILING))).ln_1p()
}

/// B: what the rules with relative areas divide by, bounded so that two of them may be
/// multiplied.
#[inline(always)]
fn divisor<V: Lanes>(area: V, per_own: V) -> V {
    (area * per_own).max(area.of(RELATIVE_AREA_MIN)).min(area.of(RELATIVE_AREA_MAX))
}

/// F of the rules α_k = F(x_k).
#[inline(always)]
fn opacity_of<V: Lanes>(rule: Rule, x: V) -> V {
    match rule {
        Rule::Area => x.min(x.of(AREA_RULE_OPACITY_MAX)),
        _ => -(-x).exp_m1(),
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
        let factor = alpha / per_area(areas, alphas);
        alphas.iter_mut().for_each(|o| *o = *o * factor);
        return;
    }
    let one = alpha.of(1.0);
    let inverse = exponentials(alphas);
    let per_own = if rule.areas_are_relative() { one / own } else { one };
    let whole = if rule == Rule::Area { alpha } else { optical_depth(alpha) };
    let factor = whole * inverse;
    if rule == Rule::Transmittance {
        alphas.iter_mut().for_each(|o| *o = opacity_of(rule, factor * *o));
        return;
    }
    let (mut areas, mut pairs) = (areas.chunks_exact(2), alphas.chunks_exact_mut(2));
    for (o, a) in pairs.by_ref().zip(areas.by_ref()) {
        // One division for two: it costs as much as an exponential.
        let (a, b) = (divisor(a[0], per_own), divisor(a[1], per_own));
        let both = factor / (a * b);
        (o[0], o[1]) = (opacity_of(rule, both * b * o[0]), opacity_of(rule, both * a * o[1]));
    }
    if let (Some(o), Some(&a)) = (pairs.into_remainder().first_mut(), areas.remainder().first()) {
        *o = opacity_of(rule, factor * *o / divisor(a, per_own));
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
            let inverse = alpha.of(1.0) / per_area(areas, logits);
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
        let inverse_b = match rule {
            Rule::Transmittance => one,
            _ => one / divisor(*a, per_own),
        };
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

/// K vectors of a group of parents, one per child: an array where K is that of a usual
/// upscaling factor, so that loops over children unroll and stay in registers.
trait Children<M: Machine>: AsMut<[M::V]> + AsRef<[M::V]> {
    /// `count` rows of K numbers, one after the other; lanes above `count` repeat the
    /// last row.
    fn load(&mut self, m: M, rows: &[M::Scalar], count: usize);
    /// The inverse of [`Children::load`].
    fn store(&self, m: M, rows: &mut [M::Scalar], count: usize);
}

impl<M: Machine, const K: usize> Children<M> for [M::V; K] {
    #[inline(always)]
    fn load(&mut self, m: M, rows: &[M::Scalar], count: usize) {
        *self = m.load_rows(rows, (K, count));
    }
    #[inline(always)]
    fn store(&self, m: M, rows: &mut [M::Scalar], count: usize) {
        m.store_rows(self, (K, count), rows);
    }
}

impl<M: Machine> Children<M> for Vec<M::V> {
    #[inline(always)]
    fn load(&mut self, m: M, rows: &[M::Scalar], count: usize) {
        let children = self.len();
        for (k, v) in self.iter_mut().enumerate() {
            let [only] = m.load_rows(&rows[k..], (children, count));
            *v = only;
        }
    }
    #[inline(always)]
    fn store(&self, m: M, rows: &mut [M::Scalar], count: usize) {
        for (k, &v) in self.iter().enumerate() {
            m.store_rows(&[v], (self.len(), count), &mut rows[k..]);
        }
    }
}

/// One number per parent, `count` of them from `first` on; 1 where there is none.
#[inline(always)]
fn single<M: Machine>(m: M, from: &[M::Scalar], (first, count): (usize, usize)) -> M::V {
    match from.get(first..first + count) {
        Some(from) => {
            let [only] = load_singles(m, from, count);
            only
        }
        None => m.of(1.0),
    }
}

#[inline(always)]
fn load_singles<M: Machine>(m: M, from: &[M::Scalar], count: usize) -> [M::V; 1] {
    if let Some(whole) = from.first_chunk::<WIDTH_MAX>()
        && M::WIDTH == WIDTH_MAX
    {
        return [m.load(whole)];
    }
    let mut lanes = [M::Scalar::of(1.0); WIDTH_MAX];
    for (lane, out) in lanes[..M::WIDTH].iter_mut().enumerate() {
        *out = from[lane.min(count - 1)];
    }
    [m.load(&lanes)]
}

/// A block of parents forward.
struct Forward<'a, T> {
    args: Args<'a, T>,
    out: &'a mut UninitSlice<T>,
}

impl<T: LaneReal> Forward<'_, T> {
    #[inline(always)]
    fn of<M: Machine<Scalar = T>, C: Children<M>>(self, m: M, mut a: C, mut o: C) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        for first in (0..alphas.len()).step_by(M::WIDTH) {
            let count = M::WIDTH.min(alphas.len() - first);
            let (span, at) = ((first, count), first * k);
            o.load(m, &logits[at..], count);
            a.load(m, &areas[at..], count);
            let (alpha, own) = (single(m, alphas, span), single(m, own, span));
            share(rule, a.as_ref(), alpha, own, o.as_mut());
            o.store(m, zeroed(&mut self.out[at..at + count * k]), count);
        }
    }
}

impl<T: LaneReal> Kernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let zero = m.of(0.0);
        match self.args.k {
            4 => self.of(m, [zero; 4], [zero; 4]),
            9 => self.of(m, [zero; 9], [zero; 9]),
            16 => self.of(m, [zero; 16], [zero; 16]),
            k => self.of(m, vec![zero; k], vec![zero; k]),
        }
    }
}

/// Opacities `[P, K]` of the children (module doc).
pub fn forward<T: LaneReal>(args: Args<T>) -> Vec<T> {
    let mut out = UninitBuffer::new(args.alphas.len() * args.k);
    out.par_chunks_mut(args.k * BLOCK).enumerate().for_each(|(block, out)| {
        T::dispatch(Forward { args: args.parents(block * BLOCK, BLOCK), out });
    });
    // SAFETY: the loop above started every block.
    unsafe { out.assume_init() }
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
    logits: &'a mut UninitSlice<T>,
    areas: &'a mut UninitSlice<T>,
    alphas: &'a mut UninitSlice<T>,
    own: &'a mut UninitSlice<T>,
}

impl<T: LaneReal> Backward<'_, T> {
    #[inline(always)]
    fn of<M: Machine<Scalar = T>, C: Children<M>>(self, m: M, [mut l, mut a, mut g]: [C; 3]) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        for first in (0..alphas.len()).step_by(M::WIDTH) {
            let count = M::WIDTH.min(alphas.len() - first);
            let (span, at) = ((first, count), first * k);
            l.load(m, &logits[at..], count);
            a.load(m, &areas[at..], count);
            g.load(m, &self.grad[at..], count);
            let per_parent = (single(m, alphas, span), single(m, own, span));
            let (d_alpha, d_own) =
                share_backward(rule, per_parent, g.as_mut(), l.as_mut(), a.as_mut());
            l.store(m, zeroed(&mut self.logits[at..at + count * k]), count);
            a.store(m, zeroed(&mut self.areas[at..at + count * k]), count);
            for (v, out) in [(d_alpha, &mut *self.alphas), (d_own, &mut *self.own)] {
                let mut lanes = [T::default(); WIDTH_MAX];
                m.store(v, &mut lanes);
                zeroed(&mut out[first..first + count]).copy_from_slice(&lanes[..count]);
            }
        }
    }
}

impl<T: LaneReal> Kernel<T> for Backward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let zero = m.of(0.0);
        match self.args.k {
            4 => self.of(m, [[zero; 4]; 3]),
            9 => self.of(m, [[zero; 9]; 3]),
            16 => self.of(m, [[zero; 16]; 3]),
            k => self.of(m, [vec![zero; k], vec![zero; k], vec![zero; k]]),
        }
    }
}

/// Gradients of [`forward`] for the gradient `grad` `[P, K]` of its result.
pub fn backward<T: LaneReal>(args: Args<T>, grad: &[T]) -> Gradients<T> {
    let (p, k) = (args.alphas.len(), args.k);
    let (mut logits, mut areas) = (UninitBuffer::new(p * k), UninitBuffer::new(p * k));
    let (mut alphas, mut own) = (UninitBuffer::new(p), UninitBuffer::new(p));
    type Own<'a, T> = (
        (&'a mut UninitSlice<T>, &'a mut UninitSlice<T>),
        (&'a mut UninitSlice<T>, &'a mut UninitSlice<T>),
    );
    let one = |block: usize, ((logits, areas), (alphas, own)): Own<T>| {
        let args = args.parents(block * BLOCK, BLOCK);
        let grad = &grad[block * BLOCK * k..];
        T::dispatch(Backward { args, grad, logits, areas, alphas, own });
    };
    logits
        .par_chunks_mut(k * BLOCK)
        .zip(areas.par_chunks_mut(k * BLOCK))
        .zip(alphas.par_chunks_mut(BLOCK).zip(own.par_chunks_mut(BLOCK)))
        .enumerate()
        .for_each(|(block, own)| one(block, own));
    // SAFETY: the loop above started every block: all four have as many.
    unsafe {
        Gradients {
            logits: logits.assume_init(),
            areas: areas.assume_init(),
            alphas: alphas.assume_init(),
            own: own.assume_init(),
        }
    }
}
