//! 1×1 convolutions without padding: a matrix product of weights and pixels, in which
//! nothing is shifted and no tile need be packed. Where the stride is not 1, its multiples
//! alone are read, or (∂L/∂x) written, zeros between.

use super::Buffers;
use super::plan::{Plan, pick};
use super::shift::zip;
use crate::cpu::gemm::{Base, Mat, PANEL, Packed, product_at, product_on};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, Simd, SimdLevel};
use crate::cpu::uninit;
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Floats of a task's pixels, all channels: they stay in the second-level cache.
const FLOATS: usize = 1 << 17;
/// Most pixels of a task; whole panels of [`PANEL`].
const SPAN: usize = 2048;
/// Least channels read, and pixels, for which it wins.
const CHANNELS: usize = 16;
const PIXELS: usize = 256;

/// Whether `plan` can be, and had better be, run here.
pub(super) fn suits(plan: &Plan) -> bool {
    let grid = plan.grid();
    plan.kernel_taps == 1
        // Padding would move the first place that is read, or the one that is written.
        && plan.origin == [0; 3]
        && plan.planes == [[0; 3]]
        && plan.passes[0].taps.len() == 1
        && (0..3).all(|a| plan.src_size[a].div_ceil(plan.src_step[a]) == grid[a])
        && plan.src_channels >= CHANNELS
        && grid.iter().product::<usize>() >= PIXELS
}

/// As [`super::shift::run`].
pub(super) fn run(
    level: SimdLevel,
    plan: &Plan,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    y: &mut uninit::UninitSlice<f32>,
) {
    let (c, o) = (plan.src_channels, plan.dst_channels);
    let weights = match plan.transposed {
        true => Mat::new(w, c, o, o).t(),
        false => Mat::new(w, o, c, c),
    };
    let span = (FLOATS / c.max(o)).clamp(PANEL, SPAN).next_multiple_of(PANEL);
    let pixels: usize = plan.dst_size.iter().product();
    let images = y.len() / (o * pixels);
    assert!(y.len() == images * o * pixels && (bias.is_empty() || bias.len() == o));
    assert!(bias.is_empty() || plan.dst_step == [1; 3], "conv: a gradient has no bias");
    let y = &SharedSliceMut::new(y);
    let call = Call { level, plan, x, weights, bias, y };
    if plan.src_step == [1; 3] && plan.dst_step == [1; 3] {
        let spans = pixels.div_ceil(span);
        (0..images * spans).into_par_iter().for_each(|job| {
            let first = job % spans * span;
            call.dense(job / spans, first..(first + span).min(pixels));
        });
    } else {
        let [depth, height, width] = plan.grid();
        let lines = depth * height;
        let each = (span / width).clamp(1, lines);
        let spans = lines.div_ceil(each);
        (0..images * spans).into_par_iter().for_each(|job| {
            let first = job % spans * each;
            call.sparse(job / spans, first..(first + each).min(lines));
        });
    }
}

/// Jobs of [`weight_grad`], whose sums are added at the end: a constant, so that they
/// never depend on the threads.
const JOBS: usize = 16;
/// Numbers of ∂L/∂w that are added at once.
const ADDED: usize = 4096;

/// ∂L/∂w, overwritten, where [`suits`] says so of the convolution itself.
pub(super) fn weight_grad(level: SimdLevel, plan: &Plan, x: &[f32], dy: &[f32], dw: &mut [f32]) {
    let (c, o) = (plan.src_channels, plan.dst_channels);
    let pixels: usize = plan.src_size.iter().product();
    let [depth, height, width] = plan.grid();
    let lines = depth * height;
    let images = x.len() / (c * pixels);
    assert!(x.len() == images * c * pixels && dy.len() == images * o * lines * width);
    assert!(dw.len() == o * c);
    let each = (FLOATS / 2 / c.max(o) / width).clamp(1, lines);
    let spans = lines.div_ceil(each);
    let units = images * spans;
    let jobs = units.min(JOBS);
    let mut sums = uninit::zeros(jobs * o * c);
    sums.par_chunks_exact_mut(o * c).enumerate().for_each(|(job, sums)| {
        for unit in units * job / jobs..units * (job + 1) / jobs {
            let (image, first) = (unit / spans, unit % spans * each);
            let cols = each.min(lines - first) * width;
            let dy = &dy[image * o * lines * width + first * width..];
            let dy = Mat::new(dy, o, cols, lines * width);
            let x = &x[image * c * pixels..][..c * pixels];
            let mut product = |x: Mat<'_>| {
                Packed::kept(x.t(), |x| product_on(level, (&mut *sums, c), dy, x, 1.0, Base::Own));
            };
            if plan.src_step == [1; 3] {
                product(Mat::new(&x[first * width..], c, cols, pixels));
                continue;
            }
            Buffers::with(|buffers| {
                let picked = buffers.x.room(c * cols);
                level.run(Pick { plan, x, first, cols, panel: cols, to: &mut *picked });
                product(Mat::new(picked, c, cols, cols));
            });
        }
    });
    dw.par_chunks_mut(ADDED).enumerate().for_each(|(i, dw)| {
        dw.fill(0.0);
        for sums in sums.chunks_exact(o * c) {
            let sums = &sums[i * ADDED..][..dw.len()];
            dw.iter_mut().zip(sums).for_each(|(total, v)| *total += v);
        }
    });
}

