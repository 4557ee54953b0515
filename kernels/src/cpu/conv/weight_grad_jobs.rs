//! ∂L/∂w as jobs: the part that direct sums and Winograd's algorithm share.
//!
//! ∂w[o][c][tap] = Σ over images and outputs of x[c][output + tap] · ∂y[o][output]
//!
//! ∂w is cut into *parts*, ranges of output channels × input channels. The tiles of all
//! images are cut into *groups*. One job sums one part over one group; at the end the sums of
//! all groups are added in order. Groups depend on sizes only, so the result does not depend
//! on the number of threads. Parts may depend on it, since no sum crosses them.
//!
//! A job's sums are `[row][output channel]`, where row = channel · taps + tap.

use super::algorithm::{WeightGrad, WeightGradArgs};
use super::buffers::Buffers;
use super::packed_tile::{TileLayout, tile_starts};
use super::plan::Plan;
use super::sizes::Axes;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel};
use crate::cpu::uninit;
use rayon::prelude::*;
use std::ops::Range;

/// An algorithm that sums ∂L/∂w over tiles.
pub(super) trait TiledWeightGrad: Sync {
    /// Cuts the gradient of `images` images into jobs.
    fn partition(&self, plan: &Plan, images: usize) -> Partition;

    /// Returns the multiple that the rows of a job's sums are rounded up to.
    fn row_multiple(&self) -> usize;

    /// Returns the floats of one row of sums for `output_channels` channels.
    fn row_stride(&self, output_channels: usize) -> usize;

    /// Sums the products of all `tiles` into `sums`, which is zero.
    fn sum_tiles<'a>(
        &self,
        level: SimdLevel,
        job: &Job<'_>,
        tiles: &mut dyn Iterator<Item = TileOperands<'a>>,
        buffers: &mut Buffers,
        sums: &mut [f32],
    );
}

/// Division of ∂L/∂w into jobs.
pub(super) struct Partition {
    /// Output channels of a part.
    pub output_channels: usize,
    /// Input channels of a part.
    pub input_channels: usize,
    /// Outputs of a tile.
    pub tile: Axes,
    /// Images that make one tile together; 1 unless a tile covers a whole image.
    pub images_per_tile: usize,
    /// Groups of tiles; at most as many as there are tiles.
    pub groups: usize,
}

impl Partition {
    /// Returns the number of parts of ∂L/∂w.
    pub fn parts(plan: &Plan, output_channels: usize, input_channels: usize) -> usize {
        plan.dst_channels.div_ceil(output_channels) * plan.src_channels.div_ceil(input_channels)
    }
}

/// The operands of one tile.
pub(super) struct TileOperands<'a> {
    /// Source: from the job's first channel in the tile's first image to its last channel in
    /// the last image.
    pub x: &'a [f32],
    /// All channels of ∂L/∂y of the same images.
    pub dy: &'a [f32],
    /// First output of the tile.
    pub start: Axes,
}

/// The part of ∂L/∂w that one job sums.
pub(super) struct Job<'a> {
    pub plan: &'a Plan,
    /// Layout of a packed tile.
    pub layout: TileLayout,
    pub output_channels: Range<usize>,
    /// Floats of one row of sums: the output channels, rounded up.
    pub row_stride: usize,
    /// Input channels × taps.
    pub rows: usize,
    /// Rows are rounded up to a multiple of this; the added ones repeat the last.
    pub row_multiple: usize,
}

impl Job<'_> {
    /// Returns the floats of the job's sums.
    pub fn floats(&self) -> usize {
        self.rows.next_multiple_of(self.row_multiple) * self.row_stride
    }

    /// Returns the offset in the packed tile at which each row of sums reads; added rows
    /// repeat the last.
    pub fn offsets(&self) -> Vec<usize> {
        let taps = &self.plan.passes[0].taps;
        let row = |r: usize| {
            let r = r.min(self.rows - 1);
            r / taps.len() * self.layout.channel_stride + self.layout.offset(&taps[r % taps.len()])
        };
        (0..self.rows.next_multiple_of(self.row_multiple)).map(row).collect()
    }

    /// Returns the size of the tile at `start`, cut at the image's border.
    pub fn valid_outputs(&self, start: Axes) -> Axes {
        std::array::from_fn(|a| self.layout.tile[a].min(self.plan.dst_size[a] - start[a]))
    }

    /// Returns where depth `d` of the tile at `start` begins in ∂L/∂y of one output channel.
    /// Its rows are one image row apart.
    pub fn gradient_at(&self, output_channel: usize, start: Axes, d: usize) -> usize {
        let [depth, height, width] = self.plan.dst_size;
        ((output_channel * depth + start[0] + d) * height + start[1]) * width + start[2]
    }
}

impl<A: TiledWeightGrad> WeightGrad for A {
    fn weight_grad(&self, args: &WeightGradArgs<'_>, dw: &mut [f32]) {
        sum_jobs(self, args, dw);
    }
}

