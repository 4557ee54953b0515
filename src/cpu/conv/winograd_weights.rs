//! ∂L/∂w of 3×3 convolutions of stride 1 by the adjoint of F(4×4, 3×3): 36 products
//! for each pair of channels and tile where the definition needs 144.
//!
//! With V = Bᵀ·x·B (lanes are tiles, as in [`super::winograd`]) and Z = A·∂y·Aᵀ (lanes
//! are output channels), ∂w = Gᵀ·(Σ over tiles of V⊙Z)·G.

use super::Buffers;
use super::plan::{Axes, Plan, pack};
use super::weights::{LANES_WIDE, ROWS, Tile, Work, turn};
use super::winograd::{PATCH, POINTS, TILE, transform};
use crate::cpu::simd::{Kernel, LANES, Simd};
use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};
use std::ops::Range;

/// Input channels of a job.
pub(super) const CHANNELS: usize = 64;
/// Vectors of tiles at once.
const VECTORS: usize = 4;
/// Floats past a packed patch's end that may be read and not used.
const SLACK: usize = LANES;

/// Outputs whose tiles make one block, for `plan`.
pub(super) fn tile(plan: &Plan) -> Axes {
    let [_, height, width] = plan.dst_size.map(|n| n.div_ceil(TILE));
    let across = width.min(LANES);
    [1, (VECTORS * LANES / across).clamp(1, height) * TILE, across * TILE]
}

/// Tiles of a job at least, since its products are to be transformed at the end.
const TILES: usize = 128;

/// Groups of `units` blocks of tiles that are summed apart.
pub(super) fn groups(plan: &Plan, units: usize, parts: usize, jobs: usize) -> usize {
    let [_, height, width] = tile(plan);
    let tiles = units * (height / TILE) * (width / TILE);
    jobs.div_ceil(parts).min(tiles / TILES).clamp(1, units)
}

/// Output channels in blocks of equal numbers of vectors.
fn blocks(outputs: &Range<usize>) -> Vec<Range<usize>> {
    let vectors = outputs.len().div_ceil(LANES);
    let size = vectors.div_ceil(vectors.div_ceil(LANES_WIDE / LANES).max(1)) * LANES;
    let starts = outputs.clone().step_by(size.max(LANES));
    starts.map(|first| first..(first + size).min(outputs.end)).collect()
}

/// Floats of a job's sums of products: for each block of output channels
/// `[point][channel][output]`.
pub(super) fn floats(work: &Work<'_>) -> usize {
    let channels = (work.rows / 9).next_multiple_of(ROWS);
    blocks(&work.outputs).iter().map(|b| POINTS * channels * b.len().next_multiple_of(LANES)).sum()
}

/// Adds one block of tiles to `products`.
pub(super) struct Products<'a, 'b> {
    pub work: &'a Work<'b>,
    /// The job's channels of one picture.
    pub x: &'a [f32],
    pub dy: &'a [f32],
    pub start: Axes,
    pub buffers: &'a mut Buffers,
    pub products: &'a mut [f32],
}

impl Kernel for Products<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (work, layout) = (self.work, self.work.layout);
        let inside = work.inside(self.start);
        let [_, down, across] = inside.map(|n| n.div_ceil(TILE));
        let (count, channels) = (down * across, work.rows / 9);
        let length = count.next_multiple_of(LANES);
        let point = channels * length + LANES;
        let Buffers { x: patch, y: turned, tiles, gradients, .. } = self.buffers;
        let patch = patch.room(layout.channel + SLACK);
        let tiles = tiles.room(POINTS * point);
        let pixels: usize = work.plan.src_size.iter().product();
        for (c, x) in self.x.chunks_exact(pixels).enumerate() {
            pack(work.plan, &layout, x, self.start, &mut patch[..layout.channel]);
            for first in (0..length).step_by(LANES) {
                let mut at = [0; LANES];
                for i in 0..LANES {
                    let t = (first + i).min(count - 1);
                    at[i] = (t / across * layout.pitch() + t % across) * TILE;
                }
                let points = transform(s, patch, &at, layout.pitch());
                for i in 0..POINTS {
                    let to = &mut tiles[i * point + c * length + first..];
                    if let Some(to) = to.first_chunk_mut() {
                        s.store(points[i], to);
                    }
                }
            }
        }
        let mut products = self.products;
        let rows = channels.next_multiple_of(ROWS);
        for outputs in blocks(&work.outputs) {
            let pitch = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at_mut(POINTS * rows * pitch);
            products = rest;
            let part = Work { outputs, pitch, ..*work };
            let gradients = gradients.room(POINTS * count * pitch);
            let turned = turned.room(TILE * across * TILE * pitch);
            for row in 0..down {
                if inside[1] - row * TILE < TILE || inside[2] < across * TILE {
                    turned.fill(0.0);
                }
                for r in 0..TILE.min(inside[1] - row * TILE) {
                    let to = &mut turned[r * across * TILE * pitch..][..inside[2] * pitch];
                    turn(s, &part, self.dy, (self.start, 0, row * TILE + r), [1, inside[2]], to);
                }
                spread(s, turned, [row * across, across, count], pitch, gradients);
            }
            for i in 0..POINTS {
                let tile = Tile {
                    x: &tiles[i * point..][..channels * length],
                    x_pitch: 0,
                    dy: &gradients[i * count * pitch..][..count * pitch],
                    pitch,
                    count: 1,
                    width: count,
                };
                let sums = own[i * rows * pitch..][..rows * pitch].chunks_exact_mut(ROWS * pitch);
                for (group, sums) in sums.enumerate() {
                    let mut offsets = [0; ROWS];
                    for m in 0..ROWS {
                        offsets[m] = (group * ROWS + m).min(channels - 1) * length;
                    }
                    tile.rows(s, &offsets, sums);
                }
            }
        }
    }
}

