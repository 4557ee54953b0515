//! Convolutions of any kernel, stride and padding over two or three axes, forward and
//! both gradients, without im2col (cross-correlation, as in PyTorch).
//!
//! x `[B, C, D, H, W]`, w `[O, C, kd, kh, kw]`, y `[B, O, D', H', W']`, zero padding;
//! in two dimensions D = 1. `plan` says what is read and written, `shift` computes y
//! and ∂L/∂x, `weights` ∂L/∂w. Any number of threads gives the same bytes.
//! Twins: none yet. Oracle: the definition in f64 (the tests).
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over register tiles unroll, iterators over them need not"
)]

mod forms;
mod gather;
mod plan;
mod pointwise;
mod shift;
#[cfg(test)]
mod tests;
mod weights;
mod winograd;
mod winograd_few;
mod winograd_weights;

use super::simd::{Kernel, LANES, Simd, SimdLevel};
use super::uninit::{UninitBuffer, UninitSlice};
use plan::Plan;
use rayon::prelude::*;
use std::cell::{Cell, RefCell};

pub use plan::{Axes, Sizes};
pub use weights::weight_grad;

/// y = x ∗ w + bias of `images` pictures; `bias` is empty or `[O]`.
pub fn forward(
    level: SimdLevel,
    s: &Sizes,
    images: usize,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    fresh(level, &Plan::forward(s), images, x, w, bias)
}

/// ∂L/∂x from ∂L/∂y of `images` pictures.
pub fn input_grad(level: SimdLevel, s: &Sizes, images: usize, dy: &[f32], w: &[f32]) -> Vec<f32> {
    fresh(level, &Plan::input_grad(s), images, dy, w, &[])
}

/// [`run`] into new memory.
fn fresh(
    level: SimdLevel,
    plan: &Plan,
    images: usize,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
) -> Vec<f32> {
    let pixels: usize = plan.dst_size.iter().product();
    let mut y = UninitBuffer::new(images * plan.dst_channels * pixels);
    run(level, plan, x, w, bias, y.as_mut_slice());
    // SAFETY: each of the three ways writes every channel of every picture in tiles that
    // cover it (the tests run them over memory full of NaN).
    unsafe { y.assume_init() }
}

/// The fastest of the three ways. For numbers in ±1 and n products a sum, [`winograd`] is
/// within 3e-6·√n of the exact sum, [`shift`] and [`pointwise`] within 1.5e-6·√n (the
/// tests hold them).
fn run(
    level: SimdLevel,
    plan: &Plan,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    y: &mut UninitSlice<f32>,
) {
    if y.is_empty() {
        return;
    }
    if pointwise::suits(plan) {
        pointwise::run(level, plan, x, w, bias, y);
    } else if let Some(way) = winograd::Way::of(plan) {
        if winograd::Way::few(plan) {
            winograd_few::run(level, plan, way, x, w, bias, y);
            return;
        }
        let w = winograd::Weights::new(level, plan, way, w, WEIGHTS.take());
        winograd::run(level, plan, way, x, &w, bias, y);
        keep(w.into_memory());
    } else {
        let w = shift::Weights::new(plan, w, WEIGHTS.take());
        shift::run(level, plan, x, &w, bias, y);
        keep(w.into_memory());
    }
}

/// Most floats of weights that a thread keeps: longer blocks are the allocator's to
/// keep, where a program has one that does ([`super::pages`]).
const KEPT: usize = 1 << 20;

fn keep(memory: Vec<f32>) {
    if memory.capacity() < KEPT {
        WEIGHTS.set(memory);
    }
}

thread_local! {
    static BUFFERS: RefCell<Buffers> = RefCell::default();
    /// Memory of the weights in the kernels' order.
    static WEIGHTS: Cell<Vec<f32>> = Cell::default();
}

/// What a thread keeps from call to call, so that calls need not ask for megabytes of
/// fresh pages.
#[derive(Default)]
struct Buffers {
    /// A packed tile.
    x: Buffer,
    /// Sums before they are written, or gradients turned over.
    y: Buffer,
    /// Transformed tiles of x.
    tiles: Buffer,
    /// Transformed tiles of ∂L/∂y.
    gradients: Buffer,
    /// Products of transformed tiles.
    products: Buffer,
}

impl Buffers {
    /// Runs `f` with this thread's own (empty ones, should `f` come here again).
    fn with<R>(f: impl FnOnce(&mut Self) -> R) -> R {
        let mut own = BUFFERS.take();
        let result = f(&mut own);
        BUFFERS.set(own);
        result
    }
}

/// Sixteen floats on a cache line of their own.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
struct Line([f32; LANES]);

/// Floats from the start of a cache line, so that whole vectors never straddle two.
#[derive(Default)]
struct Buffer(Vec<Line>);

impl Buffer {
    /// Room for `n` floats, with what the last use left there.
    fn room(&mut self, n: usize) -> &mut [f32] {
        if self.0.len() * LANES < n {
            self.0.resize(n.div_ceil(LANES), Line::default());
        }
        let lines: &mut [Line] = &mut self.0;
        let floats = lines.len() * LANES;
        // SAFETY: a line is 16 floats and nothing else.
        let all = unsafe { std::slice::from_raw_parts_mut(lines.as_mut_ptr().cast(), floats) };
        &mut all[..n]
    }
}

/// Numbers that are summed in f32 lanes before they go to an f64: a sum over a
/// million in f32 alone loses three digits.
const BLOCK: usize = 4096;

/// ∂L/∂bias: sums of `dy` `[B, O, pixels]` over pictures and pixels, `db` overwritten.
pub fn bias_grad(pixels: usize, dy: &[f32], db: &mut [f32]) {
    let channels = db.len();
    db.par_iter_mut().enumerate().for_each(|(o, sum)| {
        let rows = dy.chunks_exact(pixels.max(1)).skip(o).step_by(channels);
        *sum = SimdLevel::best().run(Sum(rows)) as f32;
    });
}

/// Sum of all numbers of some rows.
struct Sum<I>(I);

impl<'a, I: Iterator<Item = &'a [f32]>> Kernel for Sum<I> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let mut total = 0.0;
        for row in self.0 {
            for block in row.chunks(BLOCK) {
                let mut sums = [s.splat(0.0); 4];
                let (groups, rest) = block.as_chunks::<{ 4 * LANES }>();
                for group in groups {
                    for (sum, v) in sums.iter_mut().zip(group.as_chunks().0) {
                        *sum = *sum + s.load(v);
                    }
                }
                let lanes = s.sum((sums[0] + sums[1]) + (sums[2] + sums[3]));
                total += f64::from(lanes) + f64::from(rest.iter().sum::<f32>());
            }
        }
        total
    }
}
