//! 3×3 convolutions of stride 1 by F(4×4, 3×3) (Winograd 1980; Lavin and Gray 2016,
//! section 4): 36 products for 16 outputs where the definition needs 144.
//!
//! Interpolation points 0, ±1/√2, ±√2, ∞: on noise the error is half of that of the
//! usual 0, ±1, ±2, ∞. Lanes are tiles, in the transforms and in the products, which
//! are 36 matrix products over channels; one block's transformed tiles stay in the
//! second-level cache.

use super::Buffers;
use super::plan::{Axes, Layout, Plan, pack};
use super::shift::{Block, ROWS, Strip, blocks};
use crate::cpu::disjoint::Disjoint;
use crate::cpu::fresh;
use crate::cpu::simd::{Kernel, LANES, Simd, Tier};
use rayon::prelude::*;
use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};
use std::mem::MaybeUninit;

/// Outputs of a tile along an axis, and inputs that they read.
pub(super) const TILE: usize = 4;
pub(super) const PATCH: usize = 6;
/// Products of a tile.
pub(super) const POINTS: usize = PATCH * PATCH;
/// Most vectors of tiles at once.
const VECTORS: usize = 3;
/// Floats of the transformed tiles of a block, unless one vector needs more.
const FLOATS: usize = 300_000;
/// Least channels on both sides, and tiles of a picture, for which it wins.
const CHANNELS: usize = 24;
const TILES: usize = 48;
/// Floats past a packed patch's end that may be read and not used.
const SLACK: usize = LANES;

/// Whether `plan` can be, and had better be, run here.
pub(crate) fn suits(plan: &Plan) -> bool {
    let [_, height, width] = plan.dst_size;
    let plain = plan.passes.len() == 1 && plan.planes.len() == 1 && plan.src_step == [1; 3];
    plain
        && plan.kernel_taps == 9
        && plan.span == [0, 2, 2]
        && plan.src_channels.min(plan.dst_channels) >= CHANNELS
        && plan.dst_size[0] * height.div_ceil(TILE) * width.div_ceil(TILE) >= TILES
}

/// Transformed weights: for each block of output channels
/// `[point][source channel][channel of the block]`.
#[derive(Clone, Debug)]
pub(crate) struct Weights {
    data: Vec<f32>,
    blocks: Vec<Block>,
}

impl Weights {
    /// Of `w` as the caller stores them, in the memory of `data`.
    pub fn new(tier: Tier, plan: &Plan, w: &[f32], mut data: Vec<f32>) -> Self {
        let blocks = blocks(plan.dst_channels);
        let depth = plan.src_channels * POINTS;
        data.resize(blocks.iter().map(|b| b.pitch * depth).sum(), 0.0);
        data.par_chunks_mut(ROWS * depth)
            .zip(&blocks)
            .for_each(|(panel, block)| tier.run(Transform { plan, w, block, panel }));
        Self { data, blocks }
    }

    /// Its memory, for other weights.
    pub fn into_memory(self) -> Vec<f32> {
        self.data
    }
}

/// G·g·Gᵀ of the weights of one block.
struct Transform<'a> {
    plan: &'a Plan,
    w: &'a [f32],
    block: &'a Block,
    panel: &'a mut [f32],
}

impl Kernel for Transform<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { plan, w, block, panel } = self;
        let channels = plan.src_channels;
        for src in 0..channels {
            // By place in the patch, channels of the block innermost.
            let mut g = [[[0.0; ROWS]; 3]; 3];
            for m in 0..block.rows {
                let dst = block.first + m;
                let row = match plan.transposed {
                    true => src * plan.dst_channels + dst,
                    false => dst * channels + src,
                };
                let taps = &w[row * 9..][..9];
                for tap in &plan.passes[0].taps {
                    let [_, y, x] = tap.shift;
                    g[y][x][m] = taps[tap.kernel];
                }
            }
            let mut half = [[[0.0; ROWS]; 3]; PATCH];
            for x in 0..3 {
                let column = weights_1d([g[0][x], g[1][x], g[2][x]]);
                for i in 0..PATCH {
                    half[i][x] = column[i];
                }
            }
            for i in 0..PATCH {
                for (j, point) in weights_1d(half[i]).into_iter().enumerate() {
                    let at = ((i * PATCH + j) * channels + src) * block.pitch;
                    panel[at..at + block.pitch].copy_from_slice(&point[..block.pitch]);
                }
            }
        }
    }
}

