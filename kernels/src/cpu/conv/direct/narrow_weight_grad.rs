//! Direct weight gradient with neighbouring outputs in the lanes.
//!
//! Few output channels would leave most lanes of a channel vector empty. Here a vector holds
//! sixteen neighbouring outputs of one channel; both x and ∂L/∂y are loaded as vectors, and
//! the lanes are added at the end. Passes of at most eight output channels each.

use super::weight_grad::TileProducts;
use crate::cpu::conv::algorithm::MAX_NARROW_CHANNELS;
use crate::cpu::simd::{Kernel, LANES, Simd, Vector};

/// Maximum floats of ∂L/∂y of a pass, which stay in a first-level cache, unless one row has
/// more.
const MAX_GRADIENT_FLOATS: usize = 8192;

/// Adds the products of one tile with neighbouring outputs in the lanes.
pub(super) struct NarrowKernel<'a, 'b>(pub TileProducts<'a, 'b>);

impl Kernel for NarrowKernel<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let TileProducts { job, x: tile, dy, start, scratch, sums } = self.0;
        let layout = job.layout;
        let [depth, height, width] = job.valid_outputs(start);
        let offsets = job.offsets();
        let image_width = job.plan.dst_size[2];
        let x_row_stride = layout.row_stride();
        let pass = MAX_NARROW_CHANNELS.min(job.row_stride);
        let rows = (MAX_GRADIENT_FLOATS / (pass * width)).clamp(1, height);
        let farthest = offsets.iter().max().copied().unwrap_or(0);
        for (d, top) in (0..depth).flat_map(|d| (0..height).step_by(rows).map(move |r| (d, r))) {
            let count = rows.min(height - top);
            // Rows of whole vectors are packed without gaps. Other rows keep the distance of
            // the rows of x and make one long line with zeros between them.
            let whole = width.is_multiple_of(LANES);
            let (lines, line, stride) = if whole {
                (count, width, width)
            } else {
                let line = (count - 1) * x_row_stride + width;
                (1, line.next_multiple_of(LANES), x_row_stride)
            };
            let x = &tile[d * layout.depth_stride() + top * x_row_stride..];
            assert!(farthest + (lines - 1) * x_row_stride + line <= x.len());
            let packed = scratch.floats(pass * lines * line);
            for first in (0..job.row_stride).step_by(MAX_NARROW_CHANNELS) {
                let channels = job.output_channels.clone().skip(first);
                if !whole || channels.len() < pass {
                    // Zeros where the tile has no output.
                    packed.fill(0.0);
                }
                for (channel, plane) in channels.zip(packed.chunks_exact_mut(lines * line)) {
                    let at = job.gradient_at(channel, start, d) + top * image_width;
                    let from = &dy[at..];
                    if whole && image_width == width {
                        plane.copy_from_slice(&from[..plane.len()]);
                        continue;
                    }
                    for (r, to) in plane.chunks_mut(stride).take(count).enumerate() {
                        to[..width].copy_from_slice(&from[r * image_width..][..width]);
                    }
                }
                let products = InnerProducts {
                    x,
                    x_row_stride,
                    dy: &*packed,
                    lines,
                    line,
                    offsets: &offsets,
                    rows: job.rows,
                    sums_stride: job.row_stride,
                };
                let sums = &mut sums[first..];
                if S::REGISTERS >= 32 {
                    match pass {
                        8 => products.run::<S, 8, 3>(s, 0, sums),
                        4 => products.run::<S, 4, 6>(s, 0, sums),
                        2 => products.run::<S, 2, 8>(s, 0, sums),
                        _ => products.run::<S, 1, 12>(s, 0, sums),
                    }
                } else if pass == 1 {
                    products.run::<S, 1, 4>(s, 0, sums);
                } else {
                    (0..pass).step_by(2).for_each(
                        #[inline(always)]
                        |first| products.run::<S, 2, 2>(s, first, sums),
                    );
                }
            }
        }
    }
}

/// Gradients `[channel][line][place]` and a packed tile.
struct InnerProducts<'a> {
    x: &'a [f32],
    /// Distance of lines in `x`.
    x_row_stride: usize,
    dy: &'a [f32],
    lines: usize,
    /// Places of a line, whole vectors.
    line: usize,
    /// Offset in `x` of each row of sums, rounded up as [`Job::offsets`] does.
    offsets: &'a [usize],
    /// Rows of sums.
    rows: usize,
    /// Floats of a row of sums.
    sums_stride: usize,
}

impl InnerProducts<'_> {
    /// Adds to the sums of channels `first..first + M`, in register tiles of `T` rows.
    #[inline(always)]
    fn run<S: Simd, const M: usize, const T: usize>(&self, s: S, first: usize, sums: &mut [f32]) {
        let length = self.lines * self.line;
        assert!(self.dy.len() >= (first + M) * length);
        let offsets = self.offsets[..self.rows.next_multiple_of(T)].chunks_exact(T);
        for (offsets, sums) in offsets.zip(sums.chunks_mut(T * self.sums_stride)) {
            let mut acc = [[s.splat(0.0); M]; T];
            let mut x_line = self.x.as_ptr();
            let mut dy = self.dy.as_ptr().wrapping_add(first * length);
            for _ in 0..self.lines {
                for at in (0..self.line).step_by(LANES) {
                    let mut x = [s.splat(0.0); T];
                    for t in 0..T {
                        let from = x_line.wrapping_add(offsets[t] + at);
                        // SAFETY: the farthest row ends inside `x` (asserted by
                        // `NarrowKernel::run`).
                        x[t] = s.load(unsafe { &*from.cast() });
                    }
                    for m in 0..M {
                        let from = dy.wrapping_add(m * length);
                        // SAFETY: `dy` holds first + M channels of `length` floats
                        // (asserted above), and lines are whole vectors.
                        let v = s.load(unsafe { &*from.cast() });
                        for t in 0..T {
                            acc[t][m] = x[t].fma(v, acc[t][m]);
                        }
                    }
                    dy = dy.wrapping_add(LANES);
                }
                x_line = x_line.wrapping_add(self.x_row_stride);
            }
            for t in 0..T {
                let added = s.sums(acc[t]);
                for m in 0..M {
                    sums[t * self.sums_stride + first + m] += added[m];
                }
            }
        }
    }
}
