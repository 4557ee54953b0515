//! 3×3 convolutions of stride 1 and 2 by the forms of [`super::forms`], two of them
//! nested: 36 products for 16 outputs where the definition needs 144, of stride 2 81.
//!
//! Lanes are tiles, in the transforms and in the products, which are 36 matrix products
//! over channels; one block's transformed tiles stay in the second-level cache.

use super::forms::{Down, Form, GROUPS, Places, TILE, Unit, Up, WEIGHTS};
use super::gather::{Gather, Tiles};
use super::plan::{Axes, Plan, Sizes};
use super::shift::{Block, ROWS, Strip, blocks};
use super::{Buffer, Buffers};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel, transpose4x4_index};
use crate::cpu::uninit::{self, grown};
use rayon::prelude::*;
use std::array::from_fn;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Most vectors of tiles at once.
const VECTORS: usize = 2;
/// Floats of the transformed tiles of a block, unless one vector needs more.
const FLOATS: usize = 300_000;
/// Least channels on both sides for which it wins.
const CHANNELS: usize = 24;
/// Tiles of a picture below which [`super::winograd_few`] is better.
const FEW: usize = 48;

/// Source channels whose weights are asked for before their turn.
const AHEAD: usize = 8;

/// What the algorithm does for a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    /// Stride 1.
    Unit,
    /// Stride 2.
    Down,
    /// The gradient of that.
    Up,
}

impl Way {
    /// Which it is, if `plan` can be, and had better be, run here.
    pub fn of(plan: &Plan) -> Option<Self> {
        let (whole, halves) = ([1; 3], [1, 2, 2]);
        let parts = (plan.passes.len(), plan.planes.len());
        // Taps of nine places and such a span are those of 3×3.
        let way = match (plan.span, parts) {
            ([0, 2, 2], (1, 1)) if [plan.src_step, plan.dst_step] == [whole; 2] => Self::Unit,
            ([0, 1, 1], (1, 4)) if [plan.src_step, plan.dst_step] == [halves, whole] => Self::Down,
            ([0, 1, 1], (4, 1))
                if [plan.src_step, plan.dst_step] == [whole, halves] && plan.origin == [0; 3] =>
            {
                Self::Up
            }
            _ => return None,
        };
        let wins = plan.src_channels.min(plan.dst_channels) >= CHANNELS;
        (plan.kernel_taps == 9 && wins).then_some(way)
    }

    /// Whether `plan`'s pictures are so small that they are better taken all at once.
    pub fn few(plan: &Plan) -> bool {
        plan.dst_size[0] == 1 && tiles_of(plan) < FEW
    }

    /// How the tiles of `plan` are read: every place between the first and the last.
    pub fn reader(self, plan: &Plan) -> Plan {
        if self != Self::Down {
            return plan.clone();
        }
        // A kernel of two places reaches one place beyond its tile.
        Plan::forward(&Sizes {
            in_channels: plan.src_channels,
            out_channels: plan.dst_channels,
            kernel: [1, 2, 2],
            stride: [1; 3],
            padding: plan.before(),
            size: plan.src_size,
        })
    }

    /// Does `work` in the form that this is.
    #[inline(always)]
    pub fn give<W: Formed>(self, work: W) {
        match self {
            Self::Unit => work.with::<Unit, 6, 6, 4>(),
            Self::Down => work.with::<Down, 9, 9, 4>(),
            Self::Up => work.with::<Up, 5, 9, 8>(),
        }
    }
}

/// Work in any form.
pub(super) trait Formed {
    fn with<F, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        F: Form<IN, POINTS, OUT>;
}

/// Tiles of a picture.
pub(super) fn tiles_of(plan: &Plan) -> usize {
    let [depth, height, width] = plan.grid();
    depth * height.div_ceil(TILE) * width.div_ceil(TILE)
}

/// Floats from group to group of the weights of a block: off a power of two, lest all
/// groups share one cache set.
pub(super) fn group_step(channels: usize) -> usize {
    channels * ROWS + LANES
}

/// Transformed weights: for each block of output channels
/// `[group][source channel][channel of the block]`, groups [`group_step`] apart.
#[derive(Clone, Debug)]
pub(crate) struct Weights {
    data: Vec<f32>,
    blocks: Vec<Block>,
}

impl Weights {
    /// Of `w` as the caller stores them, in the memory of `data`.
    pub fn new(level: SimdLevel, plan: &Plan, way: Way, w: &[f32], mut data: Vec<f32>) -> Self {
        let blocks = blocks(plan.dst_channels);
        let floats = GROUPS * group_step(plan.src_channels);
        grown(&mut data, blocks.len() * floats)
            .par_chunks_exact_mut(floats)
            .zip(&blocks)
            .for_each(|(panel, block)| level.run(Transform { plan, way, w, block, panel }));
        Self { data, blocks }
    }

