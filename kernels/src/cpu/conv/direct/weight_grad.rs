//! Direct weight gradient: its division into jobs, and the job's loop over tiles.
//!
//! Each tile of x is packed with its halo. Then one of two kernels adds its products with
//! ∂L/∂y: [`WideKernel`] has output channels in its lanes, [`NarrowKernel`] neighbouring
//! outputs.

use super::narrow_weight_grad::NarrowKernel;
use super::wide_weight_grad::WideKernel;
use crate::cpu::conv::algorithm::MAX_NARROW_CHANNELS;
use crate::cpu::conv::buffers::{Buffer, Buffers};
use crate::cpu::conv::packed_tile::{PackTile, tile_size, tile_starts};
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::sizes::Axes;
use crate::cpu::conv::weight_grad_jobs::{Job, Partition, TileOperands, TiledWeightGrad};
use crate::cpu::conv::weight_grad_tile::{MAX_TILE_CHANNELS, TILE_ROWS};
use crate::cpu::simd::{LANES, SimdLevel};

/// Minimum rows (channel × tap) of a job, where there are as many.
const MIN_JOB_ROWS: usize = 144;
/// Jobs of a call, where it can be cut into as many.
const MIN_JOBS: usize = 16;
/// A multiple of the rows of every register tile of [`NarrowKernel`].
const NARROW_ROW_MULTIPLE: usize = 24;
/// Floats beyond a packed tile's end that a kernel may read; it multiplies them by zero.
const OVERREAD: usize = 2 * LANES;

/// The axis along which the lanes of a vector lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::cpu::conv) enum LaneAxis {
    /// Output channels.
    OutputChannels,
    /// Neighbouring outputs of one channel; their lanes are added at the end.
    Outputs,
}

/// Direct sums over all outputs.
pub(in crate::cpu::conv) struct DirectWeightGrad {
    pub lanes: LaneAxis,
}

/// The products of one packed tile, which a kernel adds to the sums of one job.
pub(super) struct TileProducts<'a, 'b> {
    pub job: &'a Job<'b>,
    /// Packed tile.
    pub x: &'a [f32],
    pub dy: &'a [f32],
    /// First output of the tile.
    pub start: Axes,
    /// Memory for gradients in the kernel's own order.
    pub scratch: &'a mut Buffer,
    /// `[row][output channel]`.
    pub sums: &'a mut [f32],
}

impl TiledWeightGrad for DirectWeightGrad {
    fn partition(&self, plan: &Plan, images: usize) -> Partition {
        let (c, o, taps) = (plan.src_channels, plan.dst_channels, plan.kernel_taps);
        let (output_channels, input_channels) = match self.lanes {
            LaneAxis::Outputs => (o, even_part(c, (c * taps).div_ceil(MIN_JOB_ROWS))),
            LaneAxis::OutputChannels => {
                let channels = o.div_ceil(o.div_ceil(MAX_TILE_CHANNELS)).next_multiple_of(LANES);
                (channels, even_part(c, (c * taps / MIN_JOB_ROWS).max(1)))
            }
        };
        let parts = Partition::parts(plan, output_channels, input_channels);
        let tile = tile_size(plan, input_channels, images, MIN_JOBS.div_ceil(parts));
        let tiles = images * tile_starts(plan.grid(), tile).len();
        let groups = MIN_JOBS.div_ceil(parts).min(tiles);
        Partition { output_channels, input_channels, tile, images_per_tile: 1, groups }
    }

    fn row_multiple(&self) -> usize {
        match self.lanes {
            LaneAxis::OutputChannels => TILE_ROWS,
            LaneAxis::Outputs => NARROW_ROW_MULTIPLE,
        }
    }

    fn row_stride(&self, output_channels: usize) -> usize {
        match self.lanes {
            LaneAxis::OutputChannels => output_channels.next_multiple_of(LANES),
            LaneAxis::Outputs if output_channels < MAX_NARROW_CHANNELS => {
                output_channels.next_power_of_two()
            }
            LaneAxis::Outputs => output_channels.next_multiple_of(MAX_NARROW_CHANNELS),
        }
    }

    fn sum_tiles<'a>(
        &self,
        level: SimdLevel,
        job: &Job<'_>,
        tiles: &mut dyn Iterator<Item = TileOperands<'a>>,
        buffers: &mut Buffers,
        sums: &mut [f32],
    ) {
        let (plan, layout) = (job.plan, &job.layout);
        let floats = job.rows / plan.kernel_taps * layout.channel_stride;
        for TileOperands { x, dy, start } in tiles {
            let packed = buffers.packed.floats(floats + OVERREAD);
            // A leftover NaN times zero would be NaN.
            packed[floats..].fill(0.0);
            level.run(PackTile { plan, layout, x, start, out: packed });
            let x = &*packed;
            let scratch = &mut buffers.scratch;
            let products = TileProducts { job, x, dy, start, scratch, sums: &mut *sums };
            match self.lanes {
                LaneAxis::OutputChannels => level.run(WideKernel(products)),
                LaneAxis::Outputs => level.run(NarrowKernel(products)),
            }
        }
    }
}

/// Returns the size of one part when `n` is cut into `parts` equal parts.
fn even_part(n: usize, parts: usize) -> usize {
    n.div_ceil(parts.clamp(1, n.max(1))).max(1)
}
