//! Redistribution of a parent's opacity to its children, and the gradient.
//!
//! Input: logits ℓ `[P,K]`; areas A `[P,K]`, px²; opacities α `[P]`; the parents' own
//! areas `[P]` for relative rules.   Output: `[P,K]`.
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
//! Logarithms clamp α to 0.9999. Each lane of a vector ([`super::simd`]) is a parent, so
//! that a sum over children is a loop. WGSL: wgsl/spgr/redistribute.wgsl,
//! kernels/src/gpu/spgr/redistribute.rs. Op: ops/redistribute.rs.

use super::simd::{LANES, Mask, Real, RowLayout, Vector, VectorKernel};
use super::uninit::{UninitBuffer, UninitSlice, zeroed};
use crate::layout::{AREA_EPS, AREA_RULE_OPACITY_MAX, OPACITY_CEILING, RELATIVE_AREA_MIN};
use rayon::prelude::*;

pub use crate::layout::OpacityRule;

/// Parents per rayon task: its data fits the caches of a core.
const BLOCK: usize = 512;

/// Upper clamp of areas, px²: its quotient by [`AREA_EPS`] does not overflow.
const AREA_MAX: f64 = 1e28;

/// Upper clamp of B: such a child gets less than 1e-17 of the parent, and the product of
/// two does not overflow.
const RELATIVE_AREA_MAX: f64 = 1e18;

/// Replaces `x` by eˣ⁻ᵐᵃˣ and returns the reciprocal of their sum.
#[inline(always)]
fn exponentials<V: Vector>(x: &mut [V]) -> V {
    let mut top = x[0];
    for &v in &x[1..] {
        top = top.max(v);
    }
    let mut sum = V::constant(0.0);
    for v in x.iter_mut() {
        *v = (*v - top).exp();
        sum = sum + *v;
    }
    V::constant(1.0) / sum
}

/// Replaces ℓ_k by e^{ℓ_k − max ℓ}·(A_0 + ε)/(A_k + ε) and returns the sum. Their quotient
/// is softmax(ℓ − ln(A + ε)) without a logarithm. An only child gets 1.
#[inline(always)]
fn per_area<V: Vector>(areas: &[V], logits: &mut [V]) -> V {
    let mut top = logits[0];
    for &v in &logits[1..] {
        top = top.max(v);
    }
    let mut sum = V::constant(0.0);
    let eps = V::constant(AREA_EPS);
    // The clamp keeps quotients inside the range of f32.
    let bounded = |a: V| (a + eps).min(V::constant(AREA_MAX));
    let first = bounded(areas[0]);
    for (l, &a) in logits.iter_mut().zip(areas) {
        *l = (*l - top).exp() * first / bounded(a);
        sum = sum + *l;
    }
    sum
}

#[inline(always)]
fn optical_depth<V: Vector>(alpha: V) -> V {
    -(-alpha.min(V::constant(OPACITY_CEILING))).ln_1p()
}

/// Returns B, the divisor of rules with relative areas, clamped so that a product of two
/// stays in range.
#[inline(always)]
fn divisor<V: Vector>(area: V, per_own: V) -> V {
    (area * per_own).max(V::constant(RELATIVE_AREA_MIN)).min(V::constant(RELATIVE_AREA_MAX))
}

/// Evaluates F of the rules α_k = F(x_k).
#[inline(always)]
fn opacity_of<V: Vector>(rule: OpacityRule, x: V) -> V {
    match rule {
        OpacityRule::Area => x.min(V::constant(AREA_RULE_OPACITY_MAX)),
        _ => -(-x).exp_m1(),
    }
}

/// Computes α_k of K children in the lanes of their parents. Relative rules alone read
/// `own`. K = `areas.len()` ≥ 1; `alphas` holds the logits on entry.
#[inline(always)]
pub(super) fn share<V: Vector>(rule: OpacityRule, areas: &[V], alpha: V, own: V, alphas: &mut [V]) {
    if rule == OpacityRule::None {
        alphas.fill(alpha);
        return;
    }
    if rule == OpacityRule::Linear {
        let factor = alpha / per_area(areas, alphas);
        for o in alphas {
            *o = *o * factor;
        }
        return;
    }
    let one = V::constant(1.0);
    let inverse = exponentials(alphas);
    let per_own = if rule.areas_are_relative() { one / own } else { one };
    let whole = if rule == OpacityRule::Area { alpha } else { optical_depth(alpha) };
    let factor = whole * inverse;
    if rule == OpacityRule::Transmittance {
        for o in alphas {
            *o = opacity_of(rule, factor * *o);
        }
        return;
    }
    let (mut areas, mut pairs) = (areas.chunks_exact(2), alphas.chunks_exact_mut(2));
    for (o, a) in pairs.by_ref().zip(areas.by_ref()) {
        // One division for two children: a division costs as much as an exponential.
        let (a, b) = (divisor(a[0], per_own), divisor(a[1], per_own));
        let both = factor / (a * b);
        (o[0], o[1]) = (opacity_of(rule, both * b * o[0]), opacity_of(rule, both * a * o[1]));
    }
    if let (Some(o), Some(&a)) = (pairs.into_remainder().first_mut(), areas.remainder().first()) {
        *o = opacity_of(rule, factor * *o / divisor(a, per_own));
    }
}

