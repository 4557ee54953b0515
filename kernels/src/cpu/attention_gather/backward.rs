//! Gradients of the fused attention with respect to maps, query and points.
//!
//! Two passes. Per parent, in parallel: everything but the maps, and a short list
//! of (cell, factor of q, factor of ∂o) for the maps. Then per block of channels, in
//! parallel over blocks and in parent order within one: the scatter. No two threads
//! write one float, and the sums' order does not depend on the number of threads.

use super::{BLOCK, Gather, Scratch, State, axpy, dot};
use crate::cpu::simd::Real;
use crate::cpu::simd::vectorize;
use rayon::prelude::*;

/// Gradients of the fused attention.
pub struct Gradients<T> {
    /// `[cells, stride]`.
    pub maps: Vec<T>,
    /// `[N, Q]`.
    pub query: Vec<T>,
    /// `[N, V, M or L·M, 2]`; zeros where [`Gather::point_gradient`] is off.
    pub points: Vec<T>,
}

/// The maps' gradient as factors of a block of parents: products and their cells.
#[derive(Clone, Debug, Default)]
pub struct Scatter<T> {
    /// Parent and cell of each tap.
    taps: Vec<(usize, usize)>,
    /// `[taps, G]`: factor of q in the key channels.
    keys: Vec<T>,
    /// `[taps, G]`: factor of ∂o in the value channels.
    values: Vec<T>,
}

impl<T> Scatter<T> {
    /// Cells that are added to, each once for every parent that samples it.
    pub fn cells(&self) -> impl Iterator<Item = usize> {
        self.taps.iter().map(|&(_, cell)| cell)
    }
}

/// The forward pass' arguments and the gradient `[N, E]` of its result.
#[derive(Clone, Copy)]
struct Args<'a, T> {
    g: &'a Gather,
    maps: &'a [T],
    query: &'a [T],
    points: &'a [T],
    grad: &'a [T],
}

/// Gradients of [`super::forward`] for the gradient `grad` `[N, E]` of its result.
pub fn backward<T: Real>(
    g: &Gather,
    maps: &[T],
    query: &[T],
    points: &[T],
    grad: &[T],
) -> Gradients<T> {
    let (scatters, d_query, d_points) = factors(g, maps, query, points, grad);
    let args = Args { g, maps, query, points, grad };
    Gradients { maps: args.scatter(&scatters), query: d_query, points: d_points }
}

/// [`backward`] with the maps' gradient as factors, for [`scatter_into`]; gradients of
/// query and points beside it.
pub fn factors<T: Real>(
    g: &Gather,
    maps: &[T],
    query: &[T],
    points: &[T],
    grad: &[T],
) -> (Vec<Scatter<T>>, Vec<T>, Vec<T>) {
    let args = Args { g, maps, query, points, grad };
    let mut d_query = vec![T::default(); query.len()];
    let mut d_points = vec![T::default(); points.len()];
    let q_width = g.query_width();
    let p_width = 2 * g.views * g.points_width();
    let scatters: Vec<Scatter<T>> = d_query
        .par_chunks_mut(BLOCK * q_width)
        .zip(d_points.par_chunks_mut(BLOCK * p_width))
        .enumerate()
        .map_init(Scratch::new, |scratch, (block, (d_query, d_points))| {
            let mut out = Scatter::default();
            let rows = d_query.chunks_exact_mut(q_width).zip(d_points.chunks_exact_mut(p_width));
            vectorize(
                #[inline(always)]
                || {
                    for (i, (d_query, d_points)) in rows.enumerate() {
                        args.parent(scratch, block * BLOCK + i, (d_query, d_points), &mut out);
                    }
                },
            );
            out
        })
        .collect();
    (scatters, d_query, d_points)
}

/// Adds `scatters` of the call with `query` and `grad` to `maps` `[cells, stride]`, on the
/// caller's thread, in the order of parents. Cells that no parent samples are not touched: with
/// few parents and many cells, most of them.
pub fn scatter_into<T: Real>(
    g: &Gather,
    scatters: &[Scatter<T>],
    (query, grad): (&[T], &[T]),
    maps: &mut [T],
) {
    let width = g.dim / g.groups;
    let q_width = g.query_width();
    let add = |row: &mut [T], factors: &[T], from: &[T]| {
        for (i, &factor) in factors.iter().enumerate() {
            let span = i * width..(i + 1) * width;
            axpy(&mut row[span.clone()], factor, &from[span]);
        }
    };
    vectorize(
        #[inline(always)]
        || {
            for scatter in scatters {
                let values = scatter.values.chunks_exact(g.groups);
                let mut keys = scatter.keys.chunks_exact(g.groups);
                for (&(n, cell), values) in scatter.taps.iter().zip(values) {
                    let row = &mut maps[cell * g.stride..(cell + 1) * g.stride];
                    add(&mut row[g.value..], values, &grad[n * g.dim..(n + 1) * g.dim]);
                    if let (Some(key), Some(keys)) = (g.key, keys.next()) {
                        let query = &query[n * q_width..][..g.dim];
                        add(&mut row[key..], keys, query);
                    }
                }
            }
        },
    );
}