    /// Its memory, for other weights.
    pub fn into_memory(self) -> Vec<f32> {
        self.data
    }
}

/// G·g·Gᵀ of the weights of one block.
pub(super) struct Transform<'a> {
    pub plan: &'a Plan,
    pub way: Way,
    pub w: &'a [f32],
    pub block: &'a Block,
    /// `[group][source channel][channel of the block]`.
    pub panel: &'a mut [f32],
}

impl Kernel for Transform<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.way.give(Lanes(s, self));
    }
}

/// Work on vectors.
struct Lanes<S, W>(S, W);

impl<S: Simd> Formed for Lanes<S, Transform<'_>> {
    #[inline(always)]
    fn with<F, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        F: Form<IN, POINTS, OUT>,
    {
        let Self(s, Transform { plan, w, block, panel, .. }) = self;
        let channels = plan.src_channels;
        let ahead = AHEAD * 9 * if plan.transposed { plan.dst_channels } else { 1 };
        // Lanes are two source channels, each with the channels of the block.
        for first in (0..channels).step_by(2) {
            let mut kernels = [s.splat(0.0); LANES];
            for lane in 0..LANES {
                let (src, m) = (first + lane / ROWS, lane % ROWS);
                if src >= channels || m >= block.rows {
                    continue;
                }
                let dst = block.first + m;
                let row = match plan.transposed {
                    true => src * plan.dst_channels + dst,
                    false => dst * channels + src,
                };
                let taps = &w[row * 9..][..9];
                s.prefetch(taps.as_ptr().wrapping_add(ahead));
                // SAFETY: nine are there.
                kernels[lane] = unsafe { s.load_masked(taps.as_ptr(), 0x1ff) };
            }
            let taps = s.transpose(kernels);
            let mut half = [[s.splat(0.0); 3]; WEIGHTS];
            for x in 0..3 {
                let column = match plan.transposed {
                    // A gradient reads backwards.
                    true => [taps[8 - x], taps[5 - x], taps[2 - x]],
                    false => [taps[x], taps[3 + x], taps[6 + x]],
                };
                let column = F::weights(s, column);
                for i in 0..WEIGHTS {
                    half[i][x] = column[i];
                }
            }
            for i in 0..WEIGHTS {
                let row = F::weights(s, half[i]);
                for j in 0..WEIGHTS {
                    let group = (i * WEIGHTS + j) * group_step(channels);
                    let to = &mut panel[group + first * block.rows..];
                    // What lies past the last channel is between groups.
                    if block.rows == ROWS
                        && let Some(to) = to.first_chunk_mut()
                    {
                        s.store(row[j], to);
                        continue;
                    }
                    let mut both = [0.0; LANES];
                    s.store(row[j], &mut both);
                    let to = to.chunks_exact_mut(block.rows).take(channels - first);
                    for (to, from) in to.zip(both.chunks_exact(ROWS)) {
                        to.copy_from_slice(&from[..block.rows]);
                    }
                }
            }
        }
    }
}

/// Runs `plan` on pictures `x` into `y`, which is overwritten; `bias` is empty or one
/// value a channel written.
pub(crate) fn run(
    level: SimdLevel,
    plan: &Plan,
    way: Way,
    x: &[f32],
    w: &Weights,
    bias: &[f32],
    y: &mut uninit::UninitSlice<f32>,
) {
    way.give(&Call::new(level, plan, way, x, w, bias, y));
}

/// What all jobs have in common.
pub(super) struct Call<'a, W: ?Sized> {
    pub level: SimdLevel,
    pub plan: &'a Plan,
    pub way: Way,
    pub reader: Plan,
    pub x: &'a [f32],
    pub w: &'a W,
    pub bias: &'a [f32],
    pub images: usize,
    pub y: SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl<'a, W: ?Sized> Call<'a, W> {
    pub fn new(
        level: SimdLevel,
        plan: &'a Plan,
        way: Way,
        x: &'a [f32],
        w: &'a W,
        bias: &'a [f32],
        y: &'a mut uninit::UninitSlice<f32>,
    ) -> Self {
        let pixels: usize = plan.dst_size.iter().product();
        let images = y.len() / (plan.dst_channels * pixels);
        let (reader, y) = (way.reader(plan), SharedSliceMut::new(y));
        Self { level, plan, way, reader, x, w, bias, images, y }
    }
}

