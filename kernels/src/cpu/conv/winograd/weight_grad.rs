//! Winograd weight gradient: the adjoint of the forward algorithm.
//!
//! ∂g = Gᵀ·[Σ over tiles of V ⊙ Z]·G,   V = Bᵀ·d·B,   Z = A·∂Y·Aᵀ
//!
//! The number of products per pair of channels and tile is that of the forward direction.
//! Lanes are tiles in V and output channels in Z. A job sums V ⊙ Z over its tiles, then
//! transforms the sums once.

use super::kind::{Kind, tiles_per_image};
use super::load_tiles::{LoadChannels, TileBlock, TileLoader};
use super::product_layout::{GROUPS, ProductLayout};
use super::transforms::{Adjoint, Stride1, Stride2, TILE, Transform, WEIGHTS, copy_vectors};
use super::weights::TAPS;
use crate::cpu::conv::buffers::Buffers;
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::sizes::Axes;
use crate::cpu::conv::weight_grad_jobs::{Job, Partition, TileOperands, TiledWeightGrad};
use crate::cpu::conv::weight_grad_tile::{MAX_TILE_CHANNELS, OuterProducts, Store, TILE_ROWS};
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel, first_lanes_bits};
use std::marker::PhantomData;
use std::ops::Range;

/// Maximum input channels of a job.
const MAX_JOB_CHANNELS: usize = 256;
/// Minimum input and output channels of a job that is cut to obtain more jobs.
const MIN_JOB_INPUT_CHANNELS: usize = 16;
const MIN_JOB_OUTPUT_CHANNELS: usize = 64;
/// Maximum vectors of tiles of a block.
const MAX_VECTORS: usize = 4;
/// Minimum tiles of a group, because each group transforms its sums at the end.
const MIN_GROUP_TILES: usize = 256;
/// Maximum groups.
const MAX_GROUPS: usize = 16;

/// The adjoint of Winograd's algorithm.
pub(in crate::cpu::conv) struct WinogradWeightGrad {
    /// [`Kind::Stride1`] or [`Kind::Stride2`].
    pub kind: Kind,
}

impl TiledWeightGrad for WinogradWeightGrad {
    fn partition(&self, plan: &Plan, images: usize) -> Partition {
        let tiles = images * tiles_per_image(plan);
        let groups = (tiles / MIN_GROUP_TILES).clamp(1, MAX_GROUPS);
        // As many jobs as threads. No sum crosses the channels of a job.
        let wanted = rayon::current_num_threads().div_ceil(groups);
        let (c, o) = (plan.src_channels, plan.dst_channels);
        // Output channels are cut first: input tiles are transformed again in less time
        // than gradients.
        let output_parts = wanted.min(o.div_ceil(MIN_JOB_OUTPUT_CHANNELS));
        let input_parts = wanted.div_ceil(output_parts).min(c.div_ceil(MIN_JOB_INPUT_CHANNELS));
        let input_channels = c.div_ceil(input_parts.max(c.div_ceil(MAX_JOB_CHANNELS)));
        let [_, rows, columns] = plan.dst_size.map(|n| n.div_ceil(TILE));
        let tile_columns = columns.min(LANES);
        let tile_rows = (MAX_VECTORS * LANES / tile_columns).clamp(1, rows);
        Partition {
            output_channels: o.div_ceil(output_parts).next_multiple_of(LANES),
            input_channels: input_channels.next_multiple_of(TILE_ROWS),
            tile: [1, tile_rows * TILE, tile_columns * TILE],
            images_per_tile: (MAX_VECTORS * LANES / tiles_per_image(plan)).max(1),
            groups,
        }
    }

    fn row_multiple(&self) -> usize {
        TILE_ROWS
    }

    fn row_stride(&self, output_channels: usize) -> usize {
        output_channels.next_multiple_of(LANES)
    }

    fn sum_tiles<'a>(
        &self,
        level: SimdLevel,
        job: &Job<'_>,
        tiles: &mut dyn Iterator<Item = TileOperands<'a>>,
        buffers: &mut Buffers,
        sums: &mut [f32],
    ) {
        let kind = self.kind;
        // Taken out of the buffers, because `SumProducts` uses the other ones.
        let mut own = std::mem::take(&mut buffers.products);
        let products = own.floats(product_floats(job));
        let reader = &kind.reader(job.plan);
        for (i, operands) in tiles.enumerate() {
            let store = if i == 0 { Store::Overwrite } else { Store::Add };
            level.run(SumProducts { job, kind, reader, operands, store, buffers, products });
        }
        level.run(TransformSums { job, kind, products, sums });
        buffers.products = own;
    }
}

