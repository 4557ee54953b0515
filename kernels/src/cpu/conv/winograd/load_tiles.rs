//! Loading of source tiles, sixteen at once, and their transform Bᵀ·d·B.
//!
//! The lanes of a vector are tiles. Where the tiles of a row fill whole spans of a vector,
//! rows of the image are loaded where they lie and transposed in registers; masks replace
//! places beyond the border by zeros. Otherwise the channel is packed first and each tile is
//! loaded by itself. The tiles of a vector lie in the lane order of [`transpose4x4_index`],
//! which needs the fewest shuffles.

use super::product_layout::{ProductLayout, ProductVectors};
use super::transforms::{TILE, Transform, copy_vectors};
use crate::cpu::conv::buffers::Buffer;
use crate::cpu::conv::packed_tile::{PackTile, TileLayout};
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::sizes::Axes;
use crate::cpu::simd::{Kernel, LANES, Mask, Simd, transpose4x4_index};
use std::array::from_fn;
use std::marker::PhantomData;

/// A block of tiles: row by row, one image after the other.
#[derive(Clone, Copy)]
pub(super) struct TileBlock {
    /// Tiles of the block.
    pub count: usize,
    /// Tiles of a row.
    pub per_row: usize,
    /// Tiles of an image.
    pub per_image: usize,
}

impl TileBlock {
    /// Returns the lanes of the block's vectors.
    pub fn lanes(&self) -> usize {
        self.count.next_multiple_of(LANES)
    }

    /// Returns whether vectors are in the order of [`transpose4x4_index`]. A block that does not
    /// fill its only vector has its tiles in the first lanes instead.
    fn squared(&self) -> bool {
        self.count >= LANES
    }

    /// Returns the lane of tile `t`.
    pub fn lane(&self, t: usize) -> usize {
        if self.squared() { t / LANES * LANES + transpose4x4_index(t % LANES) } else { t }
    }

    /// Returns the lanes up to the last one that holds a tile; lanes between may hold none.
    pub fn used_lanes(&self) -> usize {
        if self.squared() { self.lanes() } else { self.count }
    }
}

/// Loads the tiles of a block, from any channel.
pub(super) struct TileLoader<'a> {
    /// Floats from row to row.
    row_stride: usize,
    /// Floats of a channel, from its first image to its last.
    floats: usize,
    source: Source<'a>,
}

/// Source positions that a [`TileLoader`] reads.
enum Source<'a> {
    /// In the images; one entry per vector of tiles.
    InPlace(Vec<Spans>),
    /// In a packed copy of the channel.
    Packed(PackedChannel<'a>),
}

/// Floats beyond a packed channel's end that a load may read; they are not used.
const OVERREAD: usize = 2 * LANES;

/// Maximum rows of a tile.
const MAX_ROWS: usize = 9;

/// Sixteen tiles as spans of neighbours; one row of a span fills a vector. There are as many
/// spans as a tile has own columns (`INPUT_STEP`). A tile's further columns are own columns
/// of its neighbours.
struct Spans {
    /// Start of the first tile's own columns of each span; before the image's first float
    /// where the image has a border there.
    starts: [isize; 8],
    /// For each row of the tile and each span, the lanes that lie inside the image.
    valid_lanes: [[u16; 8]; MAX_ROWS],
    /// The columns before the tiles that are first in their row or in their vector.
    before: Vec<NeighbourColumn>,
    /// The columns after the tiles that are last in their row or in their vector.
    after: Vec<NeighbourColumn>,
}

/// A column that a tile reads beside its own ones, where no lane of the vector holds it.
struct NeighbourColumn {
    /// The tile's lane as a bit.
    lane: u32,
    /// Start of the column.
    start: isize,
    /// For each row of the tile, whether the column lies inside the image.
    valid: [bool; MAX_ROWS],
}

/// A packed copy of one channel of all images.
struct PackedChannel<'a> {
    /// The plan whose places are packed.
    reader: &'a Plan,
    layout: TileLayout,
    /// First grid position.
    start: Axes,
    /// Floats from image to image in the source.
    image_stride: usize,
    /// Start of each tile, by vectors.
    tile_starts: Vec<[usize; LANES]>,
}

