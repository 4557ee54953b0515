//! 1×1 convolutions of stride 1: a matrix product of weights and pixels, in which
//! nothing is shifted and no tile need be packed.

use super::plan::Plan;
use crate::cpu::disjoint::Disjoint;
use crate::cpu::fresh;
use crate::cpu::gemm::{Base, Mat, PANEL, Packed, product_at};
use crate::cpu::simd::Tier;
use rayon::prelude::*;
use std::mem::MaybeUninit;

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

/// As [`super::shift::run`].
pub(super) fn run(
    tier: Tier,
    plan: &Plan,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    y: &mut fresh::Block<f32>,
) {
    let (c, o) = (plan.src_channels, plan.dst_channels);
    let pixels: usize = plan.dst_size.iter().product();
    let weights = match plan.transposed {
        true => Mat::new(w, c, o, o).t(),
        false => Mat::new(w, o, c, c),
    };
    let span = (FLOATS / c.max(o)).clamp(PANEL, SPAN).next_multiple_of(PANEL);
    let spans = pixels.div_ceil(span);
    let images = y.len() / (o * pixels);
    assert!(y.len() == images * o * pixels && (bias.is_empty() || bias.len() == o));
    let y = Disjoint::new(y);
    (0..images * spans).into_par_iter().for_each(|job| {
        let (image, first) = (job / spans, job % spans * span);
        let n = span.min(pixels - first);
        let x = &x[image * c * pixels + first..(image + 1) * c * pixels];
        let mut base = Base::Zero;
        for (channel, bias) in bias.iter().enumerate() {
            let at = (image * o + channel) * pixels + first;
            // SAFETY: this span of this channel is this job's alone.
            unsafe { y.part(at..at + n) }.fill(MaybeUninit::new(*bias));
            base = Base::Own;
        }
        let dst = (y.address(image * o * pixels + first).cast_mut().cast(), pixels);
        // SAFETY: spans of all channels of one picture, this job's alone, inside `y`
        // (asserted above); numbers where there is a bias.
        Packed::kept(Mat::new(x, c, n, pixels), |x| unsafe {
            product_at(tier, dst, weights, x, 1.0, base);
        });
    });
}
