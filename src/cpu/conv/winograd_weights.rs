//! ∂L/∂w of 3×3 convolutions of stride 1 and 2 by the adjoint of [`super::winograd`]: as
//! many products for each pair of channels and tile as there.
//!
//! With V = Bᵀ·x·B (lanes are tiles, as there) and Z = A·∂y·Aᵀ (lanes are output
//! channels), ∂w = Gᵀ·(Σ over tiles of V⊙Z)·G.

use super::Buffers;
use super::forms::{Adjoint, Down, Form, GROUPS, Places, TILE, Unit, WEIGHTS, put};
use super::gather::{Gather, Tiles};
use super::plan::{Axes, Plan};
use super::weights::{LANES_WIDE, ROWS, Tile, Work};
use super::winograd::{self, Way};
use crate::cpu::simd::{Kernel, LANES, Simd, first_lanes_bits};
use std::ops::Range;

/// Input channels of a job: at most, and at least for the sake of more jobs.
const CHANNELS: usize = 256;
const FEW_CHANNELS: usize = 16;
/// Output channels of a job at least.
const FEW_OUTPUTS: usize = 64;
/// Vectors of tiles at once.
const VECTORS: usize = 4;
/// Outputs whose tiles make one block, for `plan`.
pub(super) fn tile(plan: &Plan) -> Axes {
    let [_, height, width] = plan.dst_size.map(|n| n.div_ceil(TILE));
    let across = width.min(LANES);
    [1, (VECTORS * LANES / across).clamp(1, height) * TILE, across * TILE]
}

/// Pictures whose tiles make one block, where all of a picture's do.
pub(super) fn together(plan: &Plan) -> usize {
    (VECTORS * LANES / winograd::tiles_of(plan)).max(1)
}

/// Least tiles for which it wins.
pub(super) const LEAST: usize = 8;
/// Tiles of a group at least, since its products are to be transformed at the end.
const TILES: usize = 256;
/// Most groups.
const GROUPED: usize = 16;

/// Groups of tiles that are summed apart: a function of the sizes alone, so that sums
/// never depend on the threads.
pub(super) fn groups(tiles: usize) -> usize {
    (tiles / TILES).clamp(1, GROUPED)
}

/// Output and input channels of a job, for as many jobs as there are threads. Which
/// channels a job has shows in no sum.
pub(super) fn part([c, o]: [usize; 2], tiles: usize, threads: usize) -> (usize, usize) {
    let wanted = threads.div_ceil(groups(tiles));
    // Tiles are read and transformed in less time than gradients are.
    let outputs = wanted.min(o.div_ceil(FEW_OUTPUTS));
    let channels = wanted.div_ceil(outputs).min(c.div_ceil(FEW_CHANNELS));
    let channels = c.div_ceil(channels.max(c.div_ceil(CHANNELS)));
    (o.div_ceil(outputs).next_multiple_of(LANES), channels.next_multiple_of(ROWS))
}

/// Output channels in blocks of equal numbers of vectors.
fn blocks(outputs: &Range<usize>) -> Vec<Range<usize>> {
    let vectors = outputs.len().div_ceil(LANES);
    let size = vectors.div_ceil(vectors.div_ceil(LANES_WIDE / LANES).max(1)) * LANES;
    let starts = outputs.clone().step_by(size.max(LANES));
    starts.map(|first| first..(first + size).min(outputs.end)).collect()
}

/// Floats of a job's sums of products: for each block of output channels
/// `[group][channel][output]`.
pub(super) fn floats(work: &Work<'_>) -> usize {
    let channels = (work.rows / 9).next_multiple_of(ROWS);
    blocks(&work.outputs).iter().map(|b| GROUPS * channels * b.len().next_multiple_of(LANES)).sum()
}

/// Adds one block of tiles to `products`, or begins them with it.
pub(super) struct Products<'a, 'b> {
    pub work: &'a Work<'b>,
    pub way: Way,
    /// [`Way::reader`] of the work's plan.
    pub reader: &'a Plan,
    /// From the job's first channel of a picture to its last, of the last picture.
    pub x: &'a [f32],
    /// Of the same pictures.
    pub dy: &'a [f32],
    pub start: Axes,
    /// Of the job: `products` holds nothing yet.
    pub first: bool,
    pub buffers: &'a mut Buffers,
    pub products: &'a mut [f32],
}

impl Kernel for Products<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        match self.way {
            Way::Down => self.with::<S, Down, 9, 9>(s),
            _ => self.with::<S, Unit, 6, 6>(s),
        }
    }
}