impl<'a> TileLoader<'a> {
    /// Prepares loading `tiles` from grid position `start` on, of images `image_stride`
    /// floats apart. `reader` is [`super::Kind::reader`] of the convolution.
    pub fn new<T, const IN: usize, const POINTS: usize, const OUT: usize>(
        reader: &'a Plan,
        tiles: TileBlock,
        [depth, top, left]: Axes,
        image_stride: usize,
    ) -> Self
    where
        T: Transform<IN, POINTS, OUT>,
    {
        let start = [depth, top * T::INPUT_STEP / TILE, left * T::INPUT_STEP / TILE];
        let [slices, height, width] = reader.src_size;
        let images = tiles.count.div_ceil(tiles.per_image);
        let floats = images.saturating_sub(1) * image_stride + slices * height * width;
        let span_tiles = LANES / T::INPUT_STEP;
        if tiles.per_row.is_multiple_of(span_tiles) && tiles.squared() {
            let vectors = (0..tiles.count).step_by(LANES);
            let places = Places { reader, tiles, start, image_stride };
            let spans = vectors.map(|first| places.spans::<T, IN, POINTS, OUT>(first)).collect();
            return Self { row_stride: width, floats, source: Source::InPlace(spans) };
        }
        let packed = PackedChannel::new(reader, tiles, start, image_stride, T::INPUT_STEP);
        let row_stride = packed.layout.row_stride();
        Self { row_stride, floats, source: Source::Packed(packed) }
    }
}

impl<'a> PackedChannel<'a> {
    /// Finds where each tile begins; tiles are `step` places apart.
    fn new(
        reader: &'a Plan,
        tiles: TileBlock,
        start: Axes,
        image_stride: usize,
        step: usize,
    ) -> Self {
        let TileBlock { count, per_row, per_image } = tiles;
        let layout = TileLayout::new(reader, [1, per_image / per_row * step, per_row * step]);
        let place = |t: usize| {
            let (image, t) = (t / per_image, t % per_image);
            let place = (t / per_row * layout.row_stride() + t % per_row) * step;
            image * layout.channel_stride + place
        };
        // Lanes without a tile repeat the last.
        let mut tile_starts = vec![[place(count - 1); LANES]; count.div_ceil(LANES)];
        let lanes = tile_starts.as_flattened_mut();
        (0..count).for_each(|t| lanes[tiles.lane(t)] = place(t));
        Self { reader, layout, start, image_stride, tile_starts }
    }
}

/// Places of tiles in the images.
struct Places<'a> {
    reader: &'a Plan,
    tiles: TileBlock,
    /// First grid position of the reader.
    start: Axes,
    image_stride: usize,
}

/// One column of a tile.
struct Column {
    /// Start in the channel; may lie outside.
    start: isize,
    /// Its place in the image's rows; may lie outside.
    x: isize,
    /// The tile's rows that lie inside the image.
    rows: std::ops::Range<usize>,
}

impl Places<'_> {
    /// Finds column `column` of tile `t`, which has `inputs` rows; tiles are `step` places
    /// apart.
    fn column(&self, t: usize, column: isize, inputs: usize, step: usize) -> Column {
        let TileBlock { per_row, per_image, .. } = self.tiles;
        let [slices, height, width] = self.reader.src_size.map(|n| n as isize);
        let origin: [isize; 3] = from_fn(|a| self.start[a] as isize + self.reader.origin[a]);
        let (image, t) = (t / per_image, t % per_image);
        let top = origin[1] + (t / per_row * step) as isize;
        let x = origin[2] + (t % per_row * step) as isize + column;
        let row = (origin[0] * height + top) * width;
        let clamp = |v: isize| v.clamp(0, inputs as isize).unsigned_abs();
        let has_depth = (0..slices).contains(&origin[0]);
        let past = if has_depth { clamp(height - top) } else { 0 };
        let first = clamp(-top).min(past);
        Column { start: (image * self.image_stride) as isize + row + x, x, rows: first..past }
    }

    /// Returns whether the image has a column at `x`.
    fn has(&self, x: isize) -> bool {
        (0..self.reader.src_size[2] as isize).contains(&x)
    }

    /// Finds the spans of the vector whose first tile is `first`.
    fn spans<T, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        first: usize,
    ) -> Spans
    where
        T: Transform<IN, POINTS, OUT>,
    {
        let TileBlock { count, per_row, .. } = self.tiles;
        let column = |t: usize, column: isize| self.column(t, column, IN, T::INPUT_STEP);
        let span_tiles = LANES / T::INPUT_STEP;
        // Spans beyond the last repeat it.
        let span_first = |k: usize| (first + k * span_tiles).min(count - span_tiles);
        let own = T::INPUTS_BEFORE as isize;
        let mut starts = [0; 8];
        let mut valid_lanes = [[0; 8]; MAX_ROWS];
        for k in 0..T::INPUT_STEP {
            let Column { start, x, rows } = column(span_first(k), own);
            let valid = (0..LANES).filter(|lane| self.has(x + *lane as isize));
            let valid = valid.fold(0, |bits, lane| bits | 1 << lane);
            starts[k] = start;
            valid_lanes[rows].iter_mut().for_each(|row| row[k] = valid);
        }
        let tile = |i: usize| span_first(i / span_tiles) + i % span_tiles;
        let is_first = |i: &usize| *i == 0 || tile(*i).is_multiple_of(per_row);
        let is_last = |i: &usize| i + 1 == LANES || (tile(*i) + 1).is_multiple_of(per_row);
        let neighbour = |i: usize, at: isize| {
            let Column { start, x, rows } = column(tile(i), at);
            let mut valid = [false; MAX_ROWS];
            valid[rows].fill(self.has(x));
            NeighbourColumn { lane: 1 << transpose4x4_index(i), start, valid }
        };
        let next = own + T::INPUT_STEP as isize;
        let before = (0..LANES).filter(is_first).map(|i| neighbour(i, own - 1)).collect();
        let after = (0..LANES).filter(is_last).map(|i| neighbour(i, next)).collect();
        Spans { starts, valid_lanes, before, after }
    }
}