/// Computes the gradients of [`share`]: overwrites `logits` and `areas` by theirs, returns
/// those of alpha and of the own area. `grads` holds those of the result on entry and is
/// overwritten.
#[inline(always)]
pub(super) fn share_backward<V: Vector>(
    rule: OpacityRule,
    (alpha, own): (V, V),
    grads: &mut [V],
    logits: &mut [V],
    areas: &mut [V],
) -> (V, V) {
    let zero = V::constant(0.0);
    match rule {
        OpacityRule::None => {
            logits.fill(zero);
            areas.fill(zero);
            (grads.iter().fold(zero, |sum, &g| sum + g), zero)
        }
        OpacityRule::Linear => {
            let eps = V::constant(AREA_EPS);
            let inverse = V::constant(1.0) / per_area(areas, logits);
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
fn weighted_backward<V: Vector>(
    rule: OpacityRule,
    (alpha, own): (V, V),
    grads: &mut [V],
    logits: &mut [V],
    areas: &mut [V],
) -> (V, V) {
    let (zero, one) = (V::constant(0.0), V::constant(1.0));
    let inverse = exponentials(logits);
    let per_own = if rule.areas_are_relative() { one / own } else { one };
    let s = if rule == OpacityRule::Area { alpha } else { optical_depth(alpha) };
    let (mut by_s, mut mean, mut by_own) = (zero, zero, zero);
    for ((l, a), g) in logits.iter_mut().zip(areas.iter_mut()).zip(grads.iter_mut()) {
        let inverse_b = match rule {
            OpacityRule::Transmittance => one,
            _ => one / divisor(*a, per_own),
        };
        *l = *l * inverse;
        let share = *l * inverse_b;
        let x = s * share;
        let dx = match rule {
            OpacityRule::Area => x.lt(V::constant(AREA_RULE_OPACITY_MAX)).select_or_zero(*g),
            _ => *g * (-x).exp(),
        };
        by_s = dx.fma(share, by_s);
        *g = dx * x;
        mean = mean + *g;
        let d_b = match rule {
            OpacityRule::Transmittance => zero,
            _ => {
                let free = V::constant(RELATIVE_AREA_MIN).lt(*a * per_own);
                free.select_or_zero(-*g * inverse_b)
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
        OpacityRule::Area => by_s,
        _ => {
            let free = alpha.lt(V::constant(OPACITY_CEILING));
            by_s * free.select_or_zero(one / (one - alpha))
        }
    };
    (d_alpha, -by_own * per_own * per_own)
}

/// Arguments of the whole rule, K = `k` children for each of P parents.
#[derive(Clone, Copy, Debug)]
pub struct Args<'a, T> {
    /// Rule of redistribution.
    pub rule: OpacityRule,
    /// K, at least 1.
    pub k: usize,
    /// ℓ, `[P, K]`.
    pub logits: &'a [T],
    /// `[P, K]`.
    pub areas: &'a [T],
    /// α, `[P]`.
    pub alphas: &'a [T],
    /// `[P]` for rules with relative areas; other rules do not read it.
    pub own: &'a [T],
}

impl<'a, T: Real> Args<'a, T> {
    /// Returns the arguments of at most `count` parents from `first` on.
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

/// K vectors of a group of parents, one per child. An array holds the K of a usual upscaling
/// factor, so that loops over children unroll and stay in registers.
trait Children<V: Vector>: AsMut<[V]> + AsRef<[V]> {
    /// Loads `count` adjacent rows of K numbers; lanes past `count` repeat the last row.
    fn load(&mut self, rows: &[V::Element], count: usize);
    /// Stores rows, the inverse of [`Children::load`].
    fn store(&self, rows: &mut [V::Element], count: usize);
}

impl<V: Vector, const K: usize> Children<V> for [V; K] {
    #[inline(always)]
    fn load(&mut self, rows: &[V::Element], count: usize) {
        *self = V::load_rows(rows, RowLayout { stride: K, count });
    }
    #[inline(always)]
    fn store(&self, rows: &mut [V::Element], count: usize) {
        V::store_rows(self, RowLayout { stride: K, count }, rows);
    }
}

impl<V: Vector> Children<V> for Vec<V> {
    #[inline(always)]
    fn load(&mut self, rows: &[V::Element], count: usize) {
        let children = self.len();
        for (k, v) in self.iter_mut().enumerate() {
            let [only] = V::load_rows(&rows[k..], RowLayout { stride: children, count });
            *v = only;
        }
    }
    #[inline(always)]
    fn store(&self, rows: &mut [V::Element], count: usize) {
        for (k, &v) in self.iter().enumerate() {
            V::store_rows(&[v], RowLayout { stride: self.len(), count }, &mut rows[k..]);
        }
    }
}

/// Loads one number per parent, `count` of them from `first` on; 1 if `from` is empty.
#[inline(always)]
fn single<V: Vector>(from: &[V::Element], (first, count): (usize, usize)) -> V {
    match from.get(first..first + count) {
        Some(from) => {
            let [only] = load_singles(from, count);
            only
        }
        None => V::constant(1.0),
    }
}

#[inline(always)]
fn load_singles<V: Vector>(from: &[V::Element], count: usize) -> [V; 1] {
    if let Some(whole) = from.first_chunk::<LANES>()
        && V::LANES == LANES
    {
        return [V::load(whole)];
    }
    let mut lanes = [V::Element::constant(1.0); LANES];
    for (lane, out) in lanes[..V::LANES].iter_mut().enumerate() {
        *out = from[lane.min(count - 1)];
    }
    [V::load(&lanes)]
}

/// The forward pass of a block of parents.
struct Forward<'a, T> {
    args: Args<'a, T>,
    out: &'a mut UninitSlice<T>,
}

impl<T: Real> Forward<'_, T> {
    #[inline(always)]
    fn with_children<V: Vector<Element = T>, C: Children<V>>(self, mut a: C, mut o: C) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        for first in (0..alphas.len()).step_by(V::LANES) {
            let count = V::LANES.min(alphas.len() - first);
            let (span, at) = ((first, count), first * k);
            o.load(&logits[at..], count);
            a.load(&areas[at..], count);
            let (alpha, own) = (single(alphas, span), single(own, span));
            share(rule, a.as_ref(), alpha, own, o.as_mut());
            o.store(zeroed(&mut self.out[at..at + count * k]), count);
        }
    }
}

impl<T: Real> VectorKernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let zero = V::constant(0.0);
        match self.args.k {
            4 => self.with_children::<V, _>([zero; 4], [zero; 4]),
            9 => self.with_children::<V, _>([zero; 9], [zero; 9]),
            16 => self.with_children::<V, _>([zero; 16], [zero; 16]),
            k => self.with_children::<V, _>(vec![zero; k], vec![zero; k]),
        }
    }
}

