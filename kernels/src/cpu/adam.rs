//! One step of Adam on the elements of a parameter (Kingma and Ba 2015, algorithm 1): for training,
//! with decoupled decay, clipping and the moving average of the weights (AdamW, Loshchilov and Hutter
//! 2019); and for Gaussians of which a photograph shows a part.
//!
//! WGSL: wgsl/network/adam.wgsl (training), wgsl/finish/optimise.wgsl (Gaussians). Oracles and tests:
//! tools/lab/tests/scores/train_parts.rs, tests/gpu/optimizer.rs; finish/optimiser.rs.

use super::simd::vectorize;
use rayon::prelude::*;

/// Updates the two moments of an element with its gradient `g`.
#[inline(always)]
fn update_moments([b1, b2]: [f32; 2], g: f32, m: &mut f32, v: &mut f32) {
    *m = b1 * *m + (1.0 - b1) * g;
    *v = b2 * *v + (1.0 - b2) * g * g;
}

/// Constants of one parameter's step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AdamStep {
    /// Factor of the gradients.
    pub clip: f32,
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// Learning rate over the bias correction of the first moment.
    pub rate: f32,
    /// Factor of the root of the second moment: its bias correction.
    pub root: f32,
    /// Term added to that root.
    pub epsilon: f32,
    /// Factor of the values: 1 minus the decoupled decay.
    pub keep: f32,
    /// Decay of the moving average.
    pub average: f32,
}

impl AdamStep {
    /// Updates values, moments and average in place from gradients `g` of the same length.
    pub fn run(&self, g: &[f32], value: &mut [f32], [m, v]: [&mut [f32]; 2], average: &mut [f32]) {
        /// Elements of one parallel task.
        const TASK: usize = 1 << 14;
        g.par_chunks(TASK)
            .zip(value.par_chunks_mut(TASK).zip(average.par_chunks_mut(TASK)))
            .zip(m.par_chunks_mut(TASK).zip(v.par_chunks_mut(TASK)))
            .for_each(|((g, (value, average)), (m, v))| {
                for i in 0..g.len() {
                    update_moments(self.betas, g[i] * self.clip, &mut m[i], &mut v[i]);
                    let step = self.rate * m[i] / (v[i].sqrt() * self.root + self.epsilon);
                    value[i] = self.keep * value[i] - step;
                    average[i] += (1.0 - self.average) * (value[i] - average[i]);
                }
            });
    }
}

/// Constants of one parameter's step for Gaussians, of which some stay (`SelectiveAdam` of gsplat).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SelectiveAdam {
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// Learning rate.
    pub rate: f32,
    /// Bias corrections, divisors of the moments: 1 − βⁿ after n steps.
    pub corrections: [f32; 2],
    /// Term added to the root of the second moment.
    pub epsilon: f32,
}

impl SelectiveAdam {
    /// Updates values and moments in place from finite gradients `g`, where `moves` is true. All slices
    /// have the same length.
    pub fn run(&self, g: &[f32], moves: &[bool], value: &mut [f32], [m, v]: [&mut [f32]; 2]) {
        let n = g.len();
        let (moves, value, m, v) = (&moves[..n], &mut value[..n], &mut m[..n], &mut v[..n]);
        vectorize(
            #[inline(always)]
            || {
                for i in 0..n {
                    let (mut first, mut second) = (m[i], v[i]);
                    update_moments(self.betas, g[i], &mut first, &mut second);
                    let root = (second / self.corrections[1]).sqrt() + self.epsilon;
                    let next = value[i] - self.rate * (first / self.corrections[0]) / root;
                    // Selections instead of a branch: the loop has a SIMD form.
                    m[i] = if moves[i] { first } else { m[i] };
                    v[i] = if moves[i] { second } else { v[i] };
                    value[i] = if moves[i] { next } else { value[i] };
                }
            },
        );
    }
}