/// Loads the tiles of some channels and writes Bᵀ·d·B to `tiles`. All directions call it as a
/// function of its own ([`Simd::call`]).
pub(super) struct LoadChannels<'a, T, const IN: usize, const POINTS: usize, const OUT: usize> {
    pub loader: &'a TileLoader<'a>,
    /// Source, from the first channel on.
    pub x: &'a [f32],
    /// Floats from channel to channel of `x`.
    pub pixels: usize,
    pub channels: usize,
    /// Memory for a packed channel.
    pub packed: &'a mut Buffer,
    /// Layout of `tiles`.
    pub layout: &'a ProductLayout,
    pub tiles: &'a mut [f32],
    pub transform: PhantomData<T>,
}

impl<T, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for LoadChannels<'_, T, IN, POINTS, OUT>
where
    T: Transform<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { loader, x, pixels, packed, layout, tiles, .. } = self;
        let rows = &mut [[s.splat(0.0); POINTS]; IN];
        for c in 0..self.channels {
            let scratch = LoadScratch { packed: &mut *packed, rows: &mut *rows };
            loader.load::<S, T, IN, POINTS, OUT>(s, &x[c * pixels..], scratch, layout, c, tiles);
        }
    }
}

/// Memory that [`TileLoader::load`] works in.
struct LoadScratch<'a, V, const IN: usize, const POINTS: usize> {
    /// A packed channel.
    packed: &'a mut Buffer,
    /// Rows of sixteen tiles, transformed along themselves. Cleared once per job, not once
    /// per channel.
    rows: &'a mut [[V; POINTS]; IN],
}

