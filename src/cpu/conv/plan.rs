//! What a convolution reads and writes, as shifts of padded tiles.
//!
//! Every convolution here, forward or to the input, strided or not, is one thing: a
//! tile of the source lies in a buffer with its zeros and its halo, one plane per phase
//! of the stride, so that an output at flat place p is Σ w·buffer[p + offset], the
//! offset a constant of (channel, kernel tap). No im2col exists, and vectors run over
//! p whatever the width of the rows; what they compute in the halo's columns is not
//! written out.

use crate::cpu::simd::{Kernel, LANES, Simd};

/// (depth, height, width).
pub type Axes = [usize; 3];

/// Sizes of one convolution: x `[B, C, D, H, W]`, w `[O, C, kd, kh, kw]`,
/// y `[B, O, D', H', W']`, zero padding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// C.
    pub in_channels: usize,
    /// O.
    pub out_channels: usize,
    /// kd, kh, kw.
    pub kernel: Axes,
    /// Step of the kernel.
    pub stride: Axes,
    /// Zeros added on both sides.
    pub padding: Axes,
    /// D, H, W.
    pub size: Axes,
}

impl Sizes {
    /// A 2-D convolution: a volume of one slice. `kernel` and `size` are (height,
    /// width); stride and padding hold for both axes.
    pub fn flat(
        [in_channels, out_channels]: [usize; 2],
        kernel: [usize; 2],
        stride: usize,
        padding: usize,
        size: [usize; 2],
    ) -> Self {
        let volume = |depth, [h, w]: [usize; 2]| [depth, h, w];
        Self {
            in_channels,
            out_channels,
            kernel: volume(1, kernel),
            stride: volume(1, [stride; 2]),
            padding: volume(0, [padding; 2]),
            size: volume(1, size),
        }
    }

    /// A 3-D convolution of stride 1, `padding` zeros on every side.
    pub fn solid(
        [in_channels, out_channels]: [usize; 2],
        kernel: Axes,
        padding: usize,
        size: Axes,
    ) -> Self {
        let (stride, padding) = ([1; 3], [padding; 3]);
        Self { in_channels, out_channels, kernel, stride, padding, size }
    }

    /// D', H', W'.
    pub fn out_size(&self) -> Axes {
        std::array::from_fn(|a| {
            let padded = self.size[a] + 2 * self.padding[a];
            (padded + 1).saturating_sub(self.kernel[a]).div_ceil(self.stride[a].max(1))
        })
    }

    /// kd·kh·kw.
    pub fn taps(&self) -> usize {
        self.kernel.iter().product()
    }

    /// D·H·W.
    pub fn in_pixels(&self) -> usize {
        self.size.iter().product()
    }

    /// D'·H'·W'.
    pub fn out_pixels(&self) -> usize {
        self.out_size().iter().product()
    }
}

/// One axis of a tap: its place in the kernel, the phase of the source that it reads
/// and the shift there, in steps.
#[derive(Clone, Copy)]
struct AxisTap {
    kernel: usize,
    phase: usize,
    shift: isize,
}

/// A tap of the kernel as a shift inside the packed tile.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tap {
    /// Its place in the kernel, row-major.
    pub kernel: usize,
    /// Index into [`Plan::planes`].
    pub plane: usize,
    /// Steps from the tile's origin.
    pub shift: Axes,
}

/// The taps that make the outputs of one phase.
#[derive(Clone, Debug)]
pub(crate) struct Pass {
    /// Outputs at `step·grid + phase`.
    pub phase: Axes,
    /// Taps, in the order in which they are summed.
    pub taps: Vec<Tap>,
}

/// A convolution as passes of shifts; see the top of this file.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    /// Channels read.
    pub src_channels: usize,
    /// Channels written.
    pub dst_channels: usize,
    /// Size read.
    pub src_size: Axes,
    /// Size written.
    pub dst_size: Axes,
    /// Source positions per grid position.
    pub src_step: Axes,
    /// Outputs per grid position.
    pub dst_step: Axes,
    /// First grid position that a tile's buffer holds, relative to the tile's own.
    pub origin: [isize; 3],
    /// Grid positions that a tile's buffer holds beyond the tile's size.
    pub span: Axes,
    /// Phases of the source that taps read.
    pub planes: Vec<Axes>,
    /// One per phase of the output.
    pub passes: Vec<Pass>,
    /// Kernel places.
    pub kernel_taps: usize,
    /// Weights are indexed `[src, dst]`, not `[dst, src]`.
    pub transposed: bool,
}

