//! Direct forward convolution and input gradient.
//!
//! y[m][p] = bias[m] + Σ_c Σ_tap w[m][c][tap] · x[c][p + offset(tap)]
//!
//! One job packs one tile with its halo ([`PackTile`]) and computes its outputs for some
//! blocks of eight destination channels by register tiles ([`Strip`]). Sums go straight to y
//! where rows are whole vectors, else to a buffer from which the valid columns are copied.

use crate::cpu::conv::algorithm::{Convolve, ConvolveArgs};
use crate::cpu::conv::buffers::{Buffers, return_weight_memory, take_weight_memory};
use crate::cpu::conv::packed_tile::{
    PackTile, TileLayout, store_interleaved, tile_size, tile_starts,
};
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::register_tile::{
    BLOCK_CHANNELS, ChannelBlock, Strip, StripOutput, channel_blocks,
};
use crate::cpu::conv::sizes::Axes;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd};
use crate::cpu::uninit::{UninitSlice, filled, grown};
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Jobs of a call, where it can be cut into as many.
const MIN_JOBS: usize = 16;
/// Minimum vectors of a register tile that hide the latency of a fused multiply-add.
const MIN_VECTORS_IN_FLIGHT: usize = 10;
/// Floats beyond a packed tile's end that a strip may read; their sums are not used.
const OVERREAD: usize = 16 * LANES;

/// Direct sums over channels and taps.
pub(in crate::cpu::conv) struct Direct;

impl Convolve for Direct {
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
        let &ConvolveArgs { level, plan, x, w, bias } = args;
        let weights = BlockedWeights::new(plan, w, take_weight_memory());
        let image_floats = plan.dst_channels * plan.dst_pixels();
        let images = y.len() / image_floats;
        let tile = tile_size(plan, plan.src_channels, images, MIN_JOBS);
        let layout = TileLayout::new(plan, tile);
        let starts = tile_starts(plan.grid(), tile);
        let tiles = images * starts.len();
        // With few tiles, several jobs share a tile and divide the channels.
        let parts = MIN_JOBS.div_ceil(tiles).min(weights.blocks.len());
        let blocks_per_part = weights.blocks.len().div_ceil(parts);
        let y = SharedSliceMut::new(y);
        (0..tiles * parts).into_par_iter().for_each(|job| {
            let image = job / parts / starts.len();
            let start = starts[job / parts % starts.len()];
            let first = (job % parts * blocks_per_part).min(weights.blocks.len());
            let blocks = first..(first + blocks_per_part).min(weights.blocks.len());
            if blocks.is_empty() {
                return;
            }
            let image_len = plan.src_channels * plan.src_pixels();
            let x = &x[image * image_len..][..image_len];
            Buffers::with(|buffers| {
                let Buffers { packed, scratch: sums, .. } = buffers;
                let packed = packed.floats(plan.src_channels * layout.channel_stride + OVERREAD);
                let length = layout.places_per_depth().next_multiple_of(LANES);
                let sums = sums.floats(plan.passes.len() * BLOCK_CHANNELS * length);
                level.run(PackTile { plan, layout: &layout, x, start, out: packed });
                let (weights, y) = (&weights, &y);
                level.run(TileJob {
                    plan,
                    layout,
                    packed,
                    sums,
                    weights,
                    blocks,
                    bias,
                    image,
                    start,
                    y,
                });
            });
        });
        return_weight_memory(weights.data);
    }
}

/// Weights in the order in which [`Strip`] reads them: for each block of destination
/// channels and each pass `[source channel][tap][channel of the block]`.
struct BlockedWeights {
    data: Vec<f32>,
    blocks: Vec<ChannelBlock>,
}

impl BlockedWeights {
    /// Reorders `w` `[O, C, taps]`; `data` provides the memory.
    fn new(plan: &Plan, w: &[f32], mut data: Vec<f32>) -> Self {
        let depth = plan.src_channels * plan.all_taps();
        let blocks = channel_blocks(plan.dst_channels);
        let floats = blocks.iter().map(|b| b.channels * depth).sum();
        let panels = grown(&mut data, floats).par_chunks_mut((BLOCK_CHANNELS * depth).max(1));
        panels.zip(&blocks).for_each(|(panel, block)| {
            let mut panel = panel;
            for pass in &plan.passes {
                // Floats of a source channel, and of the pass.
                let group = pass.taps.len() * block.channels;
                let (own, rest) = panel.split_at_mut(plan.src_channels * group);
                panel = rest;
                // Source channels outermost: the written group stays in the cache.
                for (src, own) in own.chunks_exact_mut(group.max(1)).enumerate() {
                    for m in 0..block.channels {
                        let kernel = plan.kernel_index(src, block.first + m);
                        let taps = &w[kernel * plan.kernel_taps..][..plan.kernel_taps];
                        let own = own.chunks_exact_mut(block.channels);
                        for (tap, own) in pass.taps.iter().zip(own) {
                            own[m] = taps[tap.kernel];
                        }
                    }
                }
            }
        });
        Self { data, blocks }
    }
}

