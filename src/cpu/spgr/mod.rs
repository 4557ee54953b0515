//! Sub-pixel Gaussian reparameterization, one pass per parent and no temporary in
//! memory (SubSplat 3.2, supp. A.3; spec 2.9b).
//!
//! In: head records `[N, K, 11]` and parents `[N, 11]` (lanes in [`crate::abi`]),
//! cameras of the V context views.   Out: children `[N·K, 11]`, child k of parent n
//! at row n·K + k, and their colour gain `[N·K]` or, in RGB, `[N·K, 4]` (γ, δ).
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
//! and opacities by [`super::redistribute`]. `backward` recomputes all of it from the
//! same inputs; no gradient passes the choice of v*, the growth of small footprints
//! and the share of a disc step. `project` goes on to 2-D splats of one camera without
//! writing children.
//!
//! The lanes of a vector are parents: child k of 16 parents at a time, so that sums
//! over children are loops and any K fills the vector. Twin: ops/spgr.rs. The same in
//! tensor operations: model/spgr_ref.rs. Tests: tests/spgr.rs, tests/spgr_backward.rs.

mod backward;
mod child;
mod colour;
mod parent;
mod project;
mod shape;
mod view;

pub use crate::abi::{CHILDREN_MAX, Rules};
pub use backward::{backward, gains_backward};
pub use project::{Target, project};

use super::lanes::{Kernel, LaneReal, Lanes, Machine, WIDTH_MAX};
use super::redistribute::share;
use crate::abi::{
    HEAD_GAIN_OFFSET, HEAD_LOGIT_OFFSET, HEAD_STRIDE, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET,
    SCALE_OFFSET, SPLAT_STRIDE,
};
use crate::camera::Camera;
use child::Child;
use parent::Parent;
use rayon::prelude::*;
use view::Table;

/// Which parents, seen by which cameras.
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
    /// How children are made; K ≤ [`CHILDREN_MAX`].
    pub rules: &'a Rules,
    /// Of which parents, seen by which cameras.
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

/// Head records of child `k` of `count` parents from `first` on.
#[inline(always)]
fn records<M: Machine>(
    m: M,
    args: &Args<M::Scalar>,
    (first, count): (usize, usize),
    k: usize,
) -> [M::V; HEAD_STRIDE] {
    let children = args.rules.children();
    let from = &args.head[(first * children + k) * HEAD_STRIDE..];
    m.load_rows(from, (children * HEAD_STRIDE, count))
}

/// One block of parents forward; `rows` and `gains` are the block's own.
struct Forward<'a, T> {
    args: Args<'a, T>,
    table: &'a Table<T>,
    parents: std::ops::Range<usize>,
    rows: &'a mut [T],
    gains: &'a mut [T],
}

impl<T: LaneReal> Kernel<T> for Forward<'_, T> {
    type Output = bool;
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(mut self, m: M) -> bool {
        let k = self.args.rules.children();
        let (mut areas, mut alphas) = (vec![m.of(0.0); k], vec![m.of(0.0); k]);
        // x − x is 0 for a finite number and NaN for any other.
        let mut finite = m.of(0.0);
        for first in self.parents.clone().step_by(M::WIDTH) {
            let span = (first, M::WIDTH.min(self.parents.end - first));
            let bad = self.group(m, span, &mut areas, &mut alphas);
            finite = finite + bad;
        }
        let mut lanes = [T::default(); WIDTH_MAX];
        m.store(finite, &mut lanes);
        lanes[..M::WIDTH].iter().all(|v| *v == T::default())
    }
}

/// 0 where all of `v` are finite, else NaN.
#[inline(always)]
#[expect(clippy::eq_op, reason = "v − v is 0 where v is finite and NaN elsewhere")]
fn not_finite<V: Lanes>(v: &[V], mut sum: V) -> V {
    for &v in v {
        sum = sum + (v - v);
    }
    sum
}

impl<T: LaneReal> Forward<'_, T> {
    /// The children of one vector of parents; 0 where all is finite, else NaN.
    #[inline(always)]
    fn group<M: Machine<Scalar = T>>(
        &mut self,
        m: M,
        (first, count): (usize, usize),
        areas: &mut [M::V],
        alphas: &mut [M::V],
    ) -> M::V {
        let Args { rules, source, parents, .. } = self.args;
        let (children, lanes) = (rules.children(), rules.gain_lanes());
        let parent = Parent::load(m, (rules, self.table, &source), parents, (first, count));
        let mut bad = not_finite(&[parent.alpha, parent.z], m.of(0.0));
        let at = first - self.parents.start;
        for k in 0..children {
            let head = records(m, &self.args, (first, count), k);
            bad = not_finite(&head, bad);
            let child = Child::new(rules, &parent, k, &head);
            (areas[k], alphas[k]) = (child.area, head[HEAD_LOGIT_OFFSET]);
            let mut row = [m.of(0.0); SPLAT_STRIDE];
            let shape = [(MEAN_OFFSET, child.mean), (SCALE_OFFSET, child.scale)];
            for (lane, v) in shape {
                row[lane..lane + 3].copy_from_slice(&v);
                bad = not_finite(&v, bad);
            }
            row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&child.quat());
            bad = not_finite(&child.quat(), bad);
            let rows = &mut self.rows[(at * children + k) * SPLAT_STRIDE..];
            m.store_rows(&row, (children * SPLAT_STRIDE, count), rows);
            let gain = gain(m, rules, head[HEAD_GAIN_OFFSET]);
            let mut tile = [[T::default(); WIDTH_MAX]; 4];
            for (gain, tile) in gain.into_iter().zip(&mut tile) {
                m.store(gain, tile);
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
            let mut tile = [T::default(); WIDTH_MAX];
            m.store(alpha, &mut tile);
            for (lane, &alpha) in tile[..count].iter().enumerate() {
                let row = (at + lane) * children + k;
                self.rows[row * SPLAT_STRIDE + OPACITY_OFFSET] = alpha;
            }
        }
        bad
    }
}

/// γ and δ: γ(½ + Σ) = ½ + γΣ + (γ − 1)/2.
#[inline(always)]
fn gain<M: Machine>(m: M, rules: &Rules, raw: M::V) -> [M::V; 4] {
    let extra = m.of(rules.delta) * raw.tanh();
    let residual = if rules.rgb_gain { m.of(0.5) * extra } else { m.of(0.0) };
    [m.of(1.0) + extra, residual, residual, residual]
}

/// Children of N parents into `rows` `[N·K, 11]` and `gains` (module doc). False if a
/// number that came in or went out is not finite; its parent's children are then
/// whatever they are, those of all others right.
pub fn forward<T: LaneReal>(args: Args<T>, rows: &mut [T], gains: &mut [T]) -> bool {
    let table = Table::new(&args.source);
    let per_block = BLOCK * args.rules.children();
    rows.par_chunks_mut(per_block * SPLAT_STRIDE)
        .zip(gains.par_chunks_mut(per_block * args.rules.gain_lanes()))
        .enumerate()
        .map(|(block, (rows, gains))| {
            let parents = args.block(block);
            T::dispatch(Forward { args, table: &table, parents, rows, gains })
        })
        .reduce(|| true, |a, b| a && b)
}