/// G: value at each point of the polynomial with these coefficients, over the product
/// of the point's distances to the others.
#[inline(always)]
fn weights_1d(g: [[f32; ROWS]; 3]) -> [[f32; ROWS]; PATCH] {
    let mut out = [[0.0; ROWS]; PATCH];
    for m in 0..ROWS {
        let [g0, g1, g2] = [g[0][m], g[1][m], g[2][m]];
        // 2·½·(½ − 2) = −3/2 and 2·2·(2 − ½) = 6.
        let (even, odd) = ((g0 + 0.5 * g2) * (-2.0 / 3.0), g1 * (-2.0 / 3.0 * FRAC_1_SQRT_2));
        (out[1][m], out[2][m]) = (even + odd, even - odd);
        let (even, odd) = ((g0 + 2.0 * g2) * (1.0 / 6.0), g1 * (1.0 / 6.0 * SQRT_2));
        (out[3][m], out[4][m]) = (even + odd, even - odd);
        (out[0][m], out[5][m]) = (g0, g2);
    }
    out
}

/// Bᵀ along one axis.
#[inline(always)]
fn patch_1d<S: Simd>(s: S, x: [S::F; PATCH]) -> [S::F; PATCH] {
    let (half, two) = (s.splat(0.5), s.splat(2.0));
    let both = s.splat(2.5);
    let first = s.fnma(both, x[2], x[0] + x[4]);
    let last = s.fnma(both, x[3], x[1] + x[5]);
    let (even, odd) = (s.fnma(two, x[2], x[4]), s.fnma(two, x[1], x[3]));
    let root = s.splat(FRAC_1_SQRT_2);
    let (a, b) = (s.fma(root, odd, even), s.fnma(root, odd, even));
    let (even, odd) = (s.fnma(half, x[2], x[4]), s.fnma(half, x[1], x[3]));
    let root = s.splat(SQRT_2);
    [first, a, b, s.fma(root, odd, even), s.fnma(root, odd, even), last]
}

/// Aᵀ along one axis.
#[inline(always)]
fn outputs_1d<S: Simd>(s: S, y: [S::F; PATCH]) -> [S::F; TILE] {
    let (near, far) = (y[1] + y[2], y[3] + y[4]);
    let (near_odd, far_odd) = (y[1] - y[2], y[3] - y[4]);
    let near_odd = near_odd * s.splat(FRAC_1_SQRT_2);
    let far_odd = far_odd * s.splat(SQRT_2);
    let (half, two) = (s.splat(0.5), s.splat(2.0));
    [
        y[0] + near + far,
        near_odd + far_odd,
        s.fma(half, near, two * far),
        s.fma(half, near_odd, s.fma(two, far_odd, y[5])),
    ]
}

/// Runs `plan` on pictures `x` into `y`, which is overwritten; `bias` is empty or one
/// value a channel written.
pub(crate) fn run(
    tier: Tier,
    plan: &Plan,
    x: &[f32],
    w: &Weights,
    bias: &[f32],
    y: &mut fresh::Block<f32>,
) {
    let src: usize = plan.src_size.iter().product();
    let [depth, height, width] = plan.dst_size;
    let images = y.len() / (plan.dst_channels * depth * height * width);
    // Tiles of a block: rows of at most 16.
    let vectors = (FLOATS / (POINTS * LANES * plan.src_channels)).clamp(1, VECTORS);
    let across = width.div_ceil(TILE).min(LANES);
    let down = (vectors * LANES / across).clamp(1, height.div_ceil(TILE));
    let layout = plan.layout([1, down * TILE, across * TILE]);
    let starts = super::plan::starts(plan.grid(), layout.tile);
    let y = Disjoint::new(y);
    (0..images * starts.len()).into_par_iter().for_each(|job| {
        let (image, start) = (job / starts.len(), starts[job % starts.len()]);
        let x = &x[image * plan.src_channels * src..][..plan.src_channels * src];
        Buffers::with(|buffers| {
            tier.run(Job { plan, layout, x, w, bias, image, start, buffers, y: &y });
        });
    });
}

/// A block of tiles, all channels.
struct Job<'a> {
    plan: &'a Plan,
    layout: Layout,
    x: &'a [f32],
    w: &'a Weights,
    bias: &'a [f32],
    image: usize,
    start: Axes,
    buffers: &'a mut Buffers,
    y: &'a Disjoint<'a, MaybeUninit<f32>>,
}