impl Formed for &Call<'_, Weights> {
    fn with<F, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        F: Form<IN, POINTS, OUT>,
    {
        let plan = self.plan;
        let [_, height, width] = plan.grid();
        // Tiles of a block: rows of at most 16.
        let vectors = FLOATS / (POINTS * POINTS * LANES * plan.src_channels);
        let across = width.div_ceil(TILE).min(LANES);
        let down = (vectors.clamp(1, VECTORS) * LANES / across).clamp(1, height.div_ceil(TILE));
        let starts = super::plan::starts(plan.grid(), [1, down * TILE, across * TILE]);
        (0..self.images * starts.len()).into_par_iter().for_each(|job| {
            let (image, start) = (job / starts.len(), starts[job % starts.len()]);
            Buffers::with(|buffers| {
                let (tiles, form) = ([down, across], PhantomData::<F>);
                let job = Job { call: self, tiles, image, start, buffers, form };
                self.level.run::<Job<'_, F, IN, POINTS, OUT>>(job);
            });
        });
    }
}

/// A block of tiles, all channels.
struct Job<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a, Weights>,
    /// Rows and columns of tiles of a whole block.
    tiles: [usize; 2],
    image: usize,
    /// Grid position.
    start: Axes,
    buffers: &'a mut Buffers,
    form: PhantomData<F>,
}

impl<F, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for Job<'_, F, IN, POINTS, OUT>
where
    F: Form<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Call { plan, ref reader, x, w, bias, ref y, .. } = *self.call;
        let grid = plan.grid();
        let Buffers { x: patch, tiles, products, .. } = self.buffers;
        let inside = |a: usize| self.tiles[a - 1].min((grid[a] - self.start[a]).div_ceil(TILE));
        let [down, across] = [inside(1), inside(2)];
        let count = down * across;
        let block = Tiles { count, across, picture: count };
        let length = block.length();
        let gather = Gather::new::<F, IN, POINTS, OUT>(reader, block, self.start, x.len());
        // Off a power of two, lest all groups share one cache set.
        let sources = Places::new(POINTS, plan.src_channels, length, LANES);
        let sums = &Places::new(POINTS, ROWS, length, 0);
        let tiles = tiles.room(sources.floats);
        let pixels: usize = plan.src_size.iter().product();
        let channels = plan.src_channels;
        let picture = &x[self.image * channels * pixels..][..channels * pixels];
        let rows = &mut [[s.splat(0.0); POINTS]; IN];
        for (c, x) in picture.chunks_exact(pixels).enumerate() {
            gather.channel::<S, F, IN, POINTS, OUT>(s, x, patch, rows, tiles, (&sources, c));
        }
        let to = Outputs::new::<OUT>(plan, y, block, self.image, self.start);
        let panels = w.data.chunks_exact(GROUPS * group_step(channels));
        for (part, panel) in w.blocks.iter().zip(panels) {
            let product =
                Product { x: tiles, sources: &sources, sums, stride: None, part, panel, bias };
            product.run::<S, F, IN, POINTS, OUT>(s, products, &to);
        }
    }
}

/// A block of output channels of transformed tiles.
pub(super) struct Product<'a> {
    pub x: &'a [f32],
    pub sources: &'a Places,
    /// Of the products: [`ROWS`] channels.
    pub sums: &'a Places,
    /// From channel to channel of the tiles, where that is not the group's own length.
    pub stride: Option<usize>,
    pub part: &'a Block,
    /// Transformed weights of `part`.
    pub panel: &'a [f32],
    pub bias: &'a [f32],
}

impl Product<'_> {
    /// Multiplies, transforms back and writes.
    #[inline(always)]
    pub fn run<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        products: &mut Buffer,
        to: &Outputs<'_>,
    ) where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let (part, channels) = (self.part, to.plan.src_channels);
        let sums = self.sums;
        let products = products.room(sums.floats);
        for (i, w) in self.panel.chunks_exact(group_step(channels)).enumerate() {
            let ((at, length), (to, _)) = (self.sources.groups[i], sums.groups[i]);
            let strip = Strip {
                x: &self.x[at..],
                channel: self.stride.unwrap_or(length),
                channels,
                offsets: &[0],
                w,
                bias: [0.0; ROWS],
                length,
            };
            strip.run(s, part.rows, &mut products[to..][..ROWS * length]);
        }
        let mut rows = [[s.splat(0.0); POINTS]; OUT];
        for m in 0..part.rows {
            let channel = part.first + m;
            let bias = self.bias.get(channel).copied().unwrap_or(0.0);
            for (v, places) in to.places.iter().enumerate() {
                let at = [m, v * LANES];
                columns::<S, F, IN, POINTS, OUT>(s, products, sums, at, &mut rows);
                for r in 0..OUT {
                    let mut row = F::outputs(s, rows[r]);
                    for k in 0..OUT {
                        row[k] = row[k] + s.splat(bias);
                    }
                    to.write(s, row, channel, places, r);
                }
            }
        }
    }
}

