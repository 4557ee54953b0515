//! Attention of parents over bilinear samples of the views' feature maps, fused without a
//! tensor of N × taps × E (SubSplat A.2).
//!
//! For parent n and group g, over the samples j = (view v, level ℓ, point m):
//! ```text
//! a_j = logit_scale · q·k_j + bias_j     k_j, u_j: bilinear key and value
//! p   = softmax_j(a)                     jointly over (v, ℓ, m); −∞ where masked
//! o   = Σ_j gate_v · p_j · u_j
//! ```
//! Bilinear sampling is linear, so q·k_j is a weighted sum of q·(tap row), and each
//! distinct tap row of a view and level is read once for the logits and once for
//! the output however many points share it (tap merging, exact).
//!
//! In: maps `[cells, stride]`, one row per cell holding key and value channels, level
//! after level, view after view within a level, row-major; query
//! `[N, Q]` = (q `[E]` where keys are used, bias `[V,L,M,G]`, gate `[V]`); points
//! `[N, V, M or L·M, 2]` in [0, 1]² of the picture.   Out: `[N, E]`.
//! Op: ops/attention_gather.rs. Tests: tests/network/attention_gather.rs.

mod backward;
mod narrow;

pub use crate::layout::{Drop, Gather, Level};
pub use backward::{Gradients, Scatter, backward, factors, scatter_into};

use super::simd::Real;
use super::simd::vectorize;
use crate::layout::random;
use rayon::prelude::*;

impl Gather {
    /// Factor of the weight of sample `j`, group `g` of parent `n` after dropping.
    #[inline(always)]
    fn kept<T: Real>(&self, n: usize, j: usize, g: usize) -> T {
        let Some(drop) = self.drop else { return T::constant(1.0) };
        let index = ((drop.first_parent + n) * self.samples() + j) * self.groups + g;
        let u = (bits(drop.seed ^ bits(index as u64)) >> 11) as f64 / (1u64 << 53) as f64;
        T::constant(if u < drop.probability { 0.0 } else { 1.0 / (1.0 - drop.probability) })
    }
}

/// Returns SplitMix64's first number of a seed.
fn bits(mut seed: u64) -> u64 {
    random::next(&mut seed)
}

/// Role of a sample in the softmax.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Not in the softmax.
    Masked,
    /// In the softmax with a value of zero.
    Blank,
    /// Sampled.
    Live,
}

/// One bilinear sample: up to four entries of the tap list.
#[derive(Clone, Copy, Debug)]
struct Sample<T> {
    state: State,
    /// (tap, weight, corner) of the corners inside the map; corner bits: x, y.
    corners: [(usize, T, u8); 4],
    count: usize,
    /// Fractions right of and below the first corner.
    fraction: (T, T),
}

/// Working memory of one thread.
struct Scratch<T> {
    samples: Vec<Sample<T>>,
    /// Cell of each tap; taps of one view and level are distinct.
    taps: Vec<usize>,
    /// `[taps, G]`: q·k.
    dots: Vec<T>,
    /// `[samples, G]`: logits, then softmax weights p.
    weights: Vec<T>,
    /// `[taps, G]`: factor of the tap's value row.
    coefficients: Vec<T>,
}

impl<T: Real> Scratch<T> {
    fn new() -> Self {
        Self {
            samples: Vec::new(),
            taps: Vec::new(),
            dots: Vec::new(),
            weights: Vec::new(),
            coefficients: Vec::new(),
        }
    }

    /// Taps and weights of all samples of the parent whose points are `points`.
    #[inline(always)]
    fn place(&mut self, g: &Gather, points: &[T]) {
        self.samples.clear();
        self.taps.clear();
        let per_view = g.points_width();
        for v in 0..g.views {
            for (l, level) in g.levels.iter().enumerate() {
                let first_tap = self.taps.len();
                let first_point = v * per_view + if g.points_per_level { l * g.points } else { 0 };
                let first_cell = level.first_cell + v * level.height * level.width;
                for m in 0..g.points {
                    let i = 2 * (first_point + m);
                    let at = (points[i], points[i + 1]);
                    let sample = self.sample(g, level, (first_cell, first_tap), at);
                    self.samples.push(sample);
                }
            }
        }
    }

