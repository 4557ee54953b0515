//! Products of transformed tiles and weights, their transform back and the store to y:
//! Aᵀ·[Σ_c U ⊙ V]·A + bias.
//!
//! The kernels are functions of their own ([`Simd::call`]): the products serve all transforms,
//! and the transform back serves images one by one and small images together.

use super::load_tiles::TileBlock;
use super::product_layout::ProductLayout;
use super::transforms::{TILE, Transform};
use super::weights::group_stride;
use crate::cpu::conv::buffers::Buffer;
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::register_tile::{BLOCK_CHANNELS, ChannelBlock, Strip};
use crate::cpu::conv::sizes::Axes;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd, transpose4x4_index};
use std::array::from_fn;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Computes one block of destination channels from transformed tiles: multiplies into
/// `products`, transforms back and writes to `output`.
pub(super) struct BlockProducts<'a, T, const IN: usize, const POINTS: usize, const OUT: usize> {
    /// Transformed tiles.
    pub tiles: &'a [f32],
    /// Layout of `tiles`, or of each of its channels if `channel_stride` is set.
    pub tiles_layout: &'a ProductLayout,
    /// Layout of the products: [`BLOCK_CHANNELS`] channels.
    pub products_layout: &'a ProductLayout,
    /// Floats from channel to channel of `tiles`, where each channel holds all its groups.
    pub channel_stride: Option<usize>,
    pub block: &'a ChannelBlock,
    /// Transformed weights of the block.
    pub panel: &'a [f32],
    /// Bias of all destination channels, or empty.
    pub bias: &'a [f32],
    pub products: &'a mut Buffer,
    pub output: &'a OutputWriter<'a>,
    pub transform: PhantomData<T>,
}

impl<T, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for BlockProducts<'_, T, IN, POINTS, OUT>
where
    T: Transform<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { tiles, tiles_layout, channel_stride, block, panel, output, .. } = self;
        let (layout, channels) = (self.products_layout, output.plan.src_channels);
        let products = self.products.floats(layout.floats);
        s.call(GroupProducts {
            tiles,
            tiles_layout,
            channel_stride,
            channels,
            panel,
            block_channels: block.channels,
            products: &mut *products,
            products_layout: layout,
        });
        let mut rows = [[s.splat(0.0); POINTS]; OUT];
        for m in 0..block.channels {
            let channel = block.first + m;
            let bias = self.bias.get(channel).copied().unwrap_or(0.0);
            for (v, places) in output.places.iter().enumerate() {
                transform_columns::<S, T, IN, POINTS, OUT>(
                    s,
                    products,
                    layout,
                    m,
                    v * LANES,
                    &mut rows,
                );
                for r in 0..OUT {
                    let mut row = T::outputs(s, rows[r]);
                    for k in 0..OUT {
                        row[k] = row[k] + s.splat(bias);
                    }
                    output.write_row(s, row, channel, places, r);
                }
            }
        }
    }
}

/// The products of all groups, before they are transformed back.
struct GroupProducts<'a> {
    tiles: &'a [f32],
    tiles_layout: &'a ProductLayout,
    /// [`BlockProducts::channel_stride`].
    channel_stride: Option<usize>,
    /// Source channels.
    channels: usize,
    panel: &'a [f32],
    /// Destination channels.
    block_channels: usize,
    products: &'a mut [f32],
    products_layout: &'a ProductLayout,
}

impl Kernel for GroupProducts<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { channels, products, .. } = self;
        for (i, w) in self.panel.chunks_exact(group_stride(channels)).enumerate() {
            let (from, to) = (self.tiles_layout.groups[i], self.products_layout.groups[i]);
            let length = from.channel_stride;
            let strip = Strip {
                x: &self.tiles[from.start..],
                channel_stride: self.channel_stride.unwrap_or(length),
                channels,
                offsets: &[0],
                w,
                bias: [0.0; BLOCK_CHANNELS],
                length,
            };
            let sums = &mut products[to.start..][..BLOCK_CHANNELS * length];
            strip.run(s, self.block_channels, sums);
        }
    }
}

/// Transforms the columns of the products of the sixteen tiles from `first` on: `rows`
/// become rows of outputs that are not yet transformed along themselves.
#[inline(always)]
fn transform_columns<S, T, const IN: usize, const POINTS: usize, const OUT: usize>(
    s: S,
    products: &[f32],
    layout: &ProductLayout,
    channel: usize,
    first: usize,
    rows: &mut [[S::F; POINTS]; OUT],
) where
    S: Simd,
    T: Transform<IN, POINTS, OUT>,
{
    assert!(products.len() >= layout.floats);
    let vectors = layout.vectors(channel, first);
    let products = products.as_ptr();
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); POINTS];
        for i in 0..POINTS {
            let from = products.wrapping_add(vectors.place(POINTS, i, j));
            // SAFETY: `vectors` lie inside `layout`, which lies inside `products`
            // (asserted).
            column[i] = s.load(unsafe { &*from.cast() });
        }
        let column = T::outputs(s, column);
        for i in 0..OUT {
            rows[i][j] = column[i];
        }
    }
}

