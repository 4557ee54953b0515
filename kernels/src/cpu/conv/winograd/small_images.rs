//! Winograd forward convolution and input gradient for small images.
//!
//! One block of tiles of a small image would not repay reading all transformed weights. Here
//! vectors hold tiles of all images. A first set of jobs transforms the tiles, channel by
//! channel; a second set computes blocks of eight destination channels, each transforming its
//! own weights within its cache. The sums equal those of [`super::forward`] bit for bit.

use super::forward::Call;
use super::kind::{Kind, TransformTask};
use super::load_tiles::{LoadChannels, TileBlock, TileLoader};
use super::product_layout::{GROUPS, ProductLayout};
use super::products::{BlockProducts, OutputWriter};
use super::transforms::{TILE, Transform};
use super::weights::{TransformWeights, group_stride};
use crate::cpu::conv::algorithm::{Convolve, ConvolveArgs};
use crate::cpu::conv::buffers::Buffers;
use crate::cpu::conv::register_tile::{BLOCK_CHANNELS, ChannelBlock, channel_blocks};
use crate::cpu::simd::{Kernel, LANES, Simd};
use crate::cpu::uninit::UninitSlice;
use rayon::prelude::*;
use std::marker::PhantomData;
use std::mem::take;

/// Minimum channels whose tiles one job transforms; one channel takes microseconds.
const MIN_JOB_CHANNELS: usize = 8;

/// Winograd's algorithm over the tiles of all images together; images have one slice.
pub(in crate::cpu::conv) struct SmallImages {
    pub kind: Kind,
}

impl Convolve for SmallImages {
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
        let call = Call::new(args, self.kind, y);
        self.kind.run(AllImages { call: &call, kind: self.kind });
    }
}

/// All tiles of all images.
struct AllImages<'a> {
    call: &'a Call<'a>,
    kind: Kind,
}

impl TransformTask for AllImages<'_> {
    fn run<T, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        T: Transform<IN, POINTS, OUT>,
    {
        let Self { call, kind } = self;
        let ConvolveArgs { level, plan, x, .. } = call.args;
        let pixels = plan.src_pixels();
        let [_, height, width] = plan.grid();
        let [tile_rows, per_row] = [height, width].map(|n| n.div_ceil(TILE));
        let per_image = tile_rows * per_row;
        let tiles = TileBlock { count: call.images * per_image, per_row, per_image };
        let image_stride = plan.src_channels * pixels;
        let loader =
            &TileLoader::new::<T, IN, POINTS, OUT>(&call.reader, tiles, [0; 3], image_stride);
        let tiles_layout = &ProductLayout::new(POINTS, 1, tiles.lanes(), 0);
        // The gap keeps channels off powers of two, where all would share one cache set.
        let channel_stride = tiles_layout.floats + LANES;
        // Taken out of this thread's buffers, which its own jobs use.
        let mut transformed = Buffers::with(|buffers| take(&mut buffers.tiles));
        let all = transformed.floats(plan.src_channels * channel_stride);
        let channels = all.par_chunks_exact_mut(channel_stride).enumerate();
        channels.with_min_len(MIN_JOB_CHANNELS).for_each(|(channel, tiles)| {
            Buffers::with(|buffers| {
                level.run::<LoadChannels<'_, T, IN, POINTS, OUT>>(LoadChannels {
                    loader,
                    x: &x[channel * pixels..],
                    pixels,
                    channels: 1,
                    packed: &mut buffers.packed,
                    layout: tiles_layout,
                    tiles,
                    transform: PhantomData,
                });
            });
        });
        let products_layout = &ProductLayout::new(POINTS, BLOCK_CHANNELS, tiles.lanes(), 0);
        let output = &OutputWriter::new::<OUT>(plan, &call.y, tiles, 0, [0; 3]);
        channel_blocks(plan.dst_channels).par_iter().for_each(|block| {
            Buffers::with(|buffers| {
                level.run::<ProductJob<'_, T, IN, POINTS, OUT>>(ProductJob {
                    call,
                    kind,
                    tiles: all,
                    channel_stride,
                    tiles_layout,
                    products_layout,
                    output,
                    block,
                    buffers,
                    transform: PhantomData,
                });
            });
        });
        Buffers::with(|buffers| buffers.tiles = transformed);
    }
}

/// One block of destination channels of all images.
struct ProductJob<'a, T, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a>,
    kind: Kind,
    /// `[channel][product][tile]`.
    tiles: &'a [f32],
    /// Floats of a channel of `tiles`.
    channel_stride: usize,
    /// Layout of one channel of `tiles`.
    tiles_layout: &'a ProductLayout,
    products_layout: &'a ProductLayout,
    output: &'a OutputWriter<'a>,
    block: &'a ChannelBlock,
    buffers: &'a mut Buffers,
    transform: PhantomData<T>,
}

impl<T, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for ProductJob<'_, T, IN, POINTS, OUT>
where
    T: Transform<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let ConvolveArgs { plan, w, bias, .. } = self.call.args;
        let (kind, block) = (self.kind, self.block);
        let Buffers { scratch: panel, products, .. } = self.buffers;
        let panel = panel.floats(GROUPS * group_stride(plan.src_channels));
        s.call(TransformWeights { plan, kind, w, block, panel: &mut *panel });
        s.call(BlockProducts {
            tiles: self.tiles,
            tiles_layout: self.tiles_layout,
            products_layout: self.products_layout,
            channel_stride: Some(self.channel_stride),
            block,
            panel,
            bias,
            products,
            output: self.output,
            transform: self.transform,
        });
    }
}
