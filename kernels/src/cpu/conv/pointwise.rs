//! 1×1 convolutions without padding as matrix products.
//!
//! y[o][pixel] = bias[o] + Σ_c w[o][c] · x[c][stride·pixel]
//!
//! No tap shifts the source, so no tile with a halo is packed; [`crate::cpu::gemm`] does the
//! rest. With a stride above 1 only every stride-th source pixel is read (forward), or only
//! every stride-th destination pixel gets a product and the others get zero (∂L/∂x).
//! For inputs in ±1 and n products per sum, results are within 1.5e-6·√n of the exact ones
//! (conv/tests.rs).

use super::algorithm::{Convolve, ConvolveArgs, WeightGrad, WeightGradArgs};
use super::buffers::Buffers;
use super::packed_tile::{load_strided, store_interleaved};
use super::plan::{Direction, Plan};
use crate::cpu::gemm::{Base, Mat, OutputRows, PANEL, Packed, product_at, product_on};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, Simd, SimdLevel};
use crate::cpu::uninit;
use crate::cpu::uninit::UninitSlice;
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Maximum floats of a task's pixels over all channels; they stay in the second-level cache.
const MAX_TASK_FLOATS: usize = 1 << 17;
/// Maximum pixels of a task: whole panels of [`PANEL`].
const MAX_TASK_PIXELS: usize = 2048;
/// Maximum jobs of a weight gradient, whose sums are added at the end. A constant keeps the
/// order of summation independent of the number of threads.
const MAX_WEIGHT_GRAD_JOBS: usize = 16;
/// Numbers of ∂L/∂w per task of that addition.
const ADD_CHUNK: usize = 4096;

/// Returns whether `plan` is a 1×1 convolution without padding, in either direction.
pub(super) fn supports(plan: &Plan) -> bool {
    let grid = plan.grid();
    plan.kernel_taps == 1
        // Padding would move the first place that is read or written.
        && plan.origin == [0; 3]
        && plan.planes == [[0; 3]]
        && plan.passes[0].taps.len() == 1
        && (0..3).all(|a| plan.src_size[a].div_ceil(plan.src_step[a]) == grid[a])
}

/// A matrix product of weights and pixels.
pub(super) struct Pointwise;

impl Convolve for Pointwise {
    fn convolve(&self, args: &ConvolveArgs<'_>, y: &mut UninitSlice<f32>) {
        let &ConvolveArgs { level, plan, x, w, bias } = args;
        let (c, o) = (plan.src_channels, plan.dst_channels);
        let weights = match plan.direction {
            Direction::Forward => Mat::new(w, o, c, c),
            Direction::InputGrad => Mat::new(w, c, o, o).t(),
        };
        let span = MAX_TASK_FLOATS / c.max(o);
        let span = span.clamp(PANEL, MAX_TASK_PIXELS).next_multiple_of(PANEL);
        let pixels = plan.dst_pixels();
        let images = y.len() / (o * pixels);
        assert!(y.len() == images * o * pixels && (bias.is_empty() || bias.len() == o));
        assert!(bias.is_empty() || plan.dst_step == [1; 3], "conv: a gradient has no bias");
        let y = &SharedSliceMut::new(y);
        let call = Call { level, plan, x, weights, bias, y };
        if plan.src_step == [1; 3] && plan.dst_step == [1; 3] {
            let spans = pixels.div_ceil(span);
            (0..images * spans).into_par_iter().for_each(|task| {
                let first = task % spans * span;
                call.contiguous(task / spans, first..(first + span).min(pixels));
            });
        } else {
            let [depth, height, width] = plan.grid();
            let lines = depth * height;
            let each = (span / width).clamp(1, lines);
            let spans = lines.div_ceil(each);
            (0..images * spans).into_par_iter().for_each(|task| {
                let first = task % spans * each;
                call.strided(task / spans, first..(first + each).min(lines));
            });
        }
    }
}