/// Computes the opacities `[P, K]` of the children (module documentation).
pub fn forward<T: Real>(args: Args<T>) -> Vec<T> {
    let mut out = UninitBuffer::new(args.alphas.len() * args.k);
    out.par_chunks_mut(args.k * BLOCK).enumerate().for_each(|(block, out)| {
        T::dispatch(Forward { args: args.parents(block * BLOCK, BLOCK), out });
    });
    // SAFETY: the loop above initialised every block.
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
    /// `[P]`; zeros for rules without relative areas.
    pub own: Vec<T>,
}

/// The backward pass of a block of parents; the slices are the block's own.
struct Backward<'a, T> {
    args: Args<'a, T>,
    grad: &'a [T],
    logits: &'a mut UninitSlice<T>,
    areas: &'a mut UninitSlice<T>,
    alphas: &'a mut UninitSlice<T>,
    own: &'a mut UninitSlice<T>,
}

impl<T: Real> Backward<'_, T> {
    #[inline(always)]
    fn with_children<V: Vector<Element = T>, C: Children<V>>(self, [mut l, mut a, mut g]: [C; 3]) {
        let Args { rule, k, logits, areas, alphas, own } = self.args;
        for first in (0..alphas.len()).step_by(V::LANES) {
            let count = V::LANES.min(alphas.len() - first);
            let (span, at) = ((first, count), first * k);
            l.load(&logits[at..], count);
            a.load(&areas[at..], count);
            g.load(&self.grad[at..], count);
            let per_parent = (single(alphas, span), single(own, span));
            let (d_alpha, d_own) =
                share_backward(rule, per_parent, g.as_mut(), l.as_mut(), a.as_mut());
            l.store(zeroed(&mut self.logits[at..at + count * k]), count);
            a.store(zeroed(&mut self.areas[at..at + count * k]), count);
            for (v, out) in [(d_alpha, &mut *self.alphas), (d_own, &mut *self.own)] {
                let mut lanes = [T::default(); LANES];
                v.store(&mut lanes);
                zeroed(&mut out[first..first + count]).copy_from_slice(&lanes[..count]);
            }
        }
    }
}

impl<T: Real> VectorKernel<T> for Backward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let zero = V::constant(0.0);
        match self.args.k {
            4 => self.with_children::<V, _>([[zero; 4]; 3]),
            9 => self.with_children::<V, _>([[zero; 9]; 3]),
            16 => self.with_children::<V, _>([[zero; 16]; 3]),
            k => self.with_children::<V, _>([vec![zero; k], vec![zero; k], vec![zero; k]]),
        }
    }
}

/// Computes the gradients of [`forward`] from the gradient `grad` `[P, K]` of its result.
pub fn backward<T: Real>(args: Args<T>, grad: &[T]) -> Gradients<T> {
    let p = args.alphas.len();
    let k = args.k;
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
    // SAFETY: the loop above initialised every block: all four have as many.
    unsafe {
        Gradients {
            logits: logits.assume_init(),
            areas: areas.assume_init(),
            alphas: alphas.assume_init(),
            own: own.assume_init(),
        }
    }
}
