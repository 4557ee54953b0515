//! Convolutions of any kernel, stride and padding over two or three axes, forward and
//! both gradients, without im2col (cross-correlation, as in PyTorch).
//!
//! x `[B, C, D, H, W]`, w `[O, C, kd, kh, kw]`, y `[B, O, D', H', W']`, zero padding;
//! in two dimensions D = 1. `plan` says what is read and written, `shift` computes y
//! and ∂L/∂x, `weights` ∂L/∂w. Any number of threads gives the same bytes.
//! Twins: none yet. Oracle: the definition in f64 (the tests).

mod plan;
mod shift;
#[cfg(test)]
mod tests;
mod weights;

use super::simd::{Kernel, LANES, Simd, Tier};
use plan::Plan;
use rayon::prelude::*;

pub use plan::{Axes, Sizes};
pub use weights::weight_grad;

/// y = x ∗ w + bias. `y` is overwritten; `bias` is empty or `[O]`.
pub fn forward(tier: Tier, s: &Sizes, x: &[f32], w: &[f32], bias: &[f32], y: &mut [f32]) {
    let plan = Plan::forward(s);
    shift::run(tier, &plan, x, &shift::Weights::new(&plan, w), bias, y);
}

/// ∂L/∂x from ∂L/∂y, `dx` overwritten.
pub fn input_grad(tier: Tier, s: &Sizes, dy: &[f32], w: &[f32], dx: &mut [f32]) {
    let plan = Plan::input_grad(s);
    shift::run(tier, &plan, dy, &shift::Weights::new(&plan, w), &[], dx);
}

/// Numbers that are summed in f32 lanes before they go to an f64: a sum over a
/// million in f32 alone loses three digits.
const BLOCK: usize = 4096;

/// ∂L/∂bias: sums of `dy` `[B, O, pixels]` over pictures and pixels, `db` overwritten.
pub fn bias_grad(pixels: usize, dy: &[f32], db: &mut [f32]) {
    let channels = db.len();
    db.par_iter_mut().enumerate().for_each(|(o, sum)| {
        let rows = dy.chunks_exact(pixels.max(1)).skip(o).step_by(channels);
        *sum = Tier::best().run(Sum(rows)) as f32;
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