/// One tile and some blocks of destination channels.
struct TileJob<'a> {
    plan: &'a Plan,
    layout: TileLayout,
    packed: &'a [f32],
    /// `[pass][channel of the block][place]`.
    sums: &'a mut [f32],
    weights: &'a BlockedWeights,
    /// Indices into the blocks of `weights`.
    blocks: Range<usize>,
    bias: &'a [f32],
    image: usize,
    /// First grid position of the tile.
    start: Axes,
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Kernel for TileJob<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (plan, layout) = (self.plan, self.layout);
        let depth = plan.src_channels * plan.all_taps();
        let length = layout.places_per_depth().next_multiple_of(LANES);
        let offsets: Vec<Vec<usize>> =
            plan.passes.iter().map(|p| p.taps.iter().map(|t| layout.offset(t)).collect()).collect();
        for index in self.blocks.clone() {
            let block = self.weights.blocks[index];
            let panel = &self.weights.data[index * BLOCK_CHANNELS * depth..];
            let panel = &panel[..block.channels * depth];
            let mut bias = [0.0; BLOCK_CHANNELS];
            for (m, b) in bias.iter_mut().take(block.channels).enumerate() {
                *b = self.bias.get(block.first + m).copied().unwrap_or(0.0);
            }
            let [depths, rows, columns] = self.valid_positions();
            // Rows of whole vectors are stored in y, if one row fills a register tile.
            let store_in_place = plan.dst_step == [1; 3]
                && columns.is_multiple_of(LANES)
                && block.channels * (columns / LANES) >= MIN_VECTORS_IN_FLIGHT
                && block.channels > BLOCK_CHANNELS / 2;
            for d in 0..depths {
                let strip = Strip {
                    x: &self.packed[d * layout.depth_stride()..],
                    channel_stride: layout.channel_stride,
                    channels: plan.src_channels,
                    offsets: &offsets[0],
                    w: panel,
                    bias,
                    length,
                };
                if store_in_place {
                    for r in 0..rows {
                        let x = &strip.x[r * layout.row_stride()..];
                        let strip = Strip { x, length: columns, ..strip };
                        let to = self.row_output(block.first, d, r);
                        // `to` is the same part of a row of y in each channel of the block. No
                        // other job writes it: jobs differ in image, tile or channels.
                        s.call(StripJob { strip, channels: block.channels, to });
                    }
                    continue;
                }
                let mut from = 0;
                for (p, offsets) in offsets.iter().enumerate() {
                    let n = plan.src_channels * offsets.len() * block.channels;
                    let strip = Strip { offsets, w: &panel[from..from + n], ..strip };
                    from += n;
                    let floats = BLOCK_CHANNELS * length;
                    let sums = &mut self.sums[p * floats..][..floats];
                    let to = StripOutput { at: sums.as_mut_ptr(), stride: length };
                    s.call(StripJob { strip, channels: block.channels, to });
                }
                for m in 0..block.channels {
                    self.copy_sums(s, block.first + m, m, d, length);
                }
            }
        }
    }
}

/// One strip: the part of the work that is a function of its own ([`Simd::call`]).
struct StripJob<'a> {
    strip: Strip<'a>,
    channels: usize,
    /// Has `strip.length` writable floats for each of the channels, which no other thread
    /// accesses.
    to: StripOutput,
}

impl Kernel for StripJob<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        // SAFETY: the contract of `to`.
        unsafe { self.strip.run_to(s, self.channels, self.to) };
    }
}

impl TileJob<'_> {
    /// Returns the tile's grid positions that lie inside the grid.
    #[inline(always)]
    fn valid_positions(&self) -> Axes {
        let grid = self.plan.grid();
        std::array::from_fn(|a| self.layout.tile[a].min(grid[a] - self.start[a]))
    }

    /// Returns where row `r` of the tile's depth `d` begins in y, from channel `channel` on;
    /// stride 1.
    #[inline(always)]
    fn row_output(&self, channel: usize, d: usize, r: usize) -> StripOutput {
        let [depth, height, width] = self.plan.dst_size;
        let row = (self.image * self.plan.dst_channels + channel) * depth + self.start[0] + d;
        let at = (row * height + self.start[1] + r) * width + self.start[2];
        let at = self.y.address(at).cast_mut().cast();
        StripOutput { at, stride: depth * height * width }
    }

    /// Copies the valid sums of channel `m` of the block at depth `d` to channel `channel`
    /// of y.
    #[inline(always)]
    fn copy_sums<S: Simd>(&self, s: S, channel: usize, m: usize, d: usize, length: usize) {
        let (plan, layout) = (self.plan, &self.layout);
        let ([depth, height, width], step) = (plan.dst_size, plan.dst_step);
        let base = (self.image * plan.dst_channels + channel) * depth * height * width;
        let left = self.start[2] * step[2];
        let columns = (layout.tile[2] * step[2]).min(width - left);
        // Passes that differ in the column's phase only make the same rows of y.
        for (rows, passes) in plan.passes.chunks_exact(step[2]).enumerate() {
            let [depth_phase, row_phase, _] = passes[0].phase;
            let z = (self.start[0] + d) * step[0] + depth_phase;
            if z >= depth {
                continue;
            }
            for r in 0..layout.tile[1] {
                let row = (self.start[1] + r) * step[1] + row_phase;
                if row >= height {
                    break;
                }
                let at = base + (z * height + row) * width + left;
                // SAFETY: jobs differ in image, tile or channels, and so in the rows, or
                // parts of rows, that they write.
                let to = unsafe { self.y.part(at..at + columns) };
                let source = |p: usize| {
                    let pass = rows * step[2] + p;
                    let first = (pass * BLOCK_CHANNELS + m) * length + r * layout.row_stride();
                    &self.sums[first..first + layout.tile[2]]
                };
                match step[2] {
                    1 => drop(filled(to, &source(0)[..columns])),
                    2 => store_interleaved(s, source(0), source(1), to),
                    n => {
                        for p in 0..n {
                            let places = to.iter_mut().skip(p).step_by(n);
                            places.zip(source(p)).for_each(|(to, v)| *to = MaybeUninit::new(*v));
                        }
                    }
                }
            }
        }
    }
}