/// Rows of outputs of sixteen tiles, not yet transformed along themselves.
#[inline(always)]
fn columns<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
    s: S,
    products: &[f32],
    places: &Places,
    [m, first]: [usize; 2],
    rows: &mut [[S::F; POINTS]; OUT],
) where
    S: Simd,
    F: Form<IN, POINTS, OUT>,
{
    assert!(products.len() >= places.floats);
    let (vectors, products) = (places.vectors(m, first), products.as_ptr());
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); POINTS];
        for i in 0..POINTS {
            let from = products.wrapping_add(vectors.place(POINTS, i, j));
            // SAFETY: inside `places` (its promise), and those inside `products` (asserted).
            column[i] = s.load(unsafe { &*from.cast() });
        }
        let column = F::outputs(s, column);
        for i in 0..OUT {
            rows[i][j] = column[i];
        }
    }
}

/// Where a block's outputs go, the same in every channel.
pub(super) struct Outputs<'a> {
    plan: &'a Plan,
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
    /// For each vector of tiles.
    places: Vec<Pieces>,
}

/// Where the outputs of sixteen tiles go.
enum Pieces {
    /// Vectors of a row of them, each as a whole.
    Whole([usize; 8]),
    /// By tiles.
    Tiles(Vec<Piece>),
}

struct Piece {
    lane: usize,
    at: usize,
    /// What the picture has of the tile.
    rows: usize,
    columns: usize,
}

impl<'a> Outputs<'a> {
    /// Of `tiles`, the first of which has the grid position `start` in picture `image`.
    pub fn new<const OUT: usize>(
        plan: &'a Plan,
        y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
        tiles: Tiles,
        image: usize,
        [depth, top, left]: Axes,
    ) -> Self {
        let Tiles { count, across, picture } = tiles;
        let [slices, height, width] = plan.dst_size;
        let piece = |t: usize| {
            // The tile's place among those of its vector, once they are in order.
            let lane = transpose4x4_index(tiles.lane(t) % LANES);
            let (image, t) = (image + t / picture, t % picture);
            let row = top * OUT / TILE + t / across * OUT;
            let column = left * OUT / TILE + t % across * OUT;
            let slice = image * plan.dst_channels * slices + depth;
            let at = (slice * height + row) * width + column;
            let [rows, columns] = [height.saturating_sub(row), width.saturating_sub(column)];
            Piece { lane, at, rows: rows.min(OUT), columns: columns.min(OUT) }
        };
        let vector = |first: usize| {
            let tiles: Vec<_> = (first..count.min(first + LANES)).map(piece).collect();
            let full = |p: &Piece| [p.rows, p.columns] == [OUT; 2];
            let joined = |group: &[Piece]| {
                let last = group.len() - 1;
                group[last].at == group[0].at + last * OUT
            };
            let group = LANES / OUT;
            let all = tiles.len() == LANES && tiles.iter().all(full);
            if !(all && tiles.chunks_exact(group).all(joined)) {
                return Pieces::Tiles(tiles);
            }
            Pieces::Whole(from_fn(|k| tiles.get(k * group).map_or(0, |piece| piece.at)))
        };
        let places = (0..count).step_by(LANES).map(vector).collect();
        Self { plan, y, places }
    }

    /// Writes row `r` of sixteen tiles of `channel`.
    #[inline(always)]
    fn write<S: Simd, const OUT: usize>(
        &self,
        s: S,
        v: [S::F; OUT],
        channel: usize,
        pieces: &Pieces,
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
        let pieces = match pieces {
            Pieces::Tiles(pieces) => pieces,
            Pieces::Whole(places) => {
                for k in 0..OUT {
                    let at = places[k] + down;
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
        let tiles = floats.as_flattened().as_chunks::<OUT>().0;
        for piece in pieces.iter().filter(|piece| r < piece.rows) {
            let at = piece.at + down;
            // SAFETY: as above.
            let to = unsafe { self.y.part(at..at + piece.columns) };
            to.iter_mut().zip(tiles[piece.lane]).for_each(|(to, v)| *to = MaybeUninit::new(v));
        }
    }
}
