//! 1×1 convolutions of stride 1: a matrix product of weights and pixels, in which
//! nothing is shifted and no tile need be packed.

use super::plan::Plan;
use crate::cpu::gemm::{Base, Mat, Packed, product_on};
use crate::cpu::simd::Tier;
use rayon::prelude::*;

/// Output channels of a task: whole register tiles.
const ROWS: usize = 24;
/// Least channels read, and pixels, for which it wins.
const CHANNELS: usize = 16;
const PIXELS: usize = 256;

/// Whether `plan` can be, and had better be, run here.
pub(super) fn suits(plan: &Plan) -> bool {
    plan.kernel_taps == 1
        && plan.passes.len() == 1
        && plan.passes[0].taps.len() == 1
        && plan.src_step == [1; 3]
        && plan.dst_step == [1; 3]
        // One place and stride 1: there is no padding then.
        && plan.src_size == plan.dst_size
        && plan.src_channels >= CHANNELS
        && plan.dst_size.iter().product::<usize>() >= PIXELS
}

/// As [`super::shift::run`].
pub(super) fn run(tier: Tier, plan: &Plan, x: &[f32], w: &[f32], bias: &[f32], y: &mut [f32]) {
    let (c, o) = (plan.src_channels, plan.dst_channels);
    let pixels: usize = plan.dst_size.iter().product();
    let weights = match plan.transposed {
        true => Mat::new(w, c, o, o).t(),
        false => Mat::new(w, o, c, c),
    };
    // One picture at a time: another copy of one, not of all.
    for (x, y) in x.chunks_exact(c * pixels).zip(y.chunks_exact_mut(o * pixels)) {
        let packed = Packed::new_parallel(Mat::new(x, c, pixels, pixels));
        y.par_chunks_mut(ROWS * pixels).enumerate().for_each(|(i, y)| {
            let rows = y.len() / pixels;
            let mut base = Base::Zero;
            if !bias.is_empty() {
                let own = y.chunks_exact_mut(pixels).zip(&bias[i * ROWS..]);
                own.for_each(|(y, bias)| y.fill(*bias));
                base = Base::Own;
            }
            let first = i * ROWS * weights.row_stride;
            let lhs = Mat { data: &weights.data[first..], rows, ..weights };
            product_on(tier, (y, pixels), lhs, &packed, 1.0, base);
        });
    }
}