/// Cuts output channels into blocks of equal numbers of vectors, at most
/// [`MAX_TILE_CHANNELS`] channels each.
fn output_blocks(channels: &Range<usize>) -> Vec<Range<usize>> {
    let vectors = channels.len().div_ceil(LANES);
    let blocks = vectors.div_ceil(MAX_TILE_CHANNELS / LANES).max(1);
    let size = vectors.div_ceil(blocks) * LANES;
    let starts = channels.clone().step_by(size.max(LANES));
    starts.map(|first| first..(first + size).min(channels.end)).collect()
}

/// Returns the floats of a job's sums of products: for each block of output channels
/// `[group][input channel][output channel]`.
fn product_floats(job: &Job<'_>) -> usize {
    let channels = (job.rows / TAPS).next_multiple_of(TILE_ROWS);
    let floats = |block: &Range<usize>| GROUPS * channels * block.len().next_multiple_of(LANES);
    output_blocks(&job.output_channels).iter().map(floats).sum()
}

/// Sums V ⊙ Z of one block of tiles into `products`.
struct SumProducts<'a, 'b> {
    job: &'a Job<'b>,
    kind: Kind,
    /// [`Kind::reader`] of the job's plan.
    reader: &'a Plan,
    operands: TileOperands<'a>,
    /// `Overwrite` for the first block of a job.
    store: Store,
    buffers: &'a mut Buffers,
    products: &'a mut [f32],
}

impl Kernel for SumProducts<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        match self.kind {
            Kind::Stride2 => self.with_transform::<S, Stride2, 9, 9>(s),
            // The plan of a weight gradient is never `Stride2InputGrad`.
            _ => self.with_transform::<S, Stride1, 6, 6>(s),
        }
    }
}

impl SumProducts<'_, '_> {
    #[inline(always)]
    fn with_transform<S, T, const IN: usize, const POINTS: usize>(self, s: S)
    where
        S: Simd,
        T: Transform<IN, POINTS, TILE> + Adjoint<POINTS>,
    {
        let job = self.job;
        let TileOperands { x, dy, start } = self.operands;
        let valid = job.valid_outputs(start);
        let [_, tile_rows, per_row] = valid.map(|n| n.div_ceil(TILE));
        let x_pixels = job.plan.src_pixels();
        let dy_image = job.plan.dst_channels * job.plan.dst_pixels();
        let per_image = tile_rows * per_row;
        let channels = job.rows / TAPS;
        let count = dy.len() / dy_image * per_image;
        let block = TileBlock { count, per_row, per_image };
        let (lanes, used_lanes) = (block.lanes(), block.used_lanes());
        let x_image = job.plan.src_channels * x_pixels;
        let loader = TileLoader::new::<T, IN, POINTS, TILE>(self.reader, block, start, x_image);
        let tiles_layout = ProductLayout::new(POINTS, channels, lanes, LANES);
        let Buffers { packed, tiles, gradients, .. } = self.buffers;
        let tiles = tiles.floats(tiles_layout.floats);
        s.call(LoadChannels {
            loader: &loader,
            x,
            pixels: x_pixels,
            channels,
            packed,
            layout: &tiles_layout,
            tiles: &mut *tiles,
            transform: PhantomData::<T>,
        });
        let zero = s.splat(0.0);
        let scratch =
            &mut GradientScratch { d: [[zero; LANES]; TILE], rows: [[zero; POINTS]; TILE] };
        let mut products = self.products;
        let rows = channels.next_multiple_of(TILE_ROWS);
        for output_channels in output_blocks(&job.output_channels) {
            let row_stride = output_channels.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at_mut(GROUPS * rows * row_stride);
            products = rest;
            let part = Job { output_channels, row_stride, ..*job };
            // `[product][lane][output channel]`; the gap keeps groups off powers of two.
            let gradients_layout = ProductLayout::new(POINTS, 1, used_lanes * row_stride, LANES);
            let gradients = gradients.floats(gradients_layout.floats);
            if used_lanes > count {
                // Lanes without a tile.
                gradients.fill(0.0);
            }
            let images = (0..count).step_by(per_image).zip(dy.chunks_exact(dy_image));
            for (first_tile, dy) in images {
                let image = ImageGradients { job: &part, dy, start, valid, block, first_tile };
                for row in 0..tile_rows {
                    image.transform_row::<S, T, POINTS>(
                        s,
                        row,
                        scratch,
                        &gradients_layout,
                        gradients,
                    );
                }
            }
            s.call(SumGroups {
                tiles: &*tiles,
                tiles_layout: &tiles_layout,
                gradients: &*gradients,
                gradients_layout: &gradients_layout,
                channels,
                row_stride,
                lanes,
                used_lanes,
                store: self.store,
                sums: own,
            });
        }
    }
}