impl<T: Real> Args<'_, T> {
    /// Gradients of parent `n` into its rows, and its part of the maps' gradient.
    #[inline(always)]
    fn parent(
        self,
        scratch: &mut Scratch<T>,
        n: usize,
        (d_query, d_points): (&mut [T], &mut [T]),
        out: &mut Scatter<T>,
    ) {
        let g = self.g;
        let q_width = g.query_width();
        let p_width = 2 * g.views * g.points_width();
        let query = &self.query[n * q_width..(n + 1) * q_width];
        let grad = &self.grad[n * g.dim..(n + 1) * g.dim];
        scratch.place(g, &self.points[n * p_width..(n + 1) * p_width]);
        if !scratch.attend(g, self.maps, query) {
            return;
        }
        scratch.merge(g, n, &query[q_width - g.views..]);
        let width = g.dim / g.groups;
        // ∂o·u of every tap.
        let mut along = Vec::with_capacity(scratch.taps.len() * g.groups);
        for &cell in &scratch.taps {
            let row = &self.maps[cell * g.stride + g.value..][..g.dim];
            along.extend(
                row.chunks_exact(width).zip(grad.chunks_exact(width)).map(|(u, o)| dot(u, o)),
            );
        }
        let (d_q, d_rest) = d_query.split_at_mut(g.query_channels());
        let (d_bias, d_gates) = d_rest.split_at_mut(g.samples() * g.groups);
        self.softmax(scratch, n, &along, (d_bias, d_gates));
        if g.point_gradient {
            self.points(scratch, n, &along, (d_bias, d_points));
        }
        let keys = self.keys(scratch, d_bias, d_q);
        out.taps.extend(scratch.taps.iter().map(|&cell| (n, cell)));
        out.keys.extend(keys);
        out.values.extend_from_slice(&scratch.coefficients);
    }

    /// ∂logits and ∂gates.
    #[inline(always)]
    fn softmax(
        self,
        scratch: &Scratch<T>,
        n: usize,
        along: &[T],
        (d_logits, d_gates): (&mut [T], &mut [T]),
    ) {
        let g = self.g;
        let per_view = g.levels.len() * g.points;
        let gates = &self.query[(n + 1) * g.query_width() - g.views..(n + 1) * g.query_width()];
        for i in 0..g.groups {
            let mut mean = T::default();
            for (j, sample) in scratch.samples.iter().enumerate() {
                let corners = &sample.corners[..sample.count];
                let value: T = corners.iter().map(|&(t, w, _)| w * along[t * g.groups + i]).sum();
                let p = scratch.weights[j * g.groups + i];
                let v = j / per_view;
                let kept: T = g.kept(n, j, i);
                d_gates[v] += p * kept * value;
                let d_p = gates[v] * kept * value;
                d_logits[j * g.groups + i] = d_p;
                mean += p * d_p;
            }
            for (j, d) in d_logits.iter_mut().skip(i).step_by(g.groups).enumerate() {
                *d = scratch.weights[j * g.groups + i] * (*d - mean);
            }
        }
    }

    /// ∂points through the bilinear weights; call after `softmax`.
    #[inline(always)]
    fn points(
        self,
        scratch: &Scratch<T>,
        n: usize,
        along: &[T],
        (d_logits, d_points): (&[T], &mut [T]),
    ) {
        let g = self.g;
        let one = T::constant(1.0);
        let levels = g.levels.len();
        let scale = T::constant(g.logit_scale);
        let gates = &self.query[(n + 1) * g.query_width() - g.views..(n + 1) * g.query_width()];
        for (j, sample) in scratch.samples.iter().enumerate() {
            if sample.state != State::Live {
                continue;
            }
            let v = j / (levels * g.points);
            let l = j / g.points % levels;
            let m = j % g.points;
            let (fx, fy) = sample.fraction;
            let (mut dx, mut dy) = (T::default(), T::default());
            for &(tap, _, corner) in &sample.corners[..sample.count] {
                let mut d_w = T::default();
                for i in 0..g.groups {
                    let (ji, ti) = (j * g.groups + i, tap * g.groups + i);
                    let weight = scratch.weights[ji] * gates[v] * g.kept::<T>(n, j, i);
                    d_w += weight * along[ti];
                    if g.key.is_some() {
                        d_w += d_logits[ji] * scale * scratch.dots[ti];
                    }
                }
                let right = corner & 1 == 1;
                let below = corner >> 1 == 1;
                let (wx, sx) = if right { (fx, one) } else { (one - fx, -one) };
                let (wy, sy) = if below { (fy, one) } else { (one - fy, -one) };
                dx += d_w * sx * wy;
                dy += d_w * sy * wx;
            }
            let own = if g.points_per_level { l * g.points } else { 0 };
            let at = 2 * (v * g.points_width() + own + m);
            d_points[at] += dx * T::constant(g.levels[l].width as f64);
            d_points[at + 1] += dy * T::constant(g.levels[l].height as f64);
        }
    }

    /// ∂q, and the factors of q in the gradient of each tap's key row.
    #[inline(always)]
    fn keys(self, scratch: &Scratch<T>, d_logits: &[T], d_q: &mut [T]) -> Vec<T> {
        let g = self.g;
        let mut factors = vec![T::default(); scratch.taps.len() * g.groups];
        let Some(key) = g.key else { return factors };
        let scale = T::constant(g.logit_scale);
        for (sample, d) in scratch.samples.iter().zip(d_logits.chunks_exact(g.groups)) {
            for &(tap, w, _) in &sample.corners[..sample.count] {
                for (i, &d) in d.iter().enumerate() {
                    factors[tap * g.groups + i] += d * scale * w;
                }
            }
        }
        let width = g.dim / g.groups;
        for (&cell, factors) in scratch.taps.iter().zip(factors.chunks_exact(g.groups)) {
            let row = &self.maps[cell * g.stride + key..][..g.dim];
            let groups = d_q.chunks_exact_mut(width).zip(row.chunks_exact(width));
            for ((d, k), &c) in groups.zip(factors) {
                axpy(d, c, k);
            }
        }
        factors
    }

    /// ∂maps `[cells, stride]`.
    fn scatter(self, scatters: &[Scatter<T>]) -> Vec<T> {
        let g = self.g;
        let cells = self.maps.len() / g.stride;
        let width = g.dim / g.groups;
        // Channels per task: within one group, as many as leave every thread a task, at
        // least two cache lines of f32. The sums do not depend on it.
        let most = (g.stride / rayon::current_num_threads().max(1)).max(32).min(width);
        let lanes = (1..=most).rev().find(|b| width.is_multiple_of(*b)).unwrap_or(1);
        let blocks: Vec<Vec<T>> = (0..g.stride / lanes)
            .into_par_iter()
            .map(|block| {
                let mut sums = vec![T::default(); cells * lanes];
                if let Some(key) = g.key {
                    let q_width = g.query_width();
                    let source = |n: usize| &self.query[n * q_width..][..g.dim];
                    add(&mut sums, scatters, (block * lanes, key, lanes), g, |s| &s.keys, source);
                }
                let source = |n: usize| &self.grad[n * g.dim..][..g.dim];
                add(&mut sums, scatters, (block * lanes, g.value, lanes), g, |s| &s.values, source);
                sums
            })
            .collect();
        let mut maps = vec![T::default(); self.maps.len()];
        maps.par_chunks_mut(g.stride).enumerate().for_each(|(cell, row)| {
            for (row, block) in row.chunks_exact_mut(lanes).zip(&blocks) {
                row.copy_from_slice(&block[cell * lanes..(cell + 1) * lanes]);
            }
        });
        maps
    }
}

/// Adds factor · source to the rows of the cells in `sums` `[cells, lanes]`, where
/// `(first, start, lanes)` gives the channels of a map's row that `sums` holds, and the
/// place of the source's channel 0 in it.
fn add<'a, T: Real>(
    sums: &mut [T],
    scatters: &'a [Scatter<T>],
    (first, start, lanes): (usize, usize, usize),
    g: &Gather,
    factors: impl Fn(&'a Scatter<T>) -> &'a Vec<T>,
    source: impl Fn(usize) -> &'a [T],
) {
    if first < start || first >= start + g.dim {
        return;
    }
    let channel = first - start;
    let group = channel / (g.dim / g.groups);
    vectorize(
        #[inline(always)]
        || {
            for scatter in scatters {
                let factors = factors(scatter).chunks_exact(g.groups);
                for (&(n, cell), factors) in scatter.taps.iter().zip(factors) {
                    let row = &mut sums[cell * lanes..(cell + 1) * lanes];
                    axpy(row, factors[group], &source(n)[channel..channel + lanes]);
                }
            }
        },
    );
}