impl Products<'_, '_> {
    #[inline(always)]
    fn with<S, F, const IN: usize, const POINTS: usize>(self, s: S)
    where
        S: Simd,
        F: Form<IN, POINTS, TILE> + Adjoint<POINTS>,
    {
        let work = self.work;
        let inside = work.inside(self.start);
        let [_, down, across] = inside.map(|n| n.div_ceil(TILE));
        let pixels = |size: Axes| size.into_iter().product::<usize>();
        let (x_pixels, dy_pixels) = (pixels(work.plan.src_size), pixels(work.plan.dst_size));
        let dy_apart = work.plan.dst_channels * dy_pixels;
        let (picture, channels) = (down * across, work.rows / 9);
        let count = self.dy.len() / dy_apart * picture;
        let block = Tiles { count, across, picture };
        let (length, lanes) = (block.length(), block.lanes());
        let apart = work.plan.src_channels * x_pixels;
        let gather = Gather::new::<F, IN, POINTS, TILE>(self.reader, block, self.start, apart);
        let sources = Places::new(POINTS, channels, length, LANES);
        let Buffers { x: patch, tiles, gradients, .. } = self.buffers;
        let tiles = tiles.room(sources.floats);
        let rows = &mut [[s.splat(0.0); POINTS]; IN];
        for c in 0..channels {
            let x = &self.x[c * x_pixels..];
            gather.channel::<S, F, IN, POINTS, TILE>(s, x, patch, rows, tiles, (&sources, c));
        }
        let zero = s.splat(0.0);
        let scratch = &mut Scratch { d: [[zero; LANES]; TILE], rows: [[zero; POINTS]; TILE] };
        let mut products = self.products;
        let rows = channels.next_multiple_of(ROWS);
        for outputs in blocks(&work.outputs) {
            let pitch = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at_mut(GROUPS * rows * pitch);
            products = rest;
            let part = Work { outputs, pitch, ..*work };
            // By lanes, each `pitch` gradients; off a power of two.
            let outward = Places::new(POINTS, 1, lanes * pitch, LANES);
            let gradients = gradients.room(outward.floats);
            if lanes > count {
                // Of lanes without a tile.
                gradients.fill(0.0);
            }
            for (first, dy) in (0..count).step_by(picture).zip(self.dy.chunks_exact(dy_apart)) {
                let part = Spread { work: &part, dy, start: self.start, inside, block, first };
                for row in 0..down {
                    part.row::<S, F, POINTS>(s, row, scratch, &outward, gradients);
                }
            }
            for i in 0..GROUPS {
                let ((at, step), (from, floats)) = (sources.groups[i], outward.groups[i]);
                let tile = Tile {
                    x: &tiles[at..][..channels * step],
                    x_pitch: length,
                    dy: &gradients[from..][..floats],
                    pitch,
                    count: step / length,
                    width: lanes,
                };
                let sums = own[i * rows * pitch..][..rows * pitch].chunks_exact_mut(ROWS * pitch);
                for (group, sums) in sums.enumerate() {
                    let mut offsets = [0; ROWS];
                    for m in 0..ROWS {
                        offsets[m] = (group * ROWS + m).min(channels - 1) * step;
                    }
                    tile.rows::<S, ROWS>(s, &offsets, !self.first, sums);
                }
            }
        }
    }
}

/// Vectors that [`Spread::row`] works in, lanes being channels.
struct Scratch<V, const POINTS: usize> {
    /// ∂L/∂y of sixteen columns.
    d: [[V; LANES]; TILE],
    /// A tile's, transformed along one axis.
    rows: [[V; POINTS]; TILE],
}

/// Z of a block of tiles, for one picture.
struct Spread<'a, 'b> {
    work: &'a Work<'b>,
    dy: &'a [f32],
    start: Axes,
    /// Outputs of the block that there are.
    inside: Axes,
    block: Tiles,
    /// The picture's first tile.
    first: usize,
}

