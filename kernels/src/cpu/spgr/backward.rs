//! Gradients of the children with respect to head records and parents.
//!
//! The pass recomputes everything from the inputs. A first loop over the children computes
//! their areas, which the opacity rule couples; a second loop computes the rest. Gains
//! depend on one number of a head record and have a pass of their own.

use super::child::{Child, ChildGradient};
use super::parent::{Parent, ParentGradient};
use super::view::Table;
use super::{Args, BLOCK, Rules, records};
use crate::cpu::redistribute::share_backward;
use crate::cpu::simd::{LANES, Real, RowLayout, Vector, VectorKernel};
use crate::layout::{
    HEAD_GAIN_OFFSET, HEAD_LOGIT_OFFSET, HEAD_STRIDE, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET,
    SCALE_OFFSET, SPLAT_STRIDE,
};
use rayon::prelude::*;

/// One block of parents; the mutable slices are the block's own.
struct Backward<'a, T> {
    args: Args<'a, T>,
    /// With respect to children, `[N·K, 11]`.
    grad: &'a [T],
    table: &'a Table<T>,
    range: std::ops::Range<usize>,
    head: &'a mut [T],
    parents: &'a mut [T],
}

/// Vectors per child, reused from group to group.
struct Scratch<V> {
    areas: Vec<V>,
    logits: Vec<V>,
    alphas: Vec<V>,
}

impl<T: Real> VectorKernel<T> for Backward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(mut self) {
        let zeros = vec![V::constant(0.0); self.args.rules.children()];
        let mut scratch = Scratch { areas: zeros.clone(), logits: zeros.clone(), alphas: zeros };
        for first in self.range.clone().step_by(V::LANES) {
            let count = V::LANES.min(self.range.end - first);
            self.group((first, count), &mut scratch);
        }
    }
}

impl<T: Real> Backward<'_, T> {
    #[inline(always)]
    fn group<V: Vector<Element = T>>(&mut self, span: (usize, usize), s: &mut Scratch<V>) {
        let Args { rules, source, parents, .. } = self.args;
        let children = rules.children();
        let parent = Parent::load((rules, self.table, &source), parents, span);
        for k in 0..children {
            let head = records(&self.args, span, k);
            let child = Child::new(rules, &parent, k, &head);
            (s.areas[k], s.logits[k]) = (child.area, head[HEAD_LOGIT_OFFSET]);
            s.alphas[k] = self.opacity(span, k);
        }
        let mut d = ParentGradient::zero(V::constant(0.0));
        let of_parent = (parent.alpha, parent.own);
        (d.alpha, d.own) =
            share_backward(rules.opacity, of_parent, &mut s.alphas, &mut s.logits, &mut s.areas);
        let at = span.0 - self.range.start;
        for k in 0..children {
            let head = records(&self.args, span, k);
            let child = Child::new(rules, &parent, k, &head);
            let mut d_head = [V::constant(0.0); HEAD_STRIDE];
            d_head[HEAD_LOGIT_OFFSET] = s.logits[k];
            let g = self.cotangents(span, k, s.areas[k]);
            child.backward((rules, &parent), g, &mut d_head, &mut d);
            let to = &mut self.head[(at * children + k) * HEAD_STRIDE..];
            V::store_rows(&d_head, RowLayout { stride: children * HEAD_STRIDE, count: span.1 }, to);
        }
        let d_parents = parent.backward(rules, d);
        V::store_rows(
            &d_parents,
            RowLayout { stride: SPLAT_STRIDE, count: span.1 },
            &mut self.parents[at * SPLAT_STRIDE..],
        );
    }

    /// Gradients of the opacity of child `k`.
    #[inline(always)]
    fn opacity<V: Vector<Element = T>>(&self, (first, count): (usize, usize), k: usize) -> V {
        let children = self.args.rules.children();
        let from = &self.grad[(first * children + k) * SPLAT_STRIDE + OPACITY_OFFSET..];
        let mut lanes = [T::default(); LANES];
        for (lane, out) in lanes[..V::LANES].iter_mut().enumerate() {
            *out = from[lane.min(count - 1) * children * SPLAT_STRIDE];
        }
        V::load(&lanes)
    }

    /// Gradients of mean, quaternion and σ of child `k`, and that of its area.
    #[inline(always)]
    fn cotangents<V: Vector<Element = T>>(
        &self,
        (first, count): (usize, usize),
        k: usize,
        area: V,
    ) -> ChildGradient<V> {
        let children = self.args.rules.children();
        let from = &self.grad[(first * children + k) * SPLAT_STRIDE..];
        let g: [V; SPLAT_STRIDE] =
            V::load_rows(from, RowLayout { stride: children * SPLAT_STRIDE, count });
        let vector = |i: usize| [g[i], g[i + 1], g[i + 2]];
        let q = QUAT_OFFSET;
        ChildGradient {
            mean: vector(MEAN_OFFSET),
            quat: [g[q], g[q + 1], g[q + 2], g[q + 3]],
            scale: vector(SCALE_OFFSET),
            area,
        }
    }
}