impl Plan {
    /// y from x.
    pub fn forward(s: &Sizes) -> Self {
        let axes = std::array::from_fn(|a| {
            let step = s.stride[a].max(1) as isize;
            let tap = |kernel: usize| {
                let at = kernel as isize - s.padding[a] as isize;
                let (shift, phase) = (at.div_euclid(step), at.rem_euclid(step) as usize);
                AxisTap { kernel, phase, shift }
            };
            vec![(0..s.kernel[a]).map(tap).collect()]
        });
        let mut plan = Self::new(s.kernel, axes);
        (plan.src_channels, plan.dst_channels) = (s.in_channels, s.out_channels);
        (plan.src_size, plan.dst_size) = (s.size, s.out_size());
        plan.src_step = s.stride.map(|v| v.max(1));
        plan
    }

    /// ∂L/∂x from ∂L/∂y: every phase of x is a convolution of its own, with those taps
    /// that reach it.
    pub fn input_grad(s: &Sizes) -> Self {
        let axes = std::array::from_fn(|a| {
            let step = s.stride[a].max(1) as isize;
            let of_phase = |phase: isize| {
                let tap = |kernel: usize| {
                    let at = phase + s.padding[a] as isize - kernel as isize;
                    let hit = at.rem_euclid(step) == 0;
                    hit.then(|| AxisTap { kernel, phase: 0, shift: at.div_euclid(step) })
                };
                (0..s.kernel[a]).filter_map(tap).collect()
            };
            (0..step).map(of_phase).collect()
        });
        let mut plan = Self::new(s.kernel, axes);
        (plan.src_channels, plan.dst_channels) = (s.out_channels, s.in_channels);
        (plan.src_size, plan.dst_size) = (s.out_size(), s.size);
        plan.dst_step = s.stride.map(|v| v.max(1));
        plan.transposed = true;
        plan
    }

    /// `axes[a][phase]`: taps of the output's phase along axis a.
    fn new(kernel: Axes, axes: [Vec<Vec<AxisTap>>; 3]) -> Self {
        let shifts = |a: usize| axes[a].iter().flatten().map(|t: &AxisTap| t.shift);
        let origin = std::array::from_fn(|a| shifts(a).min().unwrap_or(0));
        let span = std::array::from_fn(|a| {
            let last = shifts(a).max().unwrap_or(0);
            (last - origin[a]).unsigned_abs()
        });
        let mut planes: Vec<Axes> = Vec::new();
        let mut passes = Vec::new();
        for (fd, depth) in axes[0].iter().enumerate() {
            for (fh, height) in axes[1].iter().enumerate() {
                for (fw, width) in axes[2].iter().enumerate() {
                    let mut taps = Vec::new();
                    for d in depth {
                        for h in height {
                            for w in width {
                                let phase = [d.phase, h.phase, w.phase];
                                let found = planes.iter().position(|p| *p == phase);
                                let plane = found.unwrap_or_else(|| {
                                    planes.push(phase);
                                    planes.len() - 1
                                });
                                let place = (d.kernel * kernel[1] + h.kernel) * kernel[2];
                                let shift = [d, h, w].map(|t| t.shift);
                                taps.push(Tap {
                                    kernel: place + w.kernel,
                                    plane,
                                    shift: std::array::from_fn(|a| {
                                        (shift[a] - origin[a]).unsigned_abs()
                                    }),
                                });
                            }
                        }
                    }
                    passes.push(Pass { phase: [fd, fh, fw], taps });
                }
            }
        }
        Self {
            src_channels: 0,
            dst_channels: 0,
            src_size: [0; 3],
            dst_size: [0; 3],
            src_step: [1; 3],
            dst_step: [1; 3],
            origin,
            span,
            planes,
            passes,
            kernel_taps: kernel.iter().product(),
            transposed: false,
        }
    }