/// Z of one row of tiles from `[4 rows][4·across][pitch]` gradients, into
/// `[point][tile][pitch]`.
#[inline(always)]
fn spread<S: Simd>(
    s: S,
    dy: &[f32],
    [first, across, count]: [usize; 3],
    pitch: usize,
    out: &mut [f32],
) {
    for t in 0..across {
        for v in (0..pitch).step_by(LANES) {
            let mut rows = [[s.splat(0.0); PATCH]; TILE];
            for r in 0..TILE {
                let mut d = [s.splat(0.0); TILE];
                for q in 0..TILE {
                    let at = ((r * across + t) * TILE + q) * pitch + v;
                    if let Some(from) = dy[at..].first_chunk() {
                        d[q] = s.load(from);
                    }
                }
                rows[r] = spread_1d(s, d);
            }
            for j in 0..PATCH {
                let column = spread_1d(s, [rows[0][j], rows[1][j], rows[2][j], rows[3][j]]);
                for i in 0..PATCH {
                    let at = ((i * PATCH + j) * count + first + t) * pitch + v;
                    if let Some(to) = out[at..].first_chunk_mut() {
                        s.store(column[i], to);
                    }
                }
            }
        }
    }
}

/// A along one axis: the polynomial with these coefficients at the six points.
#[inline(always)]
fn spread_1d<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; PATCH] {
    let (half, two) = (s.splat(0.5), s.splat(2.0));
    let (even, odd) = (s.fma(half, d[2], d[0]), s.fma(half, d[3], d[1]));
    let root = s.splat(FRAC_1_SQRT_2);
    let (a, b) = (s.fma(root, odd, even), s.fnma(root, odd, even));
    let (even, odd) = (s.fma(two, d[2], d[0]), s.fma(two, d[3], d[1]));
    let root = s.splat(SQRT_2);
    [d[0], a, b, s.fma(root, odd, even), s.fnma(root, odd, even), d[3]]
}

/// Gᵀ along one axis.
#[inline(always)]
fn weights_1d<S: Simd>(s: S, q: [S::F; PATCH]) -> [S::F; 3] {
    let (near, far) = (q[1] + q[2], q[3] + q[4]);
    let (near_odd, far_odd) = (q[1] - q[2], q[3] - q[4]);
    let (two_thirds, sixth, third) = (s.splat(2.0 / 3.0), s.splat(1.0 / 6.0), s.splat(1.0 / 3.0));
    [
        s.fma(sixth, far, s.fnma(two_thirds, near, q[0])),
        s.fnma(s.splat(2.0 / 3.0 * FRAC_1_SQRT_2), near_odd, s.splat(1.0 / 6.0 * SQRT_2) * far_odd),
        s.fma(third, far - near, q[5]),
    ]
}

/// Turns a job's products into sums `[channel · 9 + tap][output]`.
pub(super) struct Finish<'a, 'b> {
    pub work: &'a Work<'b>,
    pub products: &'a [f32],
    pub sums: &'a mut [f32],
}

impl Kernel for Finish<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let channels = self.work.rows / 9;
        let rows = channels.next_multiple_of(ROWS);
        let total = self.work.outputs.len().next_multiple_of(LANES);
        let (mut products, mut column) = (self.products, 0);
        for outputs in blocks(&self.work.outputs) {
            let pitch = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at(POINTS * rows * pitch);
            products = rest;
            for c in 0..channels {
                for v in (0..pitch).step_by(LANES) {
                    let mut half = [[s.splat(0.0); 3]; PATCH];
                    for i in 0..PATCH {
                        let mut q = [s.splat(0.0); PATCH];
                        for j in 0..PATCH {
                            let at = ((i * PATCH + j) * rows + c) * pitch + v;
                            if let Some(from) = own[at..].first_chunk() {
                                q[j] = s.load(from);
                            }
                        }
                        half[i] = weights_1d(s, q);
                    }
                    for x in 0..3 {
                        let mut q = [s.splat(0.0); PATCH];
                        for i in 0..PATCH {
                            q[i] = half[i][x];
                        }
                        let g = weights_1d(s, q);
                        for y in 0..3 {
                            let at = (c * 9 + y * 3 + x) * total + column + v;
                            if let Some(to) = self.sums[at..].first_chunk_mut() {
                                s.store(g[y], to);
                            }
                        }
                    }
                }
            }
            column += pitch;
        }
    }
}
