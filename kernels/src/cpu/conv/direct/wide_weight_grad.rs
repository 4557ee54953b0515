//! Direct weight gradient with output channels in the lanes.
//!
//! ∂L/∂y of up to 128 outputs is transposed to `[output][channel]`, which fits in the
//! first-level cache. Register tiles then multiply it with rows (channel × tap) of the packed
//! tile, which are read as scalars where they lie.

use super::weight_grad::TileProducts;
use crate::cpu::conv::sizes::Axes;
use crate::cpu::conv::weight_grad_jobs::Job;
use crate::cpu::conv::weight_grad_tile::{OuterProducts, Store, TILE_ROWS};
use crate::cpu::simd::{Kernel, LANES, Simd};

/// Maximum outputs whose gradients are transposed at once, unless one row has more.
const MAX_TRANSPOSED_OUTPUTS: usize = 128;

/// Adds the products of one tile with output channels in the lanes.
pub(super) struct WideKernel<'a, 'b>(pub TileProducts<'a, 'b>);

impl Kernel for WideKernel<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let TileProducts { job, x: tile, dy, start, scratch, sums } = self.0;
        let layout = job.layout;
        let [depth, height, width] = job.valid_outputs(start);
        let offsets = job.offsets();
        let stride = job.row_stride;
        let rows = (MAX_TRANSPOSED_OUTPUTS / width).clamp(1, height);
        let transposed = scratch.floats(rows * width * stride);
        for d in 0..depth {
            for first in (0..height).step_by(rows) {
                let count = rows.min(height - first);
                let transposed = &mut transposed[..count * width * stride];
                let x = &tile[d * layout.depth_stride() + first * layout.row_stride()..];
                let from = OutputRows { job, dy, start, d, first, rows: count, width };
                from.transpose(s, transposed);
                let products = OuterProducts {
                    x,
                    x_row_stride: layout.row_stride(),
                    dy: transposed,
                    stride,
                    height: count,
                    width,
                };
                let sums = sums.chunks_exact_mut(TILE_ROWS * stride);
                for (i, (offsets, sums)) in offsets.as_chunks().0.iter().zip(sums).enumerate() {
                    if job.rows - i * TILE_ROWS > TILE_ROWS / 2 {
                        products.run::<S, TILE_ROWS>(s, offsets, Store::Add, sums);
                    } else {
                        products.run::<S, { TILE_ROWS / 2 }>(s, offsets, Store::Add, sums);
                    }
                }
            }
        }
    }
}

/// Rows `first..first + rows` of a tile's depth `d`, `width` outputs each.
struct OutputRows<'a, 'b> {
    job: &'a Job<'b>,
    dy: &'a [f32],
    start: Axes,
    d: usize,
    first: usize,
    rows: usize,
    width: usize,
}

impl OutputRows<'_, '_> {
    /// Writes ∂L/∂y of these outputs to `out` `[output][channel]`; lanes beyond the job's
    /// output channels become zero.
    #[inline(always)]
    fn transpose<S: Simd>(&self, s: S, out: &mut [f32]) {
        let &Self { job, dy, start, d, first, rows, width } = self;
        let stride = job.row_stride;
        let image_width = job.plan.dst_size[2];
        // Rows that cover the image's width are contiguous: one run.
        let (runs, run) = if image_width == width { (1, rows * width) } else { (rows, width) };
        for v in (0..stride).step_by(LANES) {
            let channels = LANES.min(job.output_channels.len().saturating_sub(v));
            for r in 0..runs {
                let to = &mut out[r * run * stride..][..run * stride];
                let at = |i: usize| {
                    job.gradient_at(job.output_channels.start + v + i, start, d)
                        + (first + r) * image_width
                };
                let mut places = [0; LANES];
                for i in 0..LANES {
                    places[i] = at(i.min(channels.saturating_sub(1)));
                }
                let whole = run / LANES * LANES;
                for p in (0..whole).step_by(LANES) {
                    let mut m = [s.splat(0.0); LANES];
                    for i in 0..LANES {
                        if i < channels
                            && let Some(from) = dy[places[i] + p..].first_chunk()
                        {
                            // The next columns: every channel has a cache line of its own.
                            s.prefetch_l2(from.as_ptr().wrapping_add(LANES));
                            m[i] = s.load(from);
                        }
                    }
                    let m = s.transpose(m);
                    for i in 0..LANES {
                        if let Some(to) = to[(p + i) * stride + v..].first_chunk_mut() {
                            s.store(m[i], to);
                        }
                    }
                }
                for p in whole..run {
                    let to = &mut to[p * stride + v..][..LANES];
                    for i in 0..LANES {
                        to[i] = if i < channels { dy[places[i] + p] } else { 0.0 };
                    }
                }
            }
        }
    }
}