struct Call<'a> {
    level: SimdLevel,
    plan: &'a Plan,
    x: &'a [f32],
    /// `[channels written, channels read]`.
    weights: Mat<'a>,
    bias: &'a [f32],
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Call<'_> {
    /// Some pixels of a picture, stride 1.
    fn dense(&self, image: usize, span: Range<usize>) {
        let c = self.plan.src_channels;
        let pixels: usize = self.plan.src_size.iter().product();
        let x = &self.x[image * c * pixels + span.start..(image + 1) * c * pixels];
        Packed::kept(Mat::new(x, c, span.len(), pixels), |x| self.product(image, span.start, x));
    }

    /// Some lines of a picture's grid, any stride.
    fn sparse(&self, image: usize, lines: Range<usize>) {
        let Self { level, plan, y, .. } = *self;
        let (c, across) = (plan.src_channels, plan.grid()[2]);
        let cols = lines.len() * across;
        let pixels: usize = plan.src_size.iter().product();
        let x = &self.x[image * c * pixels..][..c * pixels];
        let pick = |to: &mut [f32]| {
            level.run(Pick { plan, x, first: lines.start, cols, panel: PANEL, to });
        };
        Packed::kept_by([c, cols], pick, |x| {
            if plan.dst_step == [1; 3] {
                return self.product(image, lines.start * across, x);
            }
            Buffers::with(|buffers| {
                let floats = plan.dst_channels * cols;
                let (sums, zeros) = buffers.y.room(floats + across).split_at_mut(floats);
                zeros.fill(0.0);
                product_on(level, (&mut *sums, cols), self.weights, x, 1.0, Base::Zero);
                level.run(Scatter { plan, image, lines: lines.clone(), sums, zeros, y });
            });
        });
    }

    /// All channels of the pixels from `first` on, whose sources are the columns of `x`.
    fn product(&self, image: usize, first: usize, x: &Packed) {
        let o = self.plan.dst_channels;
        let pixels: usize = self.plan.dst_size.iter().product();
        let mut base = Base::Zero;
        for (channel, bias) in self.bias.iter().enumerate() {
            let at = (image * o + channel) * pixels + first;
            // SAFETY: these pixels of this channel are this job's alone.
            unsafe { self.y.part(at..at + x.cols()) }.fill(MaybeUninit::new(*bias));
            base = Base::Own;
        }
        let dst = (self.y.address(image * o * pixels + first).cast_mut().cast(), pixels);
        // SAFETY: the same pixels of all channels of one picture, this job's alone, inside
        // `y` (asserted by `run`); numbers where there is a bias.
        unsafe { product_at(self.level, dst, self.weights, x, 1.0, base) };
    }
}

/// Packs a picture's lines from line `first` of the grid on, `cols` pixels, in panels of
/// so many: `[panel][channel][pixel]`.
struct Pick<'a> {
    plan: &'a Plan,
    x: &'a [f32],
    first: usize,
    cols: usize,
    panel: usize,
    to: &'a mut [f32],
}

impl Kernel for Pick<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { plan, x, first, cols, panel, to } = self;
        let ([_, height, width], step) = (plan.src_size, plan.src_step);
        let [_, down, across] = plan.grid();
        let pixels: usize = plan.src_size.iter().product();
        let channels = plan.src_channels;
        for (to, begin) in to.chunks_mut(panel * channels).zip((0..cols).step_by(panel)) {
            let pitch = to.len() / channels;
            let end = (begin + panel).min(cols);
            for (x, row) in x.chunks_exact(pixels).zip(to.chunks_exact_mut(pitch)) {
                let mut at = begin;
                while at < end {
                    let (line, left) = (first + at / across, at % across);
                    let n = (across - left).min(end - at);
                    let (d, h) = (line / down * step[0], line % down * step[1]);
                    let from = &x[(d * height + h) * width..][left * step[2]..width];
                    pick(s, from, step[2], &mut row[at - begin..][..n]);
                    at += n;
                }
                row[end - begin..].fill(0.0);
            }
        }
    }
}

/// Writes `sums` `[channel][pixel of the lines]` to their places, zeros to those between.
struct Scatter<'a> {
    plan: &'a Plan,
    image: usize,
    lines: Range<usize>,
    sums: &'a [f32],
    /// Zeros, as many as a line has pixels.
    zeros: &'a [f32],
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Kernel for Scatter<'_> {
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
                let (d, h) = (line / down * step[0], line % down * step[1]);
                for z in d..(d + step[0]).min(depth) {
                    for row in h..(h + step[1]).min(height) {
                        let at = base + (z * height + row) * width;
                        // SAFETY: jobs differ in picture or lines, and so in the rows
                        // that they write.
                        let to = unsafe { y.part(at..at + width) };
                        if (z, row, step[2]) == (d, h, 2) {
                            zip(s, sums, zeros, to);
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