impl WeightGrad for Pointwise {
    fn weight_grad(&self, args: &WeightGradArgs<'_>, dw: &mut [f32]) {
        let &WeightGradArgs { level, plan, x, dy } = args;
        let (c, o) = (plan.src_channels, plan.dst_channels);
        let pixels = plan.src_pixels();
        let [depth, height, width] = plan.grid();
        let lines = depth * height;
        let images = args.images();
        assert!(x.len() == images * c * pixels && dy.len() == images * o * lines * width);
        assert!(dw.len() == o * c);
        let each = (MAX_TASK_FLOATS / 2 / c.max(o) / width).clamp(1, lines);
        let spans = lines.div_ceil(each);
        let units = images * spans;
        let jobs = units.min(MAX_WEIGHT_GRAD_JOBS);
        let mut sums = uninit::zeros(jobs * o * c);
        sums.par_chunks_exact_mut(o * c).enumerate().for_each(|(job, sums)| {
            for unit in units * job / jobs..units * (job + 1) / jobs {
                let image = unit / spans;
                let first = unit % spans * each;
                let cols = each.min(lines - first) * width;
                let dy = &dy[image * o * lines * width + first * width..];
                let dy = Mat::new(dy, o, cols, lines * width);
                let x = &x[image * c * pixels..][..c * pixels];
                let mut product = |x: Mat<'_>| {
                    let dst = (&mut *sums, c);
                    Packed::with(x.t(), |x| product_on(level, dst, dy, x, 1.0, Base::Own));
                };
                if plan.src_step == [1; 3] {
                    product(Mat::new(&x[first * width..], c, cols, pixels));
                    continue;
                }
                Buffers::with(|buffers| {
                    let picked = buffers.packed.floats(c * cols);
                    level.run(PackPixels { plan, x, first, cols, panel: cols, to: &mut *picked });
                    product(Mat::new(picked, c, cols, cols));
                });
            }
        });
        dw.par_chunks_mut(ADD_CHUNK).enumerate().for_each(|(i, dw)| {
            dw.fill(0.0);
            for sums in sums.chunks_exact(o * c) {
                let sums = &sums[i * ADD_CHUNK..][..dw.len()];
                dw.iter_mut().zip(sums).for_each(|(total, v)| *total += v);
            }
        });
    }
}

/// Operands of all tasks of [`Pointwise::convolve`].
struct Call<'a> {
    level: SimdLevel,
    plan: &'a Plan,
    x: &'a [f32],
    /// `[destination channels, source channels]`.
    weights: Mat<'a>,
    bias: &'a [f32],
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Call<'_> {
    /// Computes the pixels `span` of an image; stride 1.
    fn contiguous(&self, image: usize, span: Range<usize>) {
        let c = self.plan.src_channels;
        let pixels = self.plan.src_pixels();
        let x = &self.x[image * c * pixels + span.start..(image + 1) * c * pixels];
        Packed::with(Mat::new(x, c, span.len(), pixels), |x| self.product(image, span.start, x));
    }

    /// Computes the lines `lines` of an image's grid; any stride.
    fn strided(&self, image: usize, lines: Range<usize>) {
        let Self { level, plan, y, .. } = *self;
        let c = plan.src_channels;
        let across = plan.grid()[2];
        let cols = lines.len() * across;
        let pixels = plan.src_pixels();
        let x = &self.x[image * c * pixels..][..c * pixels];
        let pack = |to: &mut [f32]| {
            level.run(PackPixels { plan, x, first: lines.start, cols, panel: PANEL, to });
        };
        Packed::with_panels([c, cols], pack, |x| {
            if plan.dst_step == [1; 3] {
                return self.product(image, lines.start * across, x);
            }
            Buffers::with(|buffers| {
                let floats = plan.dst_channels * cols;
                let (sums, zeros) = buffers.scratch.floats(floats + across).split_at_mut(floats);
                zeros.fill(0.0);
                product_on(level, (&mut *sums, cols), self.weights, x, 1.0, Base::Zero);
                level.run(StoreStrided { plan, image, lines: lines.clone(), sums, zeros, y });
            });
        });
    }

    /// Computes all channels of the pixels from `first` on; the columns of `x` are their
    /// sources.
    fn product(&self, image: usize, first: usize, x: &Packed) {
        let o = self.plan.dst_channels;
        let pixels = self.plan.dst_pixels();
        let mut base = Base::Zero;
        for (channel, bias) in self.bias.iter().enumerate() {
            let at = (image * o + channel) * pixels + first;
            // SAFETY: no other task writes these pixels of this channel.
            unsafe { self.y.part(at..at + x.cols()) }.fill(MaybeUninit::new(*bias));
            base = Base::Own;
        }
        let at = self.y.address(image * o * pixels + first).cast_mut().cast();
        let dst = OutputRows { at, row_stride: pixels };
        // SAFETY: these pixels of all channels of one image lie inside `y` (asserted by
        // `convolve`), no other task writes them, and they are initialised where `base` is
        // `Own`.
        unsafe { product_at(self.level, dst, self.weights, x, 1.0, base) };
    }
}