    /// Places before the source's first that the first output reads.
    pub fn before(&self) -> Axes {
        let taps = self.passes.iter().flat_map(|p| &p.taps);
        let place = |a: usize, t: &Tap| {
            let at = (self.origin[a] + t.shift[a] as isize) * self.src_step[a] as isize;
            at + self.planes[t.plane][a] as isize
        };
        std::array::from_fn(|a| {
            let first = taps.clone().map(|t| place(a, t)).min().unwrap_or(0);
            first.min(0).unsigned_abs()
        })
    }

    /// Grid positions: outputs of the largest phase.
    pub fn grid(&self) -> Axes {
        std::array::from_fn(|a| self.dst_size[a].div_ceil(self.dst_step[a]))
    }

    /// Taps of all passes.
    pub fn all_taps(&self) -> usize {
        self.passes.iter().map(|p| p.taps.len()).sum()
    }

    /// How a tile of `tile` grid positions lies in a buffer.
    pub fn layout(&self, tile: Axes) -> Layout {
        let rows: Axes = std::array::from_fn(|a| tile[a] + self.span[a]);
        let plane = rows[0] * rows[1] * rows[2];
        // An odd number of cache lines, lest all channels share one cache set.
        let channel = (self.planes.len() * plane).next_multiple_of(LINE) | LINE;
        Layout { tile, rows, plane, channel }
    }

    /// A tile size for `images` pictures of `channels` channels held at once: a
    /// function of the sizes alone, so that sums never depend on the threads.
    pub fn tile(&self, channels: usize, images: usize, jobs: usize) -> Axes {
        let grid = self.grid();
        let mut tile = [1, 1, even(grid[2], ROW)];
        let fits = |tile: Axes| {
            channels * self.layout(tile).channel <= TILE_FLOATS && tile[1] * tile[2] <= TILE_PIXELS
        };
        while tile[1] < grid[1] && fits([1, tile[1] + 1, tile[2]]) {
            tile[1] += 1;
        }
        while tile[1] == grid[1]
            && tile[0] < grid[0].min(DEPTH)
            && fits([tile[0] + 1, tile[1], tile[2]])
        {
            tile[0] += 1;
        }
        let count = |tile: Axes| (0..3).map(|a| grid[a].div_ceil(tile[a])).product::<usize>();
        while images * count(tile) < jobs && tile[0] > 1 {
            tile[0] = tile[0].div_ceil(2);
        }
        while images * count(tile) < jobs && tile[1] > 1 && tile[1] * tile[2] > LEAST_PIXELS {
            tile[1] = tile[1].div_ceil(2);
        }
        std::array::from_fn(|a| even(grid[a], tile[a]))
    }
}

/// Floats of a cache line.
const LINE: usize = 16;
/// Floats of a packed tile: a quarter of a 2 MiB second-level cache.
const TILE_FLOATS: usize = 128 << 10;
/// Most grid positions of one plane of a tile, and of one of its rows.
const TILE_PIXELS: usize = 2048;
const ROW: usize = 128;
/// Most planes of a tile.
const DEPTH: usize = 16;
/// Tiles are not cut below this for the sake of more jobs.
const LEAST_PIXELS: usize = 192;

/// `n` in equal parts of at most `most`.
fn even(n: usize, most: usize) -> usize {
    n.div_ceil(n.div_ceil(most.max(1)).max(1)).max(1)
}

/// A packed tile: `[channel][plane][depth][row][column]`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    /// Grid positions.
    pub tile: Axes,
    /// The same with the halo.
    pub rows: Axes,
    /// Floats of a plane.
    pub plane: usize,
    /// Floats of a channel.
    pub channel: usize,
}

impl Layout {
    /// Distance of rows.
    pub fn pitch(&self) -> usize {
        self.rows[2]
    }

    /// Distance of depths.
    pub fn depth(&self) -> usize {
        self.rows[1] * self.rows[2]
    }