    #[inline(always)]
    fn sample(
        &mut self,
        g: &Gather,
        level: &Level,
        (first_cell, first_tap): (usize, usize),
        (rx, ry): (T, T),
    ) -> Sample<T> {
        let zero = T::default();
        let one = T::constant(1.0);
        let mut s = Sample {
            state: State::Live,
            corners: [(0, zero, 0); 4],
            count: 0,
            fraction: (zero, zero),
        };
        if !(rx > zero && rx < one && ry > zero && ry < one) {
            s.state = if g.renormalise { State::Masked } else { State::Blank };
            return s;
        }
        let shift = T::constant(g.sample_convention.shift());
        let x = rx * T::constant(level.width as f64) - shift;
        let y = ry * T::constant(level.height as f64) - shift;
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        s.fraction = (fx, fy);
        // 0 < R < 1 bounds both by −1 and the map's size.
        let (x0, y0) = (x0.to_f64() as isize, y0.to_f64() as isize);
        for corner in 0..4u8 {
            let (right, below) = (corner & 1, corner >> 1);
            let (cx, cy) = (x0 + right as isize, y0 + below as isize);
            if cx < 0 || cy < 0 || cx >= level.width as isize || cy >= level.height as isize {
                continue;
            }
            let cell = first_cell + cy as usize * level.width + cx as usize;
            // The corners of a lone point are distinct.
            let known = match g.points {
                1 => None,
                _ => self.taps[first_tap..].iter().position(|&c| c == cell),
            };
            let tap = known.map_or(self.taps.len(), |i| first_tap + i);
            if known.is_none() {
                self.taps.push(cell);
            }
            let wx = if right == 1 { fx } else { one - fx };
            let wy = if below == 1 { fy } else { one - fy };
            s.corners[s.count] = (tap, wx * wy, corner);
            s.count += 1;
        }
        s
    }

    /// Logits and their softmax; false where every sample is masked.
    #[inline(always)]
    fn attend(&mut self, g: &Gather, maps: &[T], query: &[T]) -> bool {
        let (groups, width) = (g.groups, g.dim / g.groups);
        let (q, rest) = query.split_at(g.query_channels());
        if let Some(key) = g.key {
            self.dots.clear();
            // A closure would be compiled without the level's instructions.
            for &cell in &self.taps {
                let row = &maps[cell * g.stride + key..][..g.dim];
                for (k, q) in row.chunks_exact(width).zip(q.chunks_exact(width)) {
                    self.dots.push(dot(k, q));
                }
            }
        }
        let scale = T::constant(g.logit_scale);
        self.weights.clear();
        self.weights.extend_from_slice(&rest[..self.samples.len() * groups]);
        for (sample, logits) in self.samples.iter().zip(self.weights.chunks_exact_mut(groups)) {
            if sample.state == State::Masked {
                logits.fill(T::constant(f64::NEG_INFINITY));
            } else if g.key.is_some() {
                for &(tap, w, _) in &sample.corners[..sample.count] {
                    for (i, logit) in logits.iter_mut().enumerate() {
                        *logit += scale * w * self.dots[tap * groups + i];
                    }
                }
            }
        }
        if self.samples.iter().all(|s| s.state == State::Masked) {
            return false;
        }
        for i in 0..groups {
            let each = self.weights.iter().skip(i).step_by(groups);
            let top = each.copied().fold(T::constant(f64::NEG_INFINITY), T::max);
            let mut sum = T::default();
            for w in self.weights.iter_mut().skip(i).step_by(groups) {
                *w = (*w - top).exp();
                sum += *w;
            }
            let inverse = T::constant(1.0) / sum;
            self.weights.iter_mut().skip(i).step_by(groups).for_each(|w| *w *= inverse);
        }
        true
    }

    /// Factors of the taps' value rows.
    #[inline(always)]
    fn merge(&mut self, g: &Gather, n: usize, gates: &[T]) {
        let groups = g.groups;
        self.coefficients.clear();
        self.coefficients.resize(self.taps.len() * groups, T::default());
        let per_view = g.levels.len() * g.points;
        for (j, sample) in self.samples.iter().enumerate() {
            for i in 0..groups {
                let weight =
                    self.weights[j * groups + i] * gates[j / per_view] * g.kept::<T>(n, j, i);
                for &(tap, w, _) in &sample.corners[..sample.count] {
                    self.coefficients[tap * groups + i] += weight * w;
                }
            }
        }
    }
}

