//! Gaussians that a step of the optimisation leaves out, so that none becomes right only together with others
//! that make up for its error (*DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting*, Park
//! et al. 2025). The others become denser by the same share: their optical depth −ln(1 − α) is divided by the
//! share that stays, where the paper multiplies α.
//!
//! Which ones is a hash of step and Gaussian. The same input gives the same bytes on any number of threads.

use rayon::prelude::*;
use subsplat_kernels::layout::{OPACITY_OFFSET, SPLAT_STRIDE, random};

/// Fewest photographs of which a step leaves Gaussians out.
const PHOTOGRAPHS_MIN: usize = 3;
/// Largest share that a step leaves out.
const SHARE_MAX: f32 = 0.1;
/// Fewest Gaussians of a parallel task.
const TASK: usize = 4096;

/// Share of the Gaussians that a step of a number of photographs leaves out: `dropout` over the number, at
/// most [`SHARE_MAX`]. Many photographs need less, because their pictures contradict a wrong Gaussian themselves.
pub(super) fn share(dropout: f32, photographs: usize) -> f32 {
    if photographs < PHOTOGRAPHS_MIN { 0.0 } else { (dropout / photographs as f32).min(SHARE_MAX) }
}

/// The Gaussians of one step.
pub(super) struct Dropout {
    step: u64,
    /// Hashes below this are left out.
    limit: u32,
    /// Factor of the others' optical depth.
    denser: f32,
}

impl Dropout {
    /// Leaves out `share` of the Gaussians, 0 to below 1, in the step `step`.
    pub fn new(share: f32, step: usize) -> Self {
        let limit = (f64::from(share) * f64::from(u32::MAX)) as u32;
        Self { step: step as u64, limit, denser: 1.0 / (1.0 - share) }
    }

    /// The same Gaussians on a GPU.
    #[cfg(feature = "gpu")]
    pub fn for_device(&self) -> subsplat_kernels::gpu::LeftOut {
        // The hash reads the lower half alone.
        let step = self.step as u32;
        subsplat_kernels::gpu::LeftOut { step, limit: self.limit, denser: self.denser }
    }

    /// Returns whether the step leaves out Gaussian `i`.
    fn leaves_out(&self, i: usize) -> bool {
        let key = ((self.step << 32) ^ i as u64).wrapping_add(1);
        ((random::mix(key.wrapping_mul(random::GOLDEN)) >> 32) as u32) < self.limit
    }

    /// Writes the Gaussians of the step to `drawn`: `rows` `[N, 11]` with other opacities.
    pub fn draw(&self, rows: &[f32], drawn: &mut Vec<f32>) {
        drawn.clear();
        drawn.extend_from_slice(rows);
        let rows = drawn.par_chunks_exact_mut(SPLAT_STRIDE).enumerate().with_min_len(TASK);
        rows.for_each(|(i, row)| {
            let free = 1.0 - row[OPACITY_OFFSET];
            let alpha = 1.0 - free.powf(self.denser);
            row[OPACITY_OFFSET] = if self.leaves_out(i) { 0.0 } else { alpha };
        });
    }

    /// Turns gradients by the Gaussians `drawn` into those by `rows`, all `[N, 11]`. Those left out have opacity 0.
    pub fn chain(&self, rows: &[f32], drawn: &[f32], gradients: &mut [f32]) {
        let rows = rows.par_chunks_exact(SPLAT_STRIDE);
        let rows = rows.zip(drawn.par_chunks_exact(SPLAT_STRIDE));
        let pairs = gradients.par_chunks_exact_mut(SPLAT_STRIDE).zip(rows);
        pairs.with_min_len(TASK).for_each(|(gradient, (row, drawn))| {
            let [free, drawn_free] = [row, drawn].map(|row| 1.0 - row[OPACITY_OFFSET]);
            // The drawn Gaussian has 1 − α' = (1 − α)ᵈ, d = `denser`.
            let slope = self.denser * drawn_free / free;
            gradient[OPACITY_OFFSET] *= if drawn_free == 1.0 { 0.0 } else { slope };
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gaussians with opacities from 0.01 to 0.99.
    fn rows() -> Vec<f32> {
        let row = |i: usize| {
            let mut row = [0.5; SPLAT_STRIDE];
            row[OPACITY_OFFSET] = 0.01 + 0.98 * (i % 1000) as f32 / 999.0;
            row
        };
        (0..20_000).flat_map(row).collect()
    }

    fn opacities(rows: &[f32]) -> Vec<f32> {
        rows.chunks_exact(SPLAT_STRIDE).map(|row| row[OPACITY_OFFSET]).collect()
    }

    #[test]
    fn few_photographs_leave_out_more() {
        let shares = [2, 3, 5, 10, 50].map(|n| share(0.5, n));
        assert_eq!(shares, [0.0, 0.1, 0.1, 0.05, 0.01]);
    }

    #[test]
    fn a_step_leaves_out_its_share_and_the_next_step_others() {
        let rows = rows();
        let mut drawn = Vec::new();
        let mut left_out = |step| {
            Dropout::new(0.1, step).draw(&rows, &mut drawn);
            opacities(&drawn).iter().map(|alpha| *alpha == 0.0).collect::<Vec<bool>>()
        };
        let steps = [0, 1, 2].map(&mut left_out);
        for step in &steps {
            let count = step.iter().filter(|out| **out).count();
            // Six standard deviations of a binomial distribution.
            assert!((1750..2250).contains(&count), "{count}");
        }
        let both = steps[0].iter().zip(&steps[1]).filter(|(a, b)| **a && **b).count();
        assert!((120..290).contains(&both), "{both}");
        assert_eq!(steps[1], left_out(1));
    }

    #[test]
    fn the_mean_optical_depth_stays() {
        let rows = rows();
        let mut drawn = Vec::new();
        Dropout::new(0.1, 7).draw(&rows, &mut drawn);
        let depth = |rows: &[f32]| -> f64 {
            opacities(rows).iter().map(|alpha| -f64::from(1.0 - alpha).ln()).sum()
        };
        let ratio = depth(&drawn) / depth(&rows);
        assert!((ratio - 1.0).abs() < 0.02, "{ratio}");
    }

    #[test]
    fn gradients_are_finite_differences() {
        let rows = rows();
        let dropout = Dropout::new(0.1, 3);
        let weight = |i: usize| 1.0 + (i % 7) as f32;
        let mut gradients: Vec<f32> = (0..rows.len()).map(|at| weight(at / SPLAT_STRIDE)).collect();
        let mut drawn = Vec::new();
        dropout.draw(&rows, &mut drawn);
        dropout.chain(&rows, &drawn, &mut gradients);
        let drawn = |difference: f32| {
            let mut moved = rows.clone();
            for row in moved.chunks_exact_mut(SPLAT_STRIDE) {
                row[OPACITY_OFFSET] += difference;
            }
            let mut drawn = Vec::new();
            dropout.draw(&moved, &mut drawn);
            opacities(&drawn)
        };
        let (low, high) = (drawn(-2e-3), drawn(2e-3));
        for (i, gradient) in opacities(&gradients).iter().enumerate() {
            let expected = weight(i) * (high[i] - low[i]) / 4e-3;
            assert!((gradient - expected).abs() < 2e-2 * weight(i), "{i}: {gradient} {expected}");
        }
        // Nothing else changes.
        assert_eq!(gradients[SPLAT_STRIDE], weight(1));
    }
}
