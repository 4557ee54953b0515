//! Packed tiles: a part of an image copied with its halo and its zero padding.
//!
//! A packed tile is `[channel][plane][depth][row][column]`, one plane per source phase of
//! the [`Plan`]. A tap reads it at a constant offset from an output's own place, so vectors
//! run over flat places whatever the width of the rows. Values that they compute in the
//! columns of the halo are not written out.

use super::plan::{Plan, Tap};
use super::sizes::Axes;
use crate::cpu::simd::{Kernel, LANES, Simd};
use std::mem::MaybeUninit;

/// Floats of a cache line.
const CACHE_LINE: usize = 16;
/// Maximum floats of a packed tile: a quarter of a 2 MiB second-level cache.
const MAX_TILE_FLOATS: usize = 128 << 10;
/// Maximum grid positions of one depth of a tile.
const MAX_TILE_POSITIONS: usize = 2048;
/// Maximum grid positions of one row of a tile.
const MAX_TILE_COLUMNS: usize = 128;
/// Maximum depths of a tile.
const MAX_TILE_DEPTHS: usize = 16;
/// Tiles of at most this many positions are not cut further to obtain more jobs.
const MIN_TILE_POSITIONS: usize = 192;

/// Memory layout of a packed tile. Strides are floats.
#[derive(Clone, Copy, Debug)]
pub(super) struct TileLayout {
    /// Grid positions of the tile.
    pub tile: Axes,
    /// Grid positions with the halo.
    pub padded: Axes,
    /// From plane to plane.
    pub plane_stride: usize,
    /// From channel to channel.
    pub channel_stride: usize,
}

impl TileLayout {
    /// Lays out a tile of `tile` grid positions.
    pub fn new(plan: &Plan, tile: Axes) -> Self {
        let padded: Axes = std::array::from_fn(|a| tile[a] + plan.span[a]);
        let plane_stride = padded[0] * padded[1] * padded[2];
        // An odd number of cache lines spreads channels over all sets of the cache.
        let floats = plan.planes.len() * plane_stride;
        let channel_stride = floats.next_multiple_of(CACHE_LINE) | CACHE_LINE;
        Self { tile, padded, plane_stride, channel_stride }
    }

    /// Returns the distance of rows.
    pub fn row_stride(&self) -> usize {
        self.padded[2]
    }

    /// Returns the distance of depths.
    pub fn depth_stride(&self) -> usize {
        self.padded[1] * self.padded[2]
    }

    /// Returns the flat places from the first to the last output of one depth.
    pub fn places_per_depth(&self) -> usize {
        (self.tile[1] - 1) * self.row_stride() + self.tile[2]
    }

    /// Returns the offset at which a tap reads, relative to an output's own place.
    pub fn offset(&self, tap: &Tap) -> usize {
        let [d, h, w] = tap.shift;
        tap.plane * self.plane_stride + d * self.depth_stride() + h * self.row_stride() + w
    }
}

/// Chooses the tile size for `images` images, `channels` channels of which are packed at
/// once, with at least `jobs` tiles where possible. The result depends on sizes only, so
/// that the order of summation does not depend on the number of threads.
pub(super) fn tile_size(plan: &Plan, channels: usize, images: usize, jobs: usize) -> Axes {
    let grid = plan.grid();
    let mut tile = [1, 1, even_part(grid[2], MAX_TILE_COLUMNS)];
    let fits = |tile: Axes| {
        channels * TileLayout::new(plan, tile).channel_stride <= MAX_TILE_FLOATS
            && tile[1] * tile[2] <= MAX_TILE_POSITIONS
    };
    while tile[1] < grid[1] && fits([1, tile[1] + 1, tile[2]]) {
        tile[1] += 1;
    }
    while tile[1] == grid[1]
        && tile[0] < grid[0].min(MAX_TILE_DEPTHS)
        && fits([tile[0] + 1, tile[1], tile[2]])
    {
        tile[0] += 1;
    }
    let count = |tile: Axes| (0..3).map(|a| grid[a].div_ceil(tile[a])).product::<usize>();
    while images * count(tile) < jobs && tile[0] > 1 {
        tile[0] = tile[0].div_ceil(2);
    }
    while images * count(tile) < jobs && tile[1] > 1 && tile[1] * tile[2] > MIN_TILE_POSITIONS {
        tile[1] = tile[1].div_ceil(2);
    }
    std::array::from_fn(|a| even_part(grid[a], tile[a]))
}

/// Returns the size of one part when `n` is cut into equal parts of at most `max`.
fn even_part(n: usize, max: usize) -> usize {
    n.div_ceil(n.div_ceil(max.max(1)).max(1)).max(1)
}