/// Packs every stride-th pixel of an image: `cols` pixels from line `first` of the grid on,
/// as `[panel][channel][pixel]` with `panel` pixels per panel.
struct PackPixels<'a> {
    plan: &'a Plan,
    x: &'a [f32],
    first: usize,
    cols: usize,
    panel: usize,
    to: &'a mut [f32],
}

impl Kernel for PackPixels<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { plan, x, first, cols, panel, to } = self;
        let ([_, height, width], step) = (plan.src_size, plan.src_step);
        let [_, down, across] = plan.grid();
        let pixels = plan.src_pixels();
        let channels = plan.src_channels;
        for (to, begin) in to.chunks_mut(panel * channels).zip((0..cols).step_by(panel)) {
            let row_stride = to.len() / channels;
            let end = (begin + panel).min(cols);
            for (x, row) in x.chunks_exact(pixels).zip(to.chunks_exact_mut(row_stride)) {
                let mut at = begin;
                while at < end {
                    let line = first + at / across;
                    let left = at % across;
                    let n = (across - left).min(end - at);
                    let d = line / down * step[0];
                    let h = line % down * step[1];
                    let from = &x[(d * height + h) * width..][left * step[2]..width];
                    load_strided(s, from, step[2], &mut row[at - begin..][..n]);
                    at += n;
                }
                row[end - begin..].fill(0.0);
            }
        }
    }
}

/// Writes `sums` `[channel][pixel of the lines]` to every stride-th pixel of y, and zeros to
/// the pixels between.
struct StoreStrided<'a> {
    plan: &'a Plan,
    image: usize,
    lines: Range<usize>,
    sums: &'a [f32],
    /// Zeros, as many as a line of the grid has pixels.
    zeros: &'a [f32],
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Kernel for StoreStrided<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { plan, image, lines, sums, zeros, y } = self;
        let ([depth, height, width], step) = (plan.dst_size, plan.dst_step);
        let [_, down, across] = plan.grid();
        let cols = lines.len() * across;
        for (channel, sums) in sums.chunks_exact(cols).enumerate() {
            let base = (image * plan.dst_channels + channel) * depth * height * width;
            for (line, sums) in lines.clone().zip(sums.chunks_exact(across)) {
                let d = line / down * step[0];
                let h = line % down * step[1];
                for z in d..(d + step[0]).min(depth) {
                    for row in h..(h + step[1]).min(height) {
                        let at = base + (z * height + row) * width;
                        // SAFETY: tasks differ in image or lines, and so in the rows that
                        // they write.
                        let to = unsafe { y.part(at..at + width) };
                        if (z, row, step[2]) == (d, h, 2) {
                            store_interleaved(s, sums, zeros, to);
                            continue;
                        }
                        to.fill(MaybeUninit::new(0.0));
                        if (z, row) == (d, h) {
                            let places = to.iter_mut().step_by(step[2]);
                            places.zip(sums).for_each(|(to, v)| *to = MaybeUninit::new(*v));
                        }
                    }
                }
            }
        }
    }
}