/// Dot product in sixteen partial sums, which a compiler turns into vectors.
#[inline(always)]
fn dot<T: Real>(a: &[T], b: &[T]) -> T {
    const LANES: usize = 16;
    let mut sums = [T::default(); LANES];
    let (a16, b16) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let tail: T = a16.remainder().iter().zip(b16.remainder()).map(|(&x, &y)| x * y).sum();
    for (x, y) in a16.zip(b16) {
        for i in 0..LANES {
            sums[i] += x[i] * y[i];
        }
    }
    sums.into_iter().sum::<T>() + tail
}

/// y += c·x.
#[inline(always)]
fn axpy<T: Real>(y: &mut [T], c: T, x: &[T]) {
    for (y, &x) in y.iter_mut().zip(x) {
        *y += c * x;
    }
}

/// Parents per rayon task.
const BLOCK: usize = 64;

/// [`forward`] in single precision, faster where the presets' shape allows it.
pub fn forward_f32(g: &Gather, maps: &[f32], query: &[f32], points: &[f32], out: &mut [f32]) {
    if narrow::suits(g) {
        narrow::forward(g, maps, query, points, out)
    } else {
        forward(g, maps, query, points, out)
    }
}

/// Attention output of N parents into `out` `[N, E]` (module doc).
pub fn forward<T: Real>(g: &Gather, maps: &[T], query: &[T], points: &[T], out: &mut [T]) {
    let q_width = g.query_width();
    let p_width = 2 * g.views * g.points_width();
    let width = g.dim / g.groups;
    out.par_chunks_mut(BLOCK * g.dim).enumerate().for_each_init(
        Scratch::new,
        |scratch, (block, out)| {
            vectorize(
                #[inline(always)]
                || {
                    for (i, out) in out.chunks_exact_mut(g.dim).enumerate() {
                        let n = block * BLOCK + i;
                        let query = &query[n * q_width..(n + 1) * q_width];
                        out.fill(T::default());
                        scratch.place(g, &points[n * p_width..(n + 1) * p_width]);
                        if !scratch.attend(g, maps, query) {
                            continue;
                        }
                        scratch.merge(g, n, &query[q_width - g.views..]);
                        let coefficients = scratch.coefficients.chunks_exact(g.groups);
                        for (&cell, coefficients) in scratch.taps.iter().zip(coefficients) {
                            let row = &maps[cell * g.stride + g.value..][..g.dim];
                            let groups = out.chunks_exact_mut(width).zip(row.chunks_exact(width));
                            for ((o, u), &c) in groups.zip(coefficients) {
                                axpy(o, c, u);
                            }
                        }
                    }
                },
            );
        },
    );
}

/// Depth map of one view for [`occlusion`].
#[derive(Clone, Copy, Debug)]
pub struct DepthMap<'a> {
    /// `[height, width]`, camera z, world units.
    pub z: &'a [f32],
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

/// Tolerance and softness of [`occlusion`], fractions of z.
pub const OCCLUSION_TOLERANCE: f32 = 0.02;

/// exp(−max(0, z − D(R) − τ)/τ′), τ = τ′ = 2 % of z: near 0 where the view's own
/// surface D hides a point of camera z `z` at picture position `at` in [0, 1]²; 1
/// where the point is outside the picture or behind the camera, since then there is
/// nothing to hide it. D is bilinear between pixel centres, held at the edges.
pub fn occlusion(map: DepthMap, at: [f32; 2], z: f32) -> f32 {
    let inside = z > 0.0 && at.iter().all(|&r| r > 0.0 && r < 1.0);
    if !inside {
        return 1.0;
    }
    let axis = |r: f32, n: usize| {
        let x = (r * n as f32 - 0.5).clamp(0.0, (n - 1) as f32);
        let i = (x as usize).min(n - 1);
        (i, (i + 1).min(n - 1), x - i as f32)
    };
    let (x0, x1, fx) = axis(at[0], map.width);
    let (y0, y1, fy) = axis(at[1], map.height);
    let row = |y: usize| {
        let row = &map.z[y * map.width..(y + 1) * map.width];
        row[x0] + fx * (row[x1] - row[x0])
    };
    let depth = row(y0) + fy * (row(y1) - row(y0));
    let excess = (z - depth - OCCLUSION_TOLERANCE * z).max(0.0);
    (-excess / (OCCLUSION_TOLERANCE * z)).exp()
}