impl Spread<'_, '_> {
    /// Of row `row` of tiles, to `out`: `[lane][channel]` of each product.
    #[inline(always)]
    fn row<S: Simd, F: Adjoint<POINTS>, const POINTS: usize>(
        &self,
        s: S,
        row: usize,
        Scratch { d, rows }: &mut Scratch<S::F, POINTS>,
        places: &Places,
        out: &mut [f32],
    ) {
        let Work { pitch, ref outputs, plan, .. } = *self.work;
        assert!(out.len() >= places.floats);
        let out = out.as_mut_ptr();
        let [_, height, width] = self.inside;
        let across = width.div_ceil(TILE);
        let channel: usize = plan.dst_size.iter().product();
        for v in (0..pitch).step_by(LANES) {
            let lanes = LANES.min(outputs.len().saturating_sub(v));
            for left in (0..width).step_by(LANES) {
                let columns = LANES.min(width - left);
                let bits = first_lanes_bits(columns);
                // To what is read next, in whose lines nothing else is near.
                let next = if left + LANES < width {
                    LANES
                } else if v + LANES < pitch {
                    (LANES * channel).wrapping_sub(left)
                } else {
                    (TILE * plan.dst_size[2]).wrapping_sub(v * channel + left)
                };
                for r in 0..TILE {
                    let mut m = [s.splat(0.0); LANES];
                    for i in 0..LANES {
                        if i >= lanes || row * TILE + r >= height {
                            continue;
                        }
                        let at = self.work.dy_at(outputs.start + v + i, self.start, 0)
                            + (row * TILE + r) * plan.dst_size[2]
                            + left;
                        let from = &self.dy[at..][..columns];
                        s.prefetch_l2(from.as_ptr().wrapping_add(next));
                        // SAFETY: as many are there.
                        m[i] = unsafe { s.load_masked(from.as_ptr(), bits) };
                    }
                    put(&mut d[r], s.transpose(m));
                }
                for t in 0..columns.div_ceil(TILE) {
                    for r in 0..TILE {
                        let d = &d[r];
                        let four = [d[t * TILE], d[t * TILE + 1], d[t * TILE + 2], d[t * TILE + 3]];
                        put(&mut rows[r], F::spread(s, four));
                    }
                    let lane = self.block.lane(self.first + row * across + left / TILE + t);
                    let vectors = places.vectors(0, lane * pitch + v);
                    for j in 0..POINTS {
                        let column = F::spread(s, [rows[0][j], rows[1][j], rows[2][j], rows[3][j]]);
                        for i in 0..POINTS {
                            let to = out.wrapping_add(vectors.place(POINTS, i, j));
                            // SAFETY: inside `places` (its promise), and those inside `out`
                            // (asserted above).
                            s.store(column[i], unsafe { &mut *to.cast() });
                        }
                    }
                }
            }
        }
    }
}

/// Turns a job's products into sums `[channel · 9 + tap][output]`.
pub(super) struct Finish<'a, 'b> {
    pub work: &'a Work<'b>,
    pub way: Way,
    pub products: &'a [f32],
    pub sums: &'a mut [f32],
}

impl Kernel for Finish<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        match self.way {
            Way::Down => self.with::<S, Down, 9>(s),
            _ => self.with::<S, Unit, 6>(s),
        }
    }
}

impl Finish<'_, '_> {
    #[inline(always)]
    fn with<S: Simd, F: Adjoint<POINTS>, const POINTS: usize>(self, s: S) {
        let channels = self.work.rows / 9;
        let rows = channels.next_multiple_of(ROWS);
        let total = self.work.outputs.len().next_multiple_of(LANES);
        let (mut products, mut column) = (self.products, 0);
        for outputs in blocks(&self.work.outputs) {
            let pitch = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at(GROUPS * rows * pitch);
            products = rest;
            let mut half = [[s.splat(0.0); 3]; WEIGHTS];
            for c in 0..channels {
                for v in (0..pitch).step_by(LANES) {
                    for i in 0..WEIGHTS {
                        let mut q = [s.splat(0.0); WEIGHTS];
                        for j in 0..WEIGHTS {
                            let at = ((i * WEIGHTS + j) * rows + c) * pitch + v;
                            if let Some(from) = own[at..].first_chunk() {
                                q[j] = s.load(from);
                            }
                        }
                        put(&mut half[i], F::taps(s, q));
                    }
                    for x in 0..3 {
                        let mut q = [s.splat(0.0); WEIGHTS];
                        for i in 0..WEIGHTS {
                            q[i] = half[i][x];
                        }
                        let g = F::taps(s, q);
                        for y in 0..3 {
                            let at = (c * 9 + y * 3 + x) * total + column + v;
                            if let Some(to) = self.sums[at..].first_chunk_mut() {
                                s.store(g[y], to);
                            }
                        }
                    }
                }
            }
            column += pitch;
        }
    }
}
