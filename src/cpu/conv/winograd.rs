//! 3×3 convolutions of stride 1 and 2 by the forms of [`super::forms`], two of them
//! nested: 36 products for 16 outputs where the definition needs 144, of stride 2 81.
//!
//! Lanes are tiles, in the transforms and in the products, which are 36 matrix products
//! over channels; one block's transformed tiles stay in the second-level cache.

use super::forms::{Down, Form, GROUPS, Places, TILE, Unit, Up, WEIGHTS};
use super::plan::{Axes, Layout, Plan, Sizes, pack};
use super::shift::{Block, ROWS, Strip, blocks};
use super::{Buffer, Buffers};
use crate::cpu::disjoint::Disjoint;
use crate::cpu::fresh;
use crate::cpu::simd::{Kernel, LANES, Simd, Tier};
use rayon::prelude::*;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Most vectors of tiles at once.
const VECTORS: usize = 3;
/// Floats of the transformed tiles of a block, unless one vector needs more.
const FLOATS: usize = 300_000;
/// Least channels on both sides, and tiles of a picture, for which it wins.
const CHANNELS: usize = 24;
const TILES: usize = 16;
/// Tiles of a picture below which [`super::winograd_few`] is better.
const FEW: usize = 48;
/// Floats past a packed patch's end that may be read and not used.
pub(super) const SLACK: usize = 2 * LANES;

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
        let wins = plan.src_channels.min(plan.dst_channels) >= CHANNELS && tiles_of(plan) >= TILES;
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
}

/// Tiles of a picture.
pub(super) fn tiles_of(plan: &Plan) -> usize {
    let [depth, height, width] = plan.grid();
    depth * height.div_ceil(TILE) * width.div_ceil(TILE)
}

/// Transformed weights: for each block of output channels
/// `[group][source channel][channel of the block]`.
#[derive(Clone, Debug)]
pub(crate) struct Weights {
    data: Vec<f32>,
    blocks: Vec<Block>,
}

impl Weights {
    /// Of `w` as the caller stores them, in the memory of `data`.
    pub fn new(tier: Tier, plan: &Plan, way: Way, w: &[f32], mut data: Vec<f32>) -> Self {
        let blocks = blocks(plan.dst_channels);
        let depth = plan.src_channels * GROUPS;
        data.resize(blocks.iter().map(|b| b.pitch * depth).sum(), 0.0);
        data.par_chunks_mut(ROWS * depth)
            .zip(&blocks)
            .for_each(|(panel, block)| tier.run(Transform { plan, way, w, block, panel }));
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
    fn run<S: Simd>(self, _: S) {
        match self.way {
            Way::Unit => self.with::<Unit, 6, 6, 4>(),
            Way::Down => self.with::<Down, 9, 9, 4>(),
            Way::Up => self.with::<Up, 5, 9, 8>(),
        }
    }
}

impl Transform<'_> {
    #[inline(always)]
    fn with<F, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        F: Form<IN, POINTS, OUT>,
    {
        let Self { plan, w, block, panel, .. } = self;
        let channels = plan.src_channels;
        for src in 0..channels {
            // By place in what a tile reads, channels of the block innermost.
            let mut g = [[[0.0; ROWS]; 3]; 3];
            for m in 0..block.rows {
                let dst = block.first + m;
                let row = match plan.transposed {
                    true => src * plan.dst_channels + dst,
                    false => dst * channels + src,
                };
                let taps = &w[row * 9..][..9];
                for tap in 0..9 {
                    // A gradient reads backwards.
                    let place = if plan.transposed { 8 - tap } else { tap };
                    g[place / 3][place % 3][m] = taps[tap];
                }
            }
            let mut half = [[[0.0; ROWS]; 3]; WEIGHTS];
            for x in 0..3 {
                let column = F::weights([g[0][x], g[1][x], g[2][x]]);
                for i in 0..WEIGHTS {
                    half[i][x] = column[i];
                }
            }
            for i in 0..WEIGHTS {
                for (j, weight) in F::weights(half[i]).into_iter().enumerate() {
                    let at = ((i * WEIGHTS + j) * channels + src) * block.pitch;
                    panel[at..at + block.pitch].copy_from_slice(&weight[..block.pitch]);
                }
            }
        }
    }
}

