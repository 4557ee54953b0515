//! Winograd forward convolution and input gradient, one image at a time.
//!
//! The kernels are transformed once per call. One job transforms a block of up to 32 tiles of
//! one image, all source channels, which stay in the second-level cache; then it computes
//! all destination channels in blocks of eight.

use super::kind::{Kind, TransformTask};
use super::load_tiles::{LoadChannels, TileBlock, TileLoader};
use super::product_layout::{GROUPS, ProductLayout};
use super::products::{BlockProducts, OutputWriter};
use super::transforms::{TILE, Transform};
use super::weights::{TransformedWeights, group_stride};
use crate::cpu::conv::algorithm::{Convolve, ConvolveArgs};
use crate::cpu::conv::buffers::{Buffers, return_weight_memory, take_weight_memory};
use crate::cpu::conv::packed_tile::tile_starts;
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::register_tile::BLOCK_CHANNELS;
use crate::cpu::conv::sizes::Axes;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd};
use crate::cpu::uninit::UninitSlice;
use rayon::prelude::*;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Maximum vectors of tiles of a block.
const MAX_VECTORS: usize = 2;
/// Maximum floats of the transformed tiles of a block, unless one vector needs more.
const MAX_TILE_FLOATS: usize = 300_000;

/// Winograd's algorithm, one image at a time.
pub(in crate::cpu::conv) struct Winograd {
    pub kind: Kind,
}

impl Convolve for Winograd {
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
        let weights = TransformedWeights::new(args, self.kind, take_weight_memory());
        let call = Call::new(args, self.kind, y);
        self.kind.run(ImageBlocks { call: &call, weights: &weights });
        return_weight_memory(weights.data);
    }
}

/// The operands of all jobs of a call.
pub(super) struct Call<'a> {
    pub args: ConvolveArgs<'a>,
    /// [`Kind::reader`] of the plan.
    pub reader: Plan,
    pub images: usize,
    pub y: SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl<'a> Call<'a> {
    pub fn new(args: &ConvolveArgs<'a>, kind: Kind, y: &'a mut UninitSlice<f32>) -> Self {
        let plan = args.plan;
        let images = y.len() / (plan.dst_channels * plan.dst_pixels());
        Self { args: *args, reader: kind.reader(plan), images, y: SharedSliceMut::new(y) }
    }
}

/// All blocks of tiles of all images.
struct ImageBlocks<'a> {
    call: &'a Call<'a>,
    weights: &'a TransformedWeights,
}

impl TransformTask for ImageBlocks<'_> {
    fn run<T, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        T: Transform<IN, POINTS, OUT>,
    {
        let Self { call, weights } = self;
        let ConvolveArgs { level, plan, .. } = call.args;
        let [_, height, width] = plan.grid();
        let vectors = MAX_TILE_FLOATS / (POINTS * POINTS * LANES * plan.src_channels);
        let tile_columns = width.div_ceil(TILE).min(LANES);
        let tile_rows = vectors.clamp(1, MAX_VECTORS) * LANES / tile_columns;
        let tile_rows = tile_rows.clamp(1, height.div_ceil(TILE));
        let starts = tile_starts(plan.grid(), [1, tile_rows * TILE, tile_columns * TILE]);
        (0..call.images * starts.len()).into_par_iter().for_each(|job| {
            let image = job / starts.len();
            let start = starts[job % starts.len()];
            Buffers::with(|buffers| {
                let transform = PhantomData::<T>;
                level.run::<BlockJob<'_, T, IN, POINTS, OUT>>(BlockJob {
                    call,
                    weights,
                    tile_rows,
                    tile_columns,
                    image,
                    start,
                    buffers,
                    transform,
                });
            });
        });
    }
}

/// One block of tiles, all channels.
struct BlockJob<'a, T, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a>,
    weights: &'a TransformedWeights,
    /// Rows and columns of tiles of a whole block.
    tile_rows: usize,
    tile_columns: usize,
    image: usize,
    /// First grid position of the block.
    start: Axes,
    buffers: &'a mut Buffers,
    transform: PhantomData<T>,
}

impl<T, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for BlockJob<'_, T, IN, POINTS, OUT>
where
    T: Transform<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Call { args, ref reader, ref y, .. } = *self.call;
        let ConvolveArgs { plan, x, bias, .. } = args;
        let grid = plan.grid();
        let Buffers { packed, tiles, products, .. } = self.buffers;
        let valid = |a: usize, tiles: usize| tiles.min((grid[a] - self.start[a]).div_ceil(TILE));
        let (tile_rows, per_row) = (valid(1, self.tile_rows), valid(2, self.tile_columns));
        let count = tile_rows * per_row;
        let block = TileBlock { count, per_row, per_image: count };
        let loader = TileLoader::new::<T, IN, POINTS, OUT>(reader, block, self.start, x.len());
        // The gap keeps groups off powers of two, where all would share one cache set.
        let tiles_layout = &ProductLayout::new(POINTS, plan.src_channels, block.lanes(), LANES);
        let products_layout = &ProductLayout::new(POINTS, BLOCK_CHANNELS, block.lanes(), 0);
        let tiles = tiles.floats(tiles_layout.floats);
        let pixels = plan.src_pixels();
        let channels = plan.src_channels;
        s.call(LoadChannels {
            loader: &loader,
            x: &x[self.image * channels * pixels..][..channels * pixels],
            pixels,
            channels,
            packed,
            layout: tiles_layout,
            tiles: &mut *tiles,
            transform: self.transform,
        });
        let output = OutputWriter::new::<OUT>(plan, y, block, self.image, self.start);
        let panels = self.weights.data.chunks_exact(GROUPS * group_stride(channels));
        for (block, panel) in self.weights.blocks.iter().zip(panels) {
            s.call(BlockProducts {
                tiles,
                tiles_layout,
                products_layout,
                channel_stride: None,
                block,
                panel,
                bias,
                products: &mut *products,
                output: &output,
                transform: self.transform,
            });
        }
    }
}