/// Adds the products V ⊙ Z of all groups to `sums`. The transforms share this function
/// ([`Simd::call`]).
struct SumGroups<'a> {
    tiles: &'a [f32],
    tiles_layout: &'a ProductLayout,
    gradients: &'a [f32],
    gradients_layout: &'a ProductLayout,
    /// Input channels.
    channels: usize,
    /// Floats of a row of sums.
    row_stride: usize,
    /// [`TileBlock::lanes`].
    lanes: usize,
    /// [`TileBlock::used_lanes`].
    used_lanes: usize,
    store: Store,
    /// `[product][input channel][row_stride]`, input channels rounded up.
    sums: &'a mut [f32],
}

impl Kernel for SumGroups<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { channels, row_stride, lanes, .. } = self;
        let rows = channels.next_multiple_of(TILE_ROWS);
        for i in 0..GROUPS {
            let (tiles, gradients) = (self.tiles_layout.groups[i], self.gradients_layout.groups[i]);
            let step = tiles.channel_stride;
            let outer = OuterProducts {
                x: &self.tiles[tiles.start..][..channels * step],
                x_row_stride: lanes,
                dy: &self.gradients[gradients.start..][..gradients.channel_stride],
                stride: row_stride,
                height: step / lanes,
                width: self.used_lanes,
            };
            let sums = &mut self.sums[i * rows * row_stride..][..rows * row_stride];
            for (first, sums) in sums.chunks_exact_mut(TILE_ROWS * row_stride).enumerate() {
                let mut offsets = [0; TILE_ROWS];
                for m in 0..TILE_ROWS {
                    offsets[m] = (first * TILE_ROWS + m).min(channels - 1) * step;
                }
                outer.run::<S, TILE_ROWS>(s, &offsets, self.store, sums);
            }
        }
    }
}

/// Vectors that [`ImageGradients::transform_row`] works in. Their lanes are output channels.
struct GradientScratch<V, const POINTS: usize> {
    /// ∂L/∂y of sixteen columns of a row of tiles.
    d: [[V; LANES]; TILE],
    /// A tile, transformed along one axis.
    rows: [[V; POINTS]; TILE],
}

/// The gradients of one image's tiles of a block.
struct ImageGradients<'a, 'b> {
    job: &'a Job<'b>,
    dy: &'a [f32],
    start: Axes,
    /// Outputs of the block inside the image.
    valid: Axes,
    block: TileBlock,
    /// The image's first tile in the block.
    first_tile: usize,
}