/// Runs `plan` on pictures `x` into `y`, which is overwritten; `bias` is empty or one
/// value a channel written.
pub(crate) fn run(
    tier: Tier,
    plan: &Plan,
    way: Way,
    x: &[f32],
    w: &Weights,
    bias: &[f32],
    y: &mut fresh::Block<f32>,
) {
    let call = Call { tier, plan, reader: way.reader(plan), x, w, bias };
    match way {
        Way::Unit => call.run::<Unit, 6, 6, 4>(y),
        Way::Down => call.run::<Down, 9, 9, 4>(y),
        Way::Up => call.run::<Up, 5, 9, 8>(y),
    }
}

/// What all blocks of tiles have in common.
struct Call<'a> {
    tier: Tier,
    plan: &'a Plan,
    reader: Plan,
    x: &'a [f32],
    w: &'a Weights,
    bias: &'a [f32],
}

impl Call<'_> {
    fn run<F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        y: &mut fresh::Block<f32>,
    ) where
        F: Form<IN, POINTS, OUT>,
    {
        let plan = self.plan;
        let dst: usize = plan.dst_size.iter().product();
        let images = y.len() / (plan.dst_channels * dst);
        let [_, height, width] = plan.grid();
        // Tiles of a block: rows of at most 16.
        let vectors = FLOATS / (POINTS * POINTS * LANES * plan.src_channels);
        let across = width.div_ceil(TILE).min(LANES);
        let down = (vectors.clamp(1, VECTORS) * LANES / across).clamp(1, height.div_ceil(TILE));
        let layout = self.reader.layout([1, down * F::READ, across * F::READ]);
        let starts = super::plan::starts(plan.grid(), [1, down * TILE, across * TILE]);
        let y = Disjoint::new(y);
        (0..images * starts.len()).into_par_iter().for_each(|job| {
            let (image, start) = (job / starts.len(), starts[job % starts.len()]);
            Buffers::with(|buffers| {
                let tiles = [down, across];
                let form = PhantomData::<F>;
                let job = Job { call: self, layout, tiles, image, start, buffers, y: &y, form };
                self.tier.run::<Job<'_, F, IN, POINTS, OUT>>(job);
            });
        });
    }
}

/// A block of tiles, all channels.
struct Job<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a>,
    layout: Layout,
    /// Rows and columns of tiles of a whole block.
    tiles: [usize; 2],
    image: usize,
    /// Grid position.
    start: Axes,
    buffers: &'a mut Buffers,
    y: &'a Disjoint<'a, MaybeUninit<f32>>,
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
        let Call { plan, ref reader, x, w, bias, .. } = *self.call;
        let (layout, grid) = (self.layout, plan.grid());
        let Buffers { x: patch, tiles, products, .. } = self.buffers;
        let inside = |a: usize| self.tiles[a - 1].min((grid[a] - self.start[a]).div_ceil(TILE));
        let [down, across] = [inside(1), inside(2)];
        let count = down * across;
        let block = Tiles { count, across, picture: count };
        let length = block.count.next_multiple_of(LANES);
        let places = block.places(&layout, F::READ);
        // Off a power of two, lest all groups share one cache set.
        let sources = Places::new(POINTS, plan.src_channels, length, LANES);
        let sums = &Places::new(POINTS, ROWS, length, 0);
        let patch = patch.room(layout.channel + SLACK);
        let tiles = tiles.room(sources.floats);
        let pixels: usize = plan.src_size.iter().product();
        let channels = plan.src_channels;
        let [depth, top, left] = self.start;
        let from = [depth, top * F::READ / TILE, left * F::READ / TILE];
        let picture = &x[self.image * channels * pixels..][..channels * pixels];
        for (c, x) in picture.chunks_exact(pixels).enumerate() {
            pack(reader, &layout, x, from, &mut patch[..layout.channel]);
            for (v, places) in places.iter().enumerate() {
                let points = transform::<S, F, IN, POINTS, OUT>(s, patch, places, layout.pitch());
                scatter(s, &points, tiles, &sources, [c, v * LANES]);
            }
        }
        let weights = channels * GROUPS;
        for (index, part) in w.blocks.iter().enumerate() {
            let panel = &w.data[index * ROWS * weights..][..part.pitch * weights];
            let corner = [top, left].map(|v| v * OUT / TILE);
            let to = Outputs { plan, y: self.y, image: self.image, depth, corner, block };
            let product =
                Product { x: tiles, sources: &sources, sums, stride: None, part, panel, bias };
            product.run::<S, F, IN, POINTS, OUT>(s, products, to);
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
        to: Outputs<'_>,
    ) where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let (part, channels) = (self.part, to.plan.src_channels);
        let length = to.block.count.next_multiple_of(LANES);
        let sums = self.sums;
        let products = products.room(sums.floats);
        for (i, w) in self.panel.chunks_exact(part.pitch * channels).enumerate() {
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
            strip.run(s, part.pitch, &mut products[to..][..ROWS * length]);
        }
        for m in 0..part.rows {
            let channel = part.first + m;
            let bias = self.bias.get(channel).copied().unwrap_or(0.0);
            for first in (0..length).step_by(LANES) {
                let rows = columns::<S, F, IN, POINTS, OUT>(s, products, sums, [m, first]);
                to.finish::<S, F, IN, POINTS, OUT>(s, rows, bias, [channel, first]);
            }
        }
    }
}