/// Computes ∂L/∂w by `algorithm`; overwrites `dw`.
fn sum_jobs(algorithm: &dyn TiledWeightGrad, args: &WeightGradArgs<'_>, dw: &mut [f32]) {
    let &WeightGradArgs { level, plan, x, dy } = args;
    let (c, o, taps) = (plan.src_channels, plan.dst_channels, plan.kernel_taps);
    let in_pixels = plan.src_pixels();
    let in_image = c * in_pixels;
    let out_image = o * plan.dst_pixels();
    let images = args.images();
    let partition = algorithm.partition(plan, images);
    let Partition { output_channels, input_channels, tile, images_per_tile, groups } = partition;
    // First output and input channel of each part.
    let parts: Vec<(usize, usize)> = (0..o)
        .step_by(output_channels)
        .flat_map(|first| (0..c).step_by(input_channels).map(move |channel| (first, channel)))
        .collect();
    let layout = TileLayout::new(plan, tile);
    let starts = tile_starts(plan.grid(), tile);
    let tiles = images.div_ceil(images_per_tile) * starts.len();
    assert!(groups <= tiles, "conv: no group of tiles is empty");
    let job = |(first, channel): (usize, usize)| Job {
        plan,
        layout,
        output_channels: first..(first + output_channels).min(o),
        row_stride: algorithm.row_stride(output_channels.min(o - first)),
        rows: input_channels.min(c - channel) * taps,
        row_multiple: algorithm.row_multiple(),
    };
    // The first part is the largest.
    let floats = job(parts[0]).floats();
    let mut sums = uninit::zeros(parts.len() * groups * floats);
    sums.par_chunks_exact_mut(floats).enumerate().for_each(|(i, sums)| {
        let (part, group) = (i / groups, i % groups);
        let (first, channel) = parts[part];
        let job = job((first, channel));
        let operands = |tile: usize| {
            let image = tile / starts.len() * images_per_tile;
            let count = images_per_tile.min(images - image);
            let x = &x[image * in_image + channel * in_pixels..];
            let x = &x[..(count - 1) * in_image + job.rows / taps * in_pixels];
            let dy = &dy[image * out_image..][..count * out_image];
            TileOperands { x, dy, start: starts[tile % starts.len()] }
        };
        let mut tiles = (tiles * group / groups..tiles * (group + 1) / groups).map(operands);
        let sums = &mut sums[..job.floats()];
        Buffers::with(|buffers| algorithm.sum_tiles(level, &job, &mut tiles, buffers, sums));
    });
    let dw = SharedSliceMut::new(dw);
    sums.par_chunks_exact(groups * floats).zip(&parts).for_each(|(sums, &(first, channel))| {
        let rows = input_channels.min(c - channel) * taps;
        let outputs = first..(first + output_channels).min(o);
        let row_stride = algorithm.row_stride(outputs.len());
        (0..outputs.len().div_ceil(LANES)).into_par_iter().for_each(|block| {
            let lanes = block * LANES..(block * LANES + LANES).min(outputs.len());
            let weights = |lane: usize| {
                let at = ((first + lane) * c + channel) * taps;
                // SAFETY: parts and blocks differ in output or input channels.
                unsafe { dw.part(at..at + rows) }
            };
            let to = lanes.clone().map(weights).collect();
            level.run(AddGroups { sums, floats, row_stride, first: lanes.start, to });
        });
    });
}

/// Adds the sums `[group][row][row_stride]` of all groups and transposes them: column
/// `first + i` goes to slice i of `to`.
struct AddGroups<'a> {
    sums: &'a [f32],
    /// Floats of a group.
    floats: usize,
    row_stride: usize,
    first: usize,
    to: Vec<&'a mut [f32]>,
}

impl Kernel for AddGroups<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { sums, floats, row_stride, first, mut to } = self;
        let rows = to.first().map_or(0, |to| to.len());
        // Rows of narrow sums are no whole vectors.
        let whole = if row_stride.is_multiple_of(LANES) { rows / LANES * LANES } else { 0 };
        for r in (0..whole).step_by(LANES) {
            let mut square = [s.splat(0.0); LANES];
            for sums in sums.chunks_exact(floats) {
                for i in 0..LANES {
                    if let Some(row) = sums[(r + i) * row_stride + first..].first_chunk() {
                        square[i] = square[i] + s.load(row);
                    }
                }
            }
            let transposed = s.transpose(square);
            for i in 0..LANES {
                if let Some(to) = to.get_mut(i).and_then(|to| to[r..].first_chunk_mut()) {
                    s.store(transposed[i], to);
                }
            }
        }
        for r in whole..rows {
            for (i, to) in to.iter_mut().enumerate() {
                let groups = sums.chunks_exact(floats);
                let values = groups.map(|sums| sums[r * row_stride + first + i]);
                to[r] = values.fold(0.0, |total, v| total + v);
            }
        }
    }
}