impl Kernel for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (plan, layout) = (self.plan, self.layout);
        let Buffers { x: patch, tiles, products, .. } = self.buffers;
        let inside = |a: usize| layout.tile[a].min(plan.dst_size[a] - self.start[a]);
        let [down, across] = [inside(1), inside(2)].map(|n| n.div_ceil(TILE));
        let length = (down * across).next_multiple_of(LANES);
        // `tiles` is [point][channel][tile], `products` [point][channel of a block][tile].
        // Off a power of two, lest all points share one cache set.
        let point = plan.src_channels * length + LANES;
        let patch = patch.room(layout.channel + SLACK);
        let tiles = tiles.room(POINTS * point);
        let products = products.room(POINTS * ROWS * length);
        let pixels: usize = plan.src_size.iter().product();
        for (c, x) in self.x.chunks_exact(pixels).enumerate() {
            pack(plan, &layout, x, self.start, &mut patch[..layout.channel]);
            for first in (0..length).step_by(LANES) {
                let mut at = [0; LANES];
                for i in 0..LANES {
                    let t = (first + i).min(down * across - 1);
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
        let depth = plan.src_channels * POINTS;
        for (index, block) in self.w.blocks.iter().enumerate() {
            let panel = &self.w.data[index * ROWS * depth..][..block.pitch * depth];
            for (i, w) in panel.chunks_exact(block.pitch * plan.src_channels).enumerate() {
                let strip = Strip {
                    x: &tiles[i * point..][..plan.src_channels * length],
                    channel: length,
                    channels: plan.src_channels,
                    offsets: &[0],
                    w,
                    bias: [0.0; ROWS],
                    length,
                };
                strip.run(s, block.pitch, &mut products[i * ROWS * length..][..ROWS * length]);
            }
            for m in 0..block.rows {
                let channel = block.first + m;
                let bias = self.bias.get(channel).copied().unwrap_or(0.0);
                for first in (0..length).step_by(LANES) {
                    let mut out = [[0.0; LANES]; LANES];
                    outputs(s, &products[m * length + first..], ROWS * length, bias, &mut out);
                    let count = LANES.min(down * across - first);
                    for (i, out) in out.iter().enumerate().take(count) {
                        let t = first + i;
                        let place = [t / across, t % across].map(|v| v * TILE);
                        write(plan, self.y, self.image, channel, self.start, place, out);
                    }
                }
            }
        }
    }
}

/// Transformed patches at sixteen places of a packed channel.
#[inline(always)]
pub(super) fn transform<S: Simd>(
    s: S,
    x: &[f32],
    at: &[usize; LANES],
    pitch: usize,
) -> [S::F; POINTS] {
    let mut points = [s.splat(0.0); POINTS];
    for r in 0..PATCH {
        let [a, b, c, d] = s.load4(x, at, r * pitch);
        let [e, f, _, _] = s.load4(x, at, r * pitch + TILE);
        let row = patch_1d(s, [a, b, c, d, e, f]);
        for j in 0..PATCH {
            points[r * PATCH + j] = row[j];
        }
    }
    for j in 0..PATCH {
        let mut column = [s.splat(0.0); PATCH];
        for i in 0..PATCH {
            column[i] = points[i * PATCH + j];
        }
        let column = patch_1d(s, column);
        for i in 0..PATCH {
            points[i * PATCH + j] = column[i];
        }
    }
    points
}

/// Sixteen tiles of 4×4 outputs from their products, which lie `pitch` apart.
#[inline(always)]
fn outputs<S: Simd>(
    s: S,
    products: &[f32],
    pitch: usize,
    bias: f32,
    out: &mut [[f32; LANES]; LANES],
) {
    let mut rows = [[s.splat(0.0); PATCH]; TILE];
    for j in 0..PATCH {
        let mut column = [s.splat(0.0); PATCH];
        for i in 0..PATCH {
            if let Some(v) = products[(i * PATCH + j) * pitch..].first_chunk() {
                column[i] = s.load(v);
            }
        }
        let column = outputs_1d(s, column);
        for i in 0..TILE {
            rows[i][j] = column[i];
        }
    }
    let bias = s.splat(bias);
    let mut tiles = [s.splat(0.0); LANES];
    for i in 0..TILE {
        let row = outputs_1d(s, rows[i]);
        for j in 0..TILE {
            tiles[i * TILE + j] = row[j] + bias;
        }
    }
    let tiles = s.transpose(tiles);
    for i in 0..LANES {
        s.store(tiles[i], &mut out[i]);
    }
}

/// Copies one tile, `place` pixels from the block's corner `start`, to y; what lies
/// beyond its border is dropped.
#[inline(always)]
fn write(
    plan: &Plan,
    y: &Disjoint<'_, MaybeUninit<f32>>,
    image: usize,
    channel: usize,
    start: Axes,
    place: [usize; 2],
    tile: &[f32; LANES],
) {
    let [depth, height, width] = plan.dst_size;
    let (top, left) = (start[1] + place[0], start[2] + place[1]);
    let plane = ((image * plan.dst_channels + channel) * depth + start[0]) * height;
    for (r, row) in tile.as_chunks::<TILE>().0.iter().enumerate() {
        if top + r >= height || left >= width {
            break;
        }
        let at = (plane + top + r) * width + left;
        let columns = TILE.min(width - left);
        // SAFETY: no two jobs, and no two tiles of a job, hold the same outputs.
        let to = unsafe { y.part(at..at + columns) };
        match to.first_chunk_mut::<TILE>() {
            Some(to) => *to = row.map(MaybeUninit::new),
            None => to.iter_mut().zip(row).for_each(|(to, v)| *to = MaybeUninit::new(*v)),
        }
    }
}
