//! Sub-pixel Gaussian reparameterization, one pass per parent and no temporary in memory
//! (SubSplat section 3.2, supplement A.3).
//!
//! Input: head records `[N, K, 11]` and parents `[N, 11]` (offsets in [`crate::layout`]),
//! cameras of the V context views.   Output: children `[N·K, 11]`, child k of parent n at
//! row n·K + k, and their colour gain `[N·K]` or, in RGB, `[N·K, 4]` (γ, δ).
//!
//! Child k = (i, j) of the r × r sub-pixel grid, row-major, in the parent's primary
//! view v* with camera coordinates x_c of its mean and z its depth:
//! ```text
//! Δ   = ((j+½)/r − ½, (i+½)/r − ½) + bounded (û, v̂)/r            input px
//! p   = x_c + lateral(Δ) + Δẑ·direction,   Δẑ = β_z·tanh(Δz)·unit
//! s_k = λ_s·s⊙exp(c·tanh(Δlog s/c)),   q_k = q_p ⊗ e(Δr)
//! M   = J(p)·R_w2c·R(q_k)·diag(s_k)                                target px
//! A_k = |m₁ × m₂| = √det(J Σ Jᵀ), raised to A_min
//! ```
//! and opacities by [`super::redistribute`]. `backward` recomputes all of it from the same
//! inputs. The choice of v*, the growth of small footprints and the share of a disc step
//! are constant to gradients. `project` computes 2-D splats of one camera without writing
//! children.
//!
//! Each lane of a vector is a parent: child k of 16 parents at a time, so that sums over
//! children are loops and any K fills the vector. Op: ops/spgr.rs. Reference in tensor
//! operations: tests/support/src/spgr_reference.rs. Tests: tests/spgr/spgr.rs,
//! tests/spgr/spgr_backward.rs.
//!
//! The rule of equal optical depth uses the low-pass of the render for children and that of the
//! input for parents. With `slide = disc` a child moves at most a tenth of its depth, since an
//! edge-on disc would move it without bound.

mod backward;
mod child;
mod colour;
mod parent;
mod project;
mod shape;
mod view;

pub use crate::layout::{CHILDREN_MAX, Rules};
pub use backward::{backward, gains_backward};
pub use project::{Target, project};

use super::redistribute::share;
use super::simd::{LANES, Real, RowLayout, Vector, VectorKernel};
use crate::camera::Camera;
use crate::layout::{
    GainSpace, HEAD_GAIN_OFFSET, HEAD_LOGIT_OFFSET, HEAD_STRIDE, MEAN_OFFSET, OPACITY_OFFSET,
    QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};
use child::Child;
use parent::Parent;
use rayon::prelude::*;
use view::Table;

/// Origin of the parents: context cameras and indices.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Context views, pixels of the input pictures.
    pub cameras: &'a [Camera],
    /// Near plane of each view, world units.
    pub near: &'a [f32],
    /// Parents per view.
    pub per_view: usize,
    /// Index of parent 0 of this call: parent n came from view (first + n) / per_view.
    pub first: usize,
}

/// Parents per rayon task.
const BLOCK: usize = 64;

/// Inputs of the kernels.
#[derive(Clone, Copy, Debug)]
pub struct Args<'a, T> {
    /// Rules for the children; K ≤ [`CHILDREN_MAX`].
    pub rules: &'a Rules,
    /// Origin of the parents.
    pub source: Source<'a>,
    /// Head records `[N, K, 11]`.
    pub head: &'a [T],
    /// `[N, 11]`.
    pub parents: &'a [T],
}

impl<T> Args<'_, T> {
    /// N.
    fn count(&self) -> usize {
        self.parents.len() / SPLAT_STRIDE
    }

    /// The parents of block number `block`.
    fn block(&self, block: usize) -> std::ops::Range<usize> {
        block * BLOCK..((block + 1) * BLOCK).min(self.count())
    }
}

/// Loads the head records of child `k` of `count` parents from `first` on.
#[inline(always)]
fn records<V: Vector>(
    args: &Args<V::Element>,
    (first, count): (usize, usize),
    k: usize,
) -> [V; HEAD_STRIDE] {
    let children = args.rules.children();
    let from = &args.head[(first * children + k) * HEAD_STRIDE..];
    V::load_rows(from, RowLayout { stride: children * HEAD_STRIDE, count })
}

