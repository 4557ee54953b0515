//! ∂L/∂w of 3×3 convolutions of stride 1 and 2 by the adjoint of [`super::winograd`]: as
//! many products for each pair of channels and tile as there.
//!
//! With V = Bᵀ·x·B (lanes are tiles, as there) and Z = A·∂y·Aᵀ (lanes are output
//! channels), ∂w = Gᵀ·(Σ over tiles of V⊙Z)·G.

use super::Buffers;
use super::forms::{Adjoint, Down, Form, GROUPS, Places, TILE, Unit, WEIGHTS};
use super::plan::{Axes, Layout, Plan, pack};
use super::weights::{LANES_WIDE, ROWS, Tile, Work, turn};
use super::winograd::{SLACK, Tiles, Way, scatter, transform};
use crate::cpu::simd::{Kernel, LANES, Simd};
use std::ops::Range;

/// Input channels of a job: at most, and at least for the sake of more jobs.
const CHANNELS: usize = 64;
const FEW_CHANNELS: usize = 16;
/// Jobs of a call where tiles are few: each turns all gradients over again.
const JOBS: usize = 2;
/// Vectors of tiles at once.
const VECTORS: usize = 4;
/// Outputs whose tiles make one block, for `plan`.
pub(super) fn tile(plan: &Plan) -> Axes {
    let [_, height, width] = plan.dst_size.map(|n| n.div_ceil(TILE));
    let across = width.min(LANES);
    [1, (VECTORS * LANES / across).clamp(1, height) * TILE, across * TILE]
}

/// Tiles of a job at least, since its products are to be transformed at the end.
const TILES: usize = 128;

/// Parts of so many input channels, over `tiles` tiles of all pictures.
pub(super) fn parts(channels: usize, tiles: usize) -> usize {
    let groups = (tiles / TILES).max(1);
    let wanted = JOBS.div_ceil(groups).min(channels.div_ceil(FEW_CHANNELS));
    channels.div_ceil(CHANNELS).max(wanted)
}

/// Groups of `units` blocks of tiles that are summed apart.
pub(super) fn groups(plan: &Plan, units: usize, parts: usize, jobs: usize) -> usize {
    let [_, height, width] = tile(plan);
    let tiles = units * (height / TILE) * (width / TILE);
    jobs.div_ceil(parts).min(tiles / TILES).clamp(1, units)
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

/// Adds one block of tiles to `products`.
pub(super) struct Products<'a, 'b> {
    pub work: &'a Work<'b>,
    pub way: Way,
    /// The job's channels of one picture.
    pub x: &'a [f32],
    pub dy: &'a [f32],
    pub start: Axes,
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
        let reader = self.way.reader(work.plan);
        let [_, height, width] = work.layout.tile;
        let layout: Layout = reader.layout([1, height * F::READ / TILE, width * F::READ / TILE]);
        let inside = work.inside(self.start);
        let [_, down, across] = inside.map(|n| n.div_ceil(TILE));
        let (count, channels) = (down * across, work.rows / 9);
        let length = count.next_multiple_of(LANES);
        let places = Tiles { count, across, picture: count }.places(&layout, F::READ);
        let sources = Places::new(POINTS, channels, length, LANES);
        let Buffers { x: patch, y: turned, tiles, gradients, .. } = self.buffers;
        let patch = patch.room(layout.channel + SLACK);
        let tiles = tiles.room(sources.floats);
        let pixels: usize = work.plan.src_size.iter().product();
        let [depth, top, left] = self.start;
        let from = [depth, top * F::READ / TILE, left * F::READ / TILE];
        for (c, x) in self.x.chunks_exact(pixels).enumerate() {
            pack(&reader, &layout, x, from, &mut patch[..layout.channel]);
            for (v, places) in places.iter().enumerate() {
                let points = transform::<S, F, IN, POINTS, TILE>(s, patch, places, layout.pitch());
                scatter(s, &points, tiles, &sources, [c, v * LANES]);
            }
        }
        let mut products = self.products;
        let rows = channels.next_multiple_of(ROWS);
        for outputs in blocks(&work.outputs) {
            let pitch = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at_mut(GROUPS * rows * pitch);
            products = rest;
            let part = Work { outputs, pitch, ..*work };
            // One row of tiles after the other, each `pitch` gradients.
            let outward = Places::new(POINTS, 1, count * pitch, 0);
            let gradients = gradients.room(outward.floats);
            let turned = turned.room(TILE * across * TILE * pitch);
            for row in 0..down {
                if inside[1] - row * TILE < TILE || inside[2] < across * TILE {
                    turned.fill(0.0);
                }
                for r in 0..TILE.min(inside[1] - row * TILE) {
                    let to = &mut turned[r * across * TILE * pitch..][..inside[2] * pitch];
                    turn(s, &part, self.dy, (self.start, 0, row * TILE + r), [1, inside[2]], to);
                }
                let first = row * across * pitch;
                spread::<S, F, POINTS>(s, turned, [first, across, pitch], &outward, gradients);
            }
            for i in 0..GROUPS {
                let ((at, step), (from, floats)) = (sources.groups[i], outward.groups[i]);
                let tile = Tile {
                    x: &tiles[at..][..channels * step],
                    x_pitch: length,
                    dy: &gradients[from..][..floats],
                    pitch,
                    count: step / length,
                    width: count,
                };
                let sums = own[i * rows * pitch..][..rows * pitch].chunks_exact_mut(ROWS * pitch);
                for (group, sums) in sums.enumerate() {
                    let mut offsets = [0; ROWS];
                    for m in 0..ROWS {
                        offsets[m] = (group * ROWS + m).min(channels - 1) * step;
                    }
                    tile.rows(s, &offsets, sums);
                }
            }
        }
    }
}

/// Z of one row of tiles from `[4 rows][4·across][pitch]` gradients.
#[inline(always)]
fn spread<S: Simd, F: Adjoint<POINTS>, const POINTS: usize>(
    s: S,
    dy: &[f32],
    [first, across, pitch]: [usize; 3],
    places: &Places,
    out: &mut [f32],
) {
    for t in 0..across {
        for v in (0..pitch).step_by(LANES) {
            let mut rows = [[s.splat(0.0); POINTS]; TILE];
            for r in 0..TILE {
                let mut d = [s.splat(0.0); TILE];
                for q in 0..TILE {
                    let at = ((r * across + t) * TILE + q) * pitch + v;
                    if let Some(from) = dy[at..].first_chunk() {
                        d[q] = s.load(from);
                    }
                }
                rows[r] = F::spread(s, d);
            }
            for j in 0..POINTS {
                let column = F::spread(s, [rows[0][j], rows[1][j], rows[2][j], rows[3][j]]);
                for i in 0..POINTS {
                    let at = places.at[i * POINTS + j] + first + t * pitch + v;
                    if let Some(to) = out[at..].first_chunk_mut() {
                        s.store(column[i], to);
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
            for c in 0..channels {
                for v in (0..pitch).step_by(LANES) {
                    let mut half = [[s.splat(0.0); 3]; WEIGHTS];
                    for i in 0..WEIGHTS {
                        let mut q = [s.splat(0.0); WEIGHTS];
                        for j in 0..WEIGHTS {
                            let at = ((i * WEIGHTS + j) * rows + c) * pitch + v;
                            if let Some(from) = own[at..].first_chunk() {
                                q[j] = s.load(from);
                            }
                        }
                        half[i] = F::taps(s, q);
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