    /// Places from the first to the last output of one depth.
    pub fn flat(&self) -> usize {
        (self.tile[1] - 1) * self.pitch() + self.tile[2]
    }

    /// Where a tap reads, from an output's own place.
    pub fn offset(&self, tap: &Tap) -> usize {
        let [d, h, w] = tap.shift;
        tap.plane * self.plane + d * self.depth() + h * self.pitch() + w
    }
}

/// First grid positions of all tiles, in order.
pub(crate) fn starts(grid: Axes, tile: Axes) -> Vec<Axes> {
    let mut out = Vec::new();
    for d in (0..grid[0]).step_by(tile[0]) {
        for h in (0..grid[1]).step_by(tile[1]) {
            for w in (0..grid[2]).step_by(tile[2]) {
                out.push([d, h, w]);
            }
        }
    }
    out
}

/// Copies the tile at `start` of one picture's channels `x` into `out`.
pub(crate) struct Pack<'a> {
    pub plan: &'a Plan,
    pub layout: &'a Layout,
    pub x: &'a [f32],
    pub start: Axes,
    pub out: &'a mut [f32],
}

impl Kernel for Pack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { plan, layout, x, start, out } = self;
        let [_, height, width] = plan.src_size;
        let pixels: usize = plan.src_size.iter().product();
        let first: [isize; 3] = std::array::from_fn(|a| {
            (start[a] as isize + plan.origin[a]) * plan.src_step[a] as isize
        });
        let place = |a: usize, i: usize, phase: usize| {
            let at = first[a] + (i * plan.src_step[a] + phase) as isize;
            usize::try_from(at).ok().filter(|&at| at < plan.src_size[a])
        };
        let step = plan.src_step[2];
        for (x, channel) in x.chunks_exact(pixels).zip(out.chunks_mut(layout.channel)) {
            // Narrow sums of weights multiply these by zeros.
            channel[plan.planes.len() * layout.plane..].fill(0.0);
            for (phase, plane) in plan.planes.iter().zip(channel.chunks_exact_mut(layout.plane)) {
                let left = first[2] + phase[2] as isize;
                let begin = (-left).max(0).unsigned_abs().div_ceil(step).min(layout.pitch());
                let past = (width as isize - left).max(0).unsigned_abs().div_ceil(step);
                let past = past.clamp(begin, layout.pitch());
                let from = (left + (begin * step) as isize).max(0).unsigned_abs();
                for (i, slice) in plane.chunks_exact_mut(layout.depth()).enumerate() {
                    let d = place(0, i, phase[0]);
                    for (i, row) in slice.chunks_exact_mut(layout.pitch()).enumerate() {
                        let (Some(d), Some(h)) = (d, place(1, i, phase[1])) else {
                            row.fill(0.0);
                            continue;
                        };
                        row[..begin].fill(0.0);
                        row[past..].fill(0.0);
                        if past > begin {
                            let src = &x[(d * height + h) * width..][from..width];
                            pick(s, src, step, &mut row[begin..past]);
                        }
                    }
                }
            }
        }
    }
}

/// Every `step`th float of `from`, as many as `to` holds; `from` need not reach past the
/// last one.
#[inline(always)]
pub(super) fn pick<S: Simd>(s: S, from: &[f32], step: usize, to: &mut [f32]) {
    if step == 1 {
        to.copy_from_slice(&from[..to.len()]);
        return;
    }
    let pairs = if step == 2 { from.chunks_exact(2 * LANES) } else { [].chunks_exact(1) };
    let whole = (to.len() / LANES).min(pairs.len()) * LANES;
    let (vectors, rest) = to.split_at_mut(whole);
    for (to, pair) in vectors.as_chunks_mut().0.iter_mut().zip(pairs) {
        if let [a, b] = pair.as_chunks().0 {
            s.store(s.deinterleave(s.load(a), s.load(b))[0], to);
        }
    }
    let picks = from[whole * step..].iter().step_by(step);
    rest.iter_mut().zip(picks).for_each(|(to, v)| *to = *v);
}
