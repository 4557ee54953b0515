//! 1×1 convolutions of stride 1: a matrix product of weights and pixels, in which
//! nothing is shifted and no tile need be packed.

use super::Out;
use super::plan::Plan;
use crate::cpu::disjoint::Disjoint;
use crate::cpu::fresh::fill;
use crate::cpu::gemm::{Base, Mat, PANEL, Packed, product_on};
use crate::cpu::simd::Tier;
use rayon::prelude::*;
use std::cell::RefCell;

/// Floats of a task's pixels, all channels: they stay in the second-level cache.
const FLOATS: usize = 1 << 17;
/// Most pixels of a task; whole panels of [`PANEL`].
const SPAN: usize = 2048;
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

thread_local! {
    static BUFFERS: RefCell<(Packed, Vec<f32>)> = RefCell::default();
}

/// As [`super::shift::run`].
pub(super) fn run(tier: Tier, plan: &Plan, x: &[f32], w: &[f32], bias: &[f32], y: &mut Out) {
    let (c, o) = (plan.src_channels, plan.dst_channels);
    let pixels: usize = plan.dst_size.iter().product();
    let weights = match plan.transposed {
        true => Mat::new(w, c, o, o).t(),
        false => Mat::new(w, o, c, c),
    };
    let span = (FLOATS / c.max(o)).clamp(PANEL, SPAN).next_multiple_of(PANEL);
    let spans = pixels.div_ceil(span);
    let images = y.len() / (o * pixels);
    let y = Disjoint::new(y);
    (0..images * spans).into_par_iter().for_each(|job| {
        let (image, first) = (job / spans, job % spans * span);
        let n = span.min(pixels - first);
        let x = &x[image * c * pixels + first..(image + 1) * c * pixels];
        // Taken, not borrowed: a job may run inside another one's wait.
        let (mut packed, mut sums) = BUFFERS.take();
        packed.fill(Mat::new(x, c, n, pixels));
        sums.resize(o * n, 0.0);
        let mut base = Base::Zero;
        if !bias.is_empty() {
            sums.chunks_exact_mut(n).zip(bias).for_each(|(row, bias)| row.fill(*bias));
            base = Base::Own;
        }
        product_on(tier, (&mut sums, n), weights, &packed, 1.0, base);
        for (channel, row) in sums.chunks_exact(n).enumerate() {
            let at = (image * o + channel) * pixels + first;
            // SAFETY: this span of this channel is this job's alone.
            fill(unsafe { y.part(at..at + n) }, row);
        }
        BUFFERS.set((packed, sums));
    });
}