impl TileLoader<'_> {
    /// Loads the tiles of a channel, which begins at `x[0]`, and writes Bᵀ·d·B to channel
    /// `channel` of `tiles`.
    #[inline(always)]
    fn load<S, T, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        LoadScratch { packed, rows }: LoadScratch<'_, S::F, IN, POINTS>,
        layout: &ProductLayout,
        channel: usize,
        tiles: &mut [f32],
    ) where
        S: Simd,
        T: Transform<IN, POINTS, OUT>,
    {
        let x = &x[..self.floats];
        let source = match &self.source {
            Source::InPlace(vectors) => {
                for (v, spans) in vectors.iter().enumerate() {
                    for r in 0..IN {
                        let row = self.row::<S, T, IN, POINTS, OUT>(s, x, spans, r);
                        copy_vectors(&mut rows[r], T::inputs(s, row));
                    }
                    let to = layout.vectors(channel, v * LANES);
                    store_tiles::<S, T, IN, POINTS, OUT>(s, rows, tiles, layout, to);
                }
                return;
            }
            Source::Packed(source) => source,
        };
        let pixels = source.reader.src_pixels();
        let channel_stride = source.layout.channel_stride;
        let images = x.chunks(source.image_stride);
        let packed = packed.floats(images.len() * channel_stride + OVERREAD);
        for (x, out) in images.zip(packed.chunks_exact_mut(channel_stride)) {
            let plan = source.reader;
            let layout = &source.layout;
            let start = source.start;
            s.call(PackTile { plan, layout, x: &x[..pixels], start, out });
        }
        for (v, starts) in source.tile_starts.iter().enumerate() {
            for r in 0..IN {
                let mut row = [s.splat(0.0); IN];
                for part in 0..IN.div_ceil(4) {
                    let four = s.gather4(packed, starts, r * self.row_stride + part * 4);
                    for j in 0..4 {
                        if part * 4 + j < IN {
                            row[part * 4 + j] = four[j];
                        }
                    }
                }
                copy_vectors(&mut rows[r], T::inputs(s, row));
            }
            let to = layout.vectors(channel, v * LANES);
            store_tiles::<S, T, IN, POINTS, OUT>(s, rows, tiles, layout, to);
        }
    }

    /// Loads row `r` of sixteen tiles from the images: one vector per column.
    #[inline(always)]
    fn row<S, T, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        Spans { starts, valid_lanes, before, after }: &Spans,
        r: usize,
    ) -> [S::F; IN]
    where
        S: Simd,
        T: Transform<IN, POINTS, OUT>,
    {
        let down = (r * self.row_stride) as isize;
        let mut v = [s.splat(0.0); 8];
        for k in 0..T::INPUT_STEP {
            let from = x.as_ptr().wrapping_offset(starts[k] + down);
            // The same row of the next channel: hardware does not predict such steps.
            s.prefetch_l2(from.wrapping_add(self.floats));
            // SAFETY: `valid_lanes` marks the lanes inside the image, and `x` holds all
            // `floats` of the channel.
            v[k] = unsafe { s.load_masked(from, valid_lanes[r][k]) };
        }
        let own = match T::INPUT_STEP {
            8 => s.columns_of_8(v),
            _ => {
                let [a, b, c, d] = s.transpose_quarters([v[0], v[1], v[2], v[3]]);
                [a, b, c, d, v[4], v[5], v[6], v[7]]
            }
        };
        let first = T::INPUTS_BEFORE;
        let last = T::INPUTS_BEFORE + T::INPUT_STEP;
        let mut row = [s.splat(0.0); IN];
        for j in 0..IN {
            row[j] = match j {
                _ if j < first => {
                    let column = s.rotate_right(own[T::INPUT_STEP - 1]);
                    insert_neighbours(s, column, before, x, r, down)
                }
                _ if j < last => own[j - first],
                _ => insert_neighbours(s, s.rotate_left(own[0]), after, x, r, down),
            };
        }
        row
    }
}

/// Returns `column` with row `r` of `neighbours` in their lanes; that row lies `down` floats
/// after a neighbour's start.
#[inline(always)]
fn insert_neighbours<S: Simd>(
    s: S,
    mut column: S::F,
    neighbours: &[NeighbourColumn],
    x: &[f32],
    r: usize,
    down: isize,
) -> S::F {
    for neighbour in neighbours {
        let from = x.as_ptr().wrapping_offset(neighbour.start + down);
        s.prefetch_l2(from.wrapping_add(x.len()));
        // SAFETY: by `valid` the image has this place, and `x` holds the whole
        // channel of the image.
        let v = if neighbour.valid[r] { unsafe { *from } } else { 0.0 };
        column = s.mask_from_bits(neighbour.lane).select(s.splat(v), column);
    }
    column
}

/// Transforms the columns of sixteen tiles and stores them at `to` in `tiles`.
#[inline(always)]
fn store_tiles<S, T, const IN: usize, const POINTS: usize, const OUT: usize>(
    s: S,
    rows: &[[S::F; POINTS]; IN],
    tiles: &mut [f32],
    layout: &ProductLayout,
    to: ProductVectors<'_>,
) where
    S: Simd,
    T: Transform<IN, POINTS, OUT>,
{
    assert!(tiles.len() >= layout.floats);
    let tiles = tiles.as_mut_ptr();
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); IN];
        for i in 0..IN {
            column[i] = rows[i][j];
        }
        let column = T::inputs(s, column);
        for i in 0..POINTS {
            let to = tiles.wrapping_add(to.place(POINTS, i, j));
            // SAFETY: `to` lies inside `layout`, which lies inside `tiles` (asserted).
            s.store(column[i], unsafe { &mut *to.cast() });
        }
    }
}