/// The tiles of a block, row by row, of one picture after the other.
#[derive(Clone, Copy)]
pub(super) struct Tiles {
    pub count: usize,
    /// Tiles of a row.
    pub across: usize,
    /// Tiles of a picture.
    pub picture: usize,
}

impl Tiles {
    /// Where each vector of tiles begins in a packed channel of all pictures, `read` places
    /// from tile to tile. Lanes beyond the last tile repeat earlier ones.
    pub fn places(self, layout: &Layout, read: usize) -> Vec<Lanes> {
        let group = LANES / read;
        let place = |t: usize| {
            let last = self.count.saturating_sub(group) + t % group;
            let t = if t < self.count { t } else { last.min(self.count - 1) };
            let (picture, t) = (t / self.picture, t % self.picture);
            let place = (t / self.across * layout.pitch() + t % self.across) * read;
            picture * layout.channel + place
        };
        let vector = |first: usize| {
            let at: [usize; LANES] = std::array::from_fn(|i| place(first + i));
            let joined = (0..LANES).all(|i| at[i] == at[i / group * group] + i % group * read);
            Lanes { at, joined }
        };
        (0..self.count).step_by(LANES).map(vector).collect()
    }
}

/// Sixteen tiles in a packed channel.
pub(super) struct Lanes {
    at: [usize; LANES],
    /// Whether those whose places make whole vectors lie one behind the other.
    joined: bool,
}

impl Lanes {
    /// One row of the tiles, `offset` behind their first; `READ` as the form's.
    #[inline(always)]
    fn row<S: Simd, const IN: usize>(
        &self,
        s: S,
        x: &[f32],
        offset: usize,
        read: usize,
    ) -> [S::F; IN] {
        let mut row = [s.splat(0.0); IN];
        if self.joined && read == 8 {
            for first in (0..IN).step_by(8) {
                let mut v = [s.splat(0.0); 8];
                for k in 0..8 {
                    if let Some(x) = x[self.at[2 * k] + offset + first..].first_chunk() {
                        v[k] = s.load(x);
                    }
                }
                for (to, v) in row[first..].iter_mut().zip(s.columns8(v)) {
                    *to = v;
                }
            }
        } else if self.joined {
            for first in (0..IN).step_by(4) {
                let mut v = [s.splat(0.0); 4];
                for k in 0..4 {
                    if let Some(x) = x[self.at[4 * k] + offset + first..].first_chunk() {
                        v[k] = s.load(x);
                    }
                }
                for (to, v) in row[first..].iter_mut().zip(s.columns4(v)) {
                    *to = v;
                }
            }
        } else {
            for first in (0..IN).step_by(4) {
                let four = s.load4(x, &self.at, offset + first);
                for (to, v) in row[first..].iter_mut().zip(four) {
                    *to = v;
                }
            }
        }
        row
    }
}

/// Transformed tiles of a packed channel.
#[inline(always)]
pub(super) fn transform<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
    s: S,
    x: &[f32],
    lanes: &Lanes,
    pitch: usize,
) -> [[S::F; POINTS]; POINTS]
where
    S: Simd,
    F: Form<IN, POINTS, OUT>,
{
    let mut rows = [[s.splat(0.0); POINTS]; IN];
    for r in 0..IN {
        rows[r] = F::points(s, lanes.row(s, x, r * pitch, F::READ));
    }
    let mut out = [[s.splat(0.0); POINTS]; POINTS];
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); IN];
        for i in 0..IN {
            column[i] = rows[i][j];
        }
        let column = F::points(s, column);
        for i in 0..POINTS {
            out[i][j] = column[i];
        }
    }
    out
}