/// Returns the first grid positions of all tiles, in order.
pub(super) fn tile_starts(grid: Axes, tile: Axes) -> Vec<Axes> {
    let mut out = Vec::new();
    for d in (0..grid[0]).step_by(tile[0]) {
        for h in (0..grid[1]).step_by(tile[1]) {
            for w in (0..grid[2]).step_by(tile[2]) {
                out.push([d, h, w]);
            }
        }
    }
    out
}

/// Copies one tile of one image into a packed tile.
pub(super) struct PackTile<'a> {
    pub plan: &'a Plan,
    pub layout: &'a TileLayout,
    /// Channels of one image.
    pub x: &'a [f32],
    /// First grid position of the tile.
    pub start: Axes,
    pub out: &'a mut [f32],
}

impl Kernel for PackTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { plan, layout, x, start, out } = self;
        let [_, height, width] = plan.src_size;
        let pixels = plan.src_pixels();
        let first: [isize; 3] = std::array::from_fn(|a| {
            (start[a] as isize + plan.origin[a]) * plan.src_step[a] as isize
        });
        let place = |a: usize, i: usize, phase: usize| {
            let at = first[a] + (i * plan.src_step[a] + phase) as isize;
            usize::try_from(at).ok().filter(|&at| at < plan.src_size[a])
        };
        let step = plan.src_step[2];
        let row_stride = layout.row_stride();
        for (x, channel) in x.chunks_exact(pixels).zip(out.chunks_mut(layout.channel_stride)) {
            // The narrow weight gradient multiplies these floats by zeros.
            channel[plan.planes.len() * layout.plane_stride..].fill(0.0);
            let planes = channel.chunks_exact_mut(layout.plane_stride);
            for (phase, plane) in plan.planes.iter().zip(planes) {
                let left = first[2] + phase[2] as isize;
                let begin = (-left).max(0).unsigned_abs().div_ceil(step).min(row_stride);
                let past = (width as isize - left).max(0).unsigned_abs().div_ceil(step);
                let past = past.clamp(begin, row_stride);
                let from = (left + (begin * step) as isize).max(0).unsigned_abs();
                for (i, slice) in plane.chunks_exact_mut(layout.depth_stride()).enumerate() {
                    let d = place(0, i, phase[0]);
                    for (i, row) in slice.chunks_exact_mut(row_stride).enumerate() {
                        let (Some(d), Some(h)) = (d, place(1, i, phase[1])) else {
                            row.fill(0.0);
                            continue;
                        };
                        row[..begin].fill(0.0);
                        row[past..].fill(0.0);
                        if past > begin {
                            let src = &x[(d * height + h) * width..][from..width];
                            load_strided(s, src, step, &mut row[begin..past]);
                        }
                    }
                }
            }
        }
    }
}

/// Copies every `step`th float of `from` until `to` is full. `from` may end with the last
/// float that is copied.
#[inline(always)]
pub(super) fn load_strided<S: Simd>(s: S, from: &[f32], step: usize, to: &mut [f32]) {
    if step == 1 {
        to.copy_from_slice(&from[..to.len()]);
        return;
    }
    let pairs = if step == 2 { from.chunks_exact(2 * LANES) } else { [].chunks_exact(1) };
    let whole = (to.len() / LANES).min(pairs.len()) * LANES;
    let (vectors, rest) = to.split_at_mut(whole);
    for (to, pair) in vectors.as_chunks_mut().0.iter_mut().zip(pairs) {
        if let [a, b] = pair.as_chunks().0 {
            s.store(s.deinterleave(s.load(a), s.load(b))[0], to);
        }
    }
    let strided = from[whole * step..].iter().step_by(step);
    rest.iter_mut().zip(strided).for_each(|(to, v)| *to = *v);
}

/// Writes `even[0], odd[0], even[1], odd[1], …` until `to` is full.
#[inline(always)]
pub(super) fn store_interleaved<S: Simd>(
    s: S,
    even: &[f32],
    odd: &[f32],
    to: &mut [MaybeUninit<f32>],
) {
    let whole = to.len() / (2 * LANES) * LANES;
    let (vectors, rest) = to.split_at_mut(2 * whole);
    let pairs = even.as_chunks().0.iter().zip(odd.as_chunks().0);
    for (to, (even, odd)) in vectors.chunks_exact_mut(2 * LANES).zip(pairs) {
        let pair = s.interleave(s.load(even), s.load(odd));
        for (to, v) in to.as_chunks_mut().0.iter_mut().zip(pair) {
            s.store_uninit(v, to);
        }
    }
    for (i, to) in rest.iter_mut().enumerate() {
        let from = if i.is_multiple_of(2) { even } else { odd };
        *to = MaybeUninit::new(from[whole + i / 2]);
    }
}