impl ImageGradients<'_, '_> {
    /// Writes Z of row `row` of tiles to `out`: `[lane][output channel]` of each product.
    #[inline(always)]
    fn transform_row<S: Simd, T: Adjoint<POINTS>, const POINTS: usize>(
        &self,
        s: S,
        row: usize,
        GradientScratch { d, rows }: &mut GradientScratch<S::F, POINTS>,
        layout: &ProductLayout,
        out: &mut [f32],
    ) {
        let Job { row_stride, ref output_channels, plan, .. } = *self.job;
        assert!(out.len() >= layout.floats);
        let out = out.as_mut_ptr();
        let [_, height, width] = self.valid;
        let per_row = width.div_ceil(TILE);
        let channel_floats = plan.dst_pixels();
        for v in (0..row_stride).step_by(LANES) {
            let channels = LANES.min(output_channels.len().saturating_sub(v));
            for left in (0..width).step_by(LANES) {
                let columns = LANES.min(width - left);
                let bits = first_lanes_bits(columns);
                // Distance to the floats of the next iteration: columns, channels or rows of
                // tiles further on. Each is in a cache line of its own.
                let next = if left + LANES < width {
                    LANES
                } else if v + LANES < row_stride {
                    (LANES * channel_floats).wrapping_sub(left)
                } else {
                    (TILE * plan.dst_size[2]).wrapping_sub(v * channel_floats + left)
                };
                for r in 0..TILE {
                    let mut m = [s.splat(0.0); LANES];
                    for i in 0..LANES {
                        if i >= channels || row * TILE + r >= height {
                            continue;
                        }
                        let at = self.job.gradient_at(output_channels.start + v + i, self.start, 0)
                            + (row * TILE + r) * plan.dst_size[2]
                            + left;
                        let from = &self.dy[at..][..columns];
                        s.prefetch_l2(from.as_ptr().wrapping_add(next));
                        // SAFETY: `from` has as many floats as `bits` has bits.
                        m[i] = unsafe { s.load_masked(from.as_ptr(), bits) };
                    }
                    copy_vectors(&mut d[r], s.transpose(m));
                }
                for t in 0..columns.div_ceil(TILE) {
                    for r in 0..TILE {
                        let d = &d[r];
                        let four = [d[t * TILE], d[t * TILE + 1], d[t * TILE + 2], d[t * TILE + 3]];
                        copy_vectors(&mut rows[r], T::outputs_adjoint(s, four));
                    }
                    let tile = self.first_tile + row * per_row + left / TILE + t;
                    let vectors = layout.vectors(0, self.block.lane(tile) * row_stride + v);
                    for j in 0..POINTS {
                        let column = [rows[0][j], rows[1][j], rows[2][j], rows[3][j]];
                        let column = T::outputs_adjoint(s, column);
                        for i in 0..POINTS {
                            let to = out.wrapping_add(vectors.place(POINTS, i, j));
                            // SAFETY: `vectors` lie inside `layout`, which lies inside
                            // `out` (asserted).
                            s.store(column[i], unsafe { &mut *to.cast() });
                        }
                    }
                }
            }
        }
    }
}

/// Transforms a job's sums of products to sums `[input channel · 9 + tap][output channel]`.
struct TransformSums<'a, 'b> {
    job: &'a Job<'b>,
    kind: Kind,
    products: &'a [f32],
    sums: &'a mut [f32],
}

impl Kernel for TransformSums<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        match self.kind {
            Kind::Stride2 => self.with_transform::<S, Stride2, 9>(s),
            // The plan of a weight gradient is never `Stride2InputGrad`.
            _ => self.with_transform::<S, Stride1, 6>(s),
        }
    }
}

impl TransformSums<'_, '_> {
    #[inline(always)]
    fn with_transform<S: Simd, T: Adjoint<POINTS>, const POINTS: usize>(self, s: S) {
        let channels = self.job.rows / TAPS;
        let rows = channels.next_multiple_of(TILE_ROWS);
        let total = self.job.output_channels.len().next_multiple_of(LANES);
        let (mut products, mut column) = (self.products, 0);
        for outputs in output_blocks(&self.job.output_channels) {
            let row_stride = outputs.len().next_multiple_of(LANES);
            let (own, rest) = products.split_at(GROUPS * rows * row_stride);
            products = rest;
            let mut half = [[s.splat(0.0); 3]; WEIGHTS];
            for c in 0..channels {
                for v in (0..row_stride).step_by(LANES) {
                    for i in 0..WEIGHTS {
                        let mut q = [s.splat(0.0); WEIGHTS];
                        for j in 0..WEIGHTS {
                            let at = ((i * WEIGHTS + j) * rows + c) * row_stride + v;
                            if let Some(from) = own[at..].first_chunk() {
                                q[j] = s.load(from);
                            }
                        }
                        copy_vectors(&mut half[i], T::weights_adjoint(s, q));
                    }
                    for x in 0..3 {
                        let mut q = [s.splat(0.0); WEIGHTS];
                        for i in 0..WEIGHTS {
                            q[i] = half[i][x];
                        }
                        let g = T::weights_adjoint(s, q);
                        for y in 0..3 {
                            let at = (c * TAPS + y * 3 + x) * total + column + v;
                            if let Some(to) = self.sums[at..].first_chunk_mut() {
                                s.store(g[y], to);
                            }
                        }
                    }
                }
            }
            column += row_stride;
        }
    }
}