/// Computes gradients into `head` `[N, K, 11]` and `parents` `[N, 11]` from those of the
/// children, `grad` `[N·K, 11]`. One task owns each parent, so any number of threads gives
/// the same bytes.
pub fn backward<T: Real>(args: Args<T>, grad: &[T], head: &mut [T], parents: &mut [T]) {
    let table = Table::new(&args.source);
    head.par_chunks_mut(BLOCK * args.rules.children() * HEAD_STRIDE)
        .zip(parents.par_chunks_mut(BLOCK * SPLAT_STRIDE))
        .enumerate()
        .for_each(|(block, (head, parents))| {
            let range = args.block(block);
            T::dispatch(Backward { args, grad, table: &table, range, head, parents });
        });
}

/// Head records per rayon task of [`gains_backward`].
const GAIN_BLOCK: usize = 1024;

/// A block of head records; all slices are the block's own.
struct GainsBackward<'a, T> {
    rules: &'a Rules,
    head: &'a [T],
    grad: &'a [T],
    out: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for GainsBackward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let lanes = self.rules.gain_channels();
        let count = self.head.len() / HEAD_STRIDE;
        for first in (0..count).step_by(V::LANES) {
            let width = V::LANES.min(count - first);
            let (mut raw, mut by_gain) = ([T::default(); LANES], [T::default(); LANES]);
            for lane in 0..width {
                raw[lane] = self.head[(first + lane) * HEAD_STRIDE + HEAD_GAIN_OFFSET];
                let grad = &self.grad[(first + lane) * lanes..][..lanes];
                let residual: T = grad[1..].iter().copied().sum();
                by_gain[lane] = grad[0] + T::constant(0.5) * residual;
            }
            let t = V::load(&raw).tanh();
            (V::load(&by_gain) * V::constant(self.rules.delta) * (V::constant(1.0) - t * t))
                .store(&mut raw);
            for (lane, &d) in raw[..width].iter().enumerate() {
                self.out[(first + lane) * HEAD_STRIDE + HEAD_GAIN_OFFSET] = d;
            }
        }
    }
}

/// Computes gradients into element [`HEAD_GAIN_OFFSET`] of the rows of `out` `[N, K, 11]`, from
/// those of the gains, `grad` `[N·K]` or `[N·K, 4]`. Writes nothing else.
pub fn gains_backward<T: Real>(rules: &Rules, head: &[T], grad: &[T], out: &mut [T]) {
    out.par_chunks_mut(GAIN_BLOCK * HEAD_STRIDE)
        .zip(head.par_chunks(GAIN_BLOCK * HEAD_STRIDE))
        .zip(grad.par_chunks(GAIN_BLOCK * rules.gain_channels()))
        .for_each(|((out, head), grad)| T::dispatch(GainsBackward { rules, head, grad, out }));
}
