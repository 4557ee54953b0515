//! ∂L/∂bias: for each output channel the sum of ∂L/∂y over images and pixels.

use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel};
use rayon::prelude::*;

/// Numbers that are summed in f32 lanes before the sum is added to an f64. A sum of a
/// million numbers in f32 alone loses three digits.
const F32_BLOCK: usize = 4096;

/// Sums `dy` `[B, O, pixels]` over images and pixels; overwrites `db` `[O]`.
pub fn bias_grad(pixels: usize, dy: &[f32], db: &mut [f32]) {
    let channels = db.len();
    db.par_iter_mut().enumerate().for_each(|(o, sum)| {
        let rows = dy.chunks_exact(pixels.max(1)).skip(o).step_by(channels);
        *sum = SimdLevel::best().run(SumRows(rows)) as f32;
    });
}

/// Sums all numbers of an iterator of rows.
struct SumRows<I>(I);

impl<'a, I: Iterator<Item = &'a [f32]>> Kernel for SumRows<I> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let mut total = 0.0;
        for row in self.0 {
            for block in row.chunks(F32_BLOCK) {
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