/// Writes a vector of transformed tiles, from tile `first` of channel `c` on.
#[inline(always)]
pub(super) fn scatter<S: Simd, const POINTS: usize>(
    s: S,
    points: &[[S::F; POINTS]; POINTS],
    tiles: &mut [f32],
    places: &Places,
    [c, first]: [usize; 2],
) {
    for i in 0..POINTS {
        for j in 0..POINTS {
            let p = i * POINTS + j;
            let to = &mut tiles[places.at[p] + c * places.step[p] + first..];
            if let Some(to) = to.first_chunk_mut() {
                s.store(points[i][j], to);
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
) -> [[S::F; POINTS]; OUT]
where
    S: Simd,
    F: Form<IN, POINTS, OUT>,
{
    let mut rows = [[s.splat(0.0); POINTS]; OUT];
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); POINTS];
        for i in 0..POINTS {
            let p = i * POINTS + j;
            let from = &products[places.at[p] + m * places.step[p] + first..];
            if let Some(from) = from.first_chunk() {
                column[i] = s.load(from);
            }
        }
        let column = F::outputs(s, column);
        for i in 0..OUT {
            rows[i][j] = column[i];
        }
    }
    rows
}

/// Where a block's outputs go.
pub(super) struct Outputs<'a> {
    pub plan: &'a Plan,
    pub y: &'a Disjoint<'a, MaybeUninit<f32>>,
    /// The first picture.
    pub image: usize,
    pub depth: usize,
    /// Row and column of the first.
    pub corner: [usize; 2],
    pub block: Tiles,
}

impl Outputs<'_> {
    /// Transforms the rows of sixteen tiles of `channel` from `first` on, and writes them.
    #[inline(always)]
    fn finish<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        rows: [[S::F; POINTS]; OUT],
        bias: f32,
        at: [usize; 2],
    ) where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let bias = s.splat(bias);
        for (r, row) in rows.into_iter().enumerate() {
            let mut row = F::outputs(s, row);
            for v in &mut row {
                *v = *v + bias;
            }
            self.write(s, row, at, r);
        }
    }

    /// Writes row `r` of sixteen tiles from `first` on; what lies beyond the border is
    /// dropped.
    #[inline(always)]
    fn write<S: Simd, const OUT: usize>(
        &self,
        s: S,
        v: [S::F; OUT],
        [channel, first]: [usize; 2],
        r: usize,
    ) {
        let mut rows = [[0.0; LANES]; OUT];
        if OUT == 8 {
            let mut eight = [v[0]; 8];
            eight.iter_mut().zip(v).for_each(|(to, v)| *to = v);
            for (to, v) in rows.iter_mut().zip(s.rows8(eight)) {
                s.store(v, to);
            }
        } else {
            let mut four = [v[0]; 4];
            four.iter_mut().zip(v).for_each(|(to, v)| *to = v);
            for (to, v) in rows.iter_mut().zip(s.rows4(four)) {
                s.store(v, to);
            }
        }
        let [_, height, width] = self.plan.dst_size;
        let Tiles { count, across, .. } = self.block;
        let group = LANES / OUT;
        for k in 0..OUT {
            let t = first + k * group;
            let (plane, row, column) = self.place(channel, t, OUT);
            let row = row + r;
            // Tiles of one row, none of them cut.
            if t + group <= count
                && t % across + group <= across
                && row < height
                && column + LANES <= width
            {
                let at = (plane * height + row) * width + column;
                // SAFETY: no two jobs, and no two tiles of a job, hold the same outputs.
                let to = unsafe { self.y.part(at..at + LANES) };
                if let Some(to) = to.first_chunk_mut() {
                    *to = rows[k].map(MaybeUninit::new);
                }
                continue;
            }
            for (i, tile) in rows[k].as_chunks::<OUT>().0.iter().enumerate() {
                let (plane, row, column) = self.place(channel, t + i, OUT);
                let row = row + r;
                if t + i >= count || row >= height || column >= width {
                    continue;
                }
                let at = (plane * height + row) * width + column;
                // SAFETY: as above.
                let to = unsafe { self.y.part(at..at + OUT.min(width - column)) };
                to.iter_mut().zip(tile).for_each(|(to, v)| *to = MaybeUninit::new(*v));
            }
        }
    }

    /// Slice of y, over pictures, channels and depths, row and column of tile `t`.
    #[inline(always)]
    fn place(&self, channel: usize, t: usize, out: usize) -> (usize, usize, usize) {
        let Tiles { across, picture, .. } = self.block;
        let (image, t) = (self.image + t / picture, t % picture);
        let channel = image * self.plan.dst_channels + channel;
        let plane = channel * self.plan.dst_size[0] + self.depth;
        (plane, self.corner[0] + t / across * out, self.corner[1] + t % across * out)
    }
}