/// The forward pass of one block of parents; `rows` and `gains` are the block's own.
struct Forward<'a, T> {
    args: Args<'a, T>,
    table: &'a Table<T>,
    parents: std::ops::Range<usize>,
    rows: &'a mut [T],
    gains: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for Forward<'_, T> {
    type Output = bool;
    #[inline(always)]
    fn run<V: Vector<Element = T>>(mut self) -> bool {
        let k = self.args.rules.children();
        let (mut areas, mut alphas) = (vec![V::constant(0.0); k], vec![V::constant(0.0); k]);
        // x − x is 0 for a finite number and NaN for any other.
        let mut finite = V::constant(0.0);
        for first in self.parents.clone().step_by(V::LANES) {
            let span = (first, V::LANES.min(self.parents.end - first));
            let bad = self.group(span, &mut areas, &mut alphas);
            finite = finite + bad;
        }
        let mut lanes = [T::default(); LANES];
        finite.store(&mut lanes);
        lanes[..V::LANES].iter().all(|v| *v == T::default())
    }
}

/// Returns `sum` in lanes where all of `v` are finite, else NaN.
#[inline(always)]
#[expect(clippy::eq_op, reason = "v − v is 0 where v is finite and NaN elsewhere")]
fn not_finite<V: Vector>(v: &[V], mut sum: V) -> V {
    for &v in v {
        sum = sum + (v - v);
    }
    sum
}

impl<T: Real> Forward<'_, T> {
    /// Computes the children of one vector of parents; returns 0 in lanes where all numbers
    /// are finite, else NaN.
    #[inline(always)]
    fn group<V: Vector<Element = T>>(
        &mut self,
        (first, count): (usize, usize),
        areas: &mut [V],
        alphas: &mut [V],
    ) -> V {
        let Args { rules, source, parents, .. } = self.args;
        let (children, lanes) = (rules.children(), rules.gain_channels());
        let parent = Parent::load((rules, self.table, &source), parents, (first, count));
        let mut bad = not_finite(&[parent.alpha, parent.z], V::constant(0.0));
        let at = first - self.parents.start;
        for k in 0..children {
            let head = records(&self.args, (first, count), k);
            bad = not_finite(&head, bad);
            let child = Child::new(rules, &parent, k, &head);
            (areas[k], alphas[k]) = (child.area, head[HEAD_LOGIT_OFFSET]);
            let mut row = [V::constant(0.0); SPLAT_STRIDE];
            let shape = [(MEAN_OFFSET, child.mean), (SCALE_OFFSET, child.scale)];
            for (lane, v) in shape {
                row[lane..lane + 3].copy_from_slice(&v);
                bad = not_finite(&v, bad);
            }
            row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&child.quat());
            bad = not_finite(&child.quat(), bad);
            let rows = &mut self.rows[(at * children + k) * SPLAT_STRIDE..];
            V::store_rows(&row, RowLayout { stride: children * SPLAT_STRIDE, count }, rows);
            let gain = gain(rules, head[HEAD_GAIN_OFFSET]);
            let mut tile = [[T::default(); LANES]; 4];
            for (gain, tile) in gain.into_iter().zip(&mut tile) {
                gain.store(tile);
            }
            let gains = &mut self.gains[(at * children + k) * lanes..];
            for lane in 0..count {
                for (i, tile) in tile[..lanes].iter().enumerate() {
                    gains[lane * children * lanes + i] = tile[lane];
                }
            }
        }
        share(rules.opacity, areas, parent.alpha, parent.own, alphas);
        bad = not_finite(alphas, bad);
        for (k, &alpha) in alphas.iter().enumerate() {
            let mut tile = [T::default(); LANES];
            alpha.store(&mut tile);
            for (lane, &alpha) in tile[..count].iter().enumerate() {
                let row = (at + lane) * children + k;
                self.rows[row * SPLAT_STRIDE + OPACITY_OFFSET] = alpha;
            }
        }
        bad
    }
}

/// Computes γ and δ: γ(½ + Σ) = ½ + γΣ + (γ − 1)/2.
#[inline(always)]
fn gain<V: Vector>(rules: &Rules, raw: V) -> [V; 4] {
    let extra = V::constant(rules.delta) * raw.tanh();
    let residual = if rules.gain_space == GainSpace::Rgb {
        V::constant(0.5) * extra
    } else {
        V::constant(0.0)
    };
    [V::constant(1.0) + extra, residual, residual, residual]
}

/// Computes the children of N parents into `rows` `[N·K, 11]` and `gains` (module
/// documentation). Returns false if an input or output number is not finite: the children
/// of that parent are then undefined, those of all others correct.
pub fn forward<T: Real>(args: Args<T>, rows: &mut [T], gains: &mut [T]) -> bool {
    let table = Table::new(&args.source);
    let per_block = BLOCK * args.rules.children();
    rows.par_chunks_mut(per_block * SPLAT_STRIDE)
        .zip(gains.par_chunks_mut(per_block * args.rules.gain_channels()))
        .enumerate()
        .map(|(block, (rows, gains))| {
            let parents = args.block(block);
            T::dispatch(Forward { args, table: &table, parents, rows, gains })
        })
        .reduce(|| true, |a, b| a && b)
}