/// Writes the outputs of a block of tiles, in any channel.
pub(super) struct OutputWriter<'a> {
    plan: &'a Plan,
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
    /// One entry per vector of tiles.
    places: Vec<OutputPlaces>,
}

/// Positions of the outputs of sixteen tiles, in channel 0.
enum OutputPlaces {
    /// A row of outputs of neighbouring tiles fills whole vectors, which begin here.
    Vectors([usize; 8]),
    /// Tile by tile.
    Tiles(Vec<OutputTile>),
}

/// Positions of the outputs of one tile.
struct OutputTile {
    /// The tile's lane, after rows have been transposed to image order.
    lane: usize,
    start: usize,
    /// Rows and columns of the tile that lie inside the image.
    rows: usize,
    columns: usize,
}

impl<'a> OutputWriter<'a> {
    /// Prepares writing `tiles`; the first lies at grid position `start` of image `image`.
    pub fn new<const OUT: usize>(
        plan: &'a Plan,
        y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
        tiles: TileBlock,
        image: usize,
        [depth, top, left]: Axes,
    ) -> Self {
        let TileBlock { count, per_row, per_image } = tiles;
        let [slices, height, width] = plan.dst_size;
        let output_tile = |t: usize| {
            let lane = transpose4x4_index(tiles.lane(t) % LANES);
            let image = image + t / per_image;
            let t = t % per_image;
            let row = top * OUT / TILE + t / per_row * OUT;
            let column = left * OUT / TILE + t % per_row * OUT;
            let slice = image * plan.dst_channels * slices + depth;
            let start = (slice * height + row) * width + column;
            let [rows, columns] = [height.saturating_sub(row), width.saturating_sub(column)];
            OutputTile { lane, start, rows: rows.min(OUT), columns: columns.min(OUT) }
        };
        let vector = |first: usize| {
            let tiles: Vec<_> = (first..count.min(first + LANES)).map(output_tile).collect();
            let whole = |tile: &OutputTile| [tile.rows, tile.columns] == [OUT; 2];
            let contiguous = |group: &[OutputTile]| {
                let last = group.len() - 1;
                group[last].start == group[0].start + last * OUT
            };
            // Tiles whose rows make one vector.
            let group = LANES / OUT;
            let all_whole = tiles.len() == LANES && tiles.iter().all(whole);
            if !(all_whole && tiles.chunks_exact(group).all(contiguous)) {
                return OutputPlaces::Tiles(tiles);
            }
            let start = |k: usize| tiles.get(k * group).map_or(0, |tile| tile.start);
            OutputPlaces::Vectors(from_fn(start))
        };
        let places = (0..count).step_by(LANES).map(vector).collect();
        Self { plan, y, places }
    }

    /// Writes row `r` of the outputs `v` `[column]` of sixteen tiles to channel `channel`.
    #[inline(always)]
    fn write_row<S: Simd, const OUT: usize>(
        &self,
        s: S,
        v: [S::F; OUT],
        channel: usize,
        places: &OutputPlaces,
        r: usize,
    ) {
        let [slices, height, width] = self.plan.dst_size;
        let down = channel * slices * height * width + r * width;
        let rows = match OUT {
            8 => s.rows_of_8([
                v[0],
                v[1],
                v[2],
                v[3],
                v[OUT - 4],
                v[OUT - 3],
                v[OUT - 2],
                v[OUT - 1],
            ]),
            _ => {
                let [a, b, c, d] = s.transpose_quarters([v[0], v[1], v[2], v[3]]);
                [a, b, c, d, a, b, c, d]
            }
        };
        let tiles = match places {
            OutputPlaces::Tiles(tiles) => tiles,
            OutputPlaces::Vectors(starts) => {
                for k in 0..OUT {
                    let at = starts[k] + down;
                    // SAFETY: no two jobs, and no two tiles of a job, hold the same outputs.
                    let to = unsafe { self.y.part(at..at + LANES) };
                    if let Some(to) = to.first_chunk_mut() {
                        s.store_uninit(rows[k], to);
                    }
                }
                return;
            }
        };
        let mut floats = [[0.0; LANES]; OUT];
        for k in 0..OUT {
            s.store(rows[k], &mut floats[k]);
        }
        let values = floats.as_flattened().as_chunks::<OUT>().0;
        for tile in tiles.iter().filter(|tile| r < tile.rows) {
            let at = tile.start + down;
            // SAFETY: no two jobs, and no two tiles of a job, hold the same outputs.
            let to = unsafe { self.y.part(at..at + tile.columns) };
            to.iter_mut().zip(values[tile.lane]).for_each(|(to, v)| *to = MaybeUninit::new(v));
        }
    }
}
