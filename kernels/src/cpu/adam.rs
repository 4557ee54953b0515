//! One step of Adam or AdamW on the elements of a parameter, with clipping and the moving average of
//! the weights (Kingma and Ba 2015, algorithm 1; Loshchilov and Hutter 2019).
//!
//! WGSL: kernels/adam.wgsl. Oracle and tests: tools/lab/tests/scores/train_parts.rs, tests/gpu/optimizer.rs.

use rayon::prelude::*;

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
                let [b1, b2] = self.betas;
                for i in 0..g.len() {
                    let g = g[i] * self.clip;
                    m[i] = b1 * m[i] + (1.0 - b1) * g;
                    v[i] = b2 * v[i] + (1.0 - b2) * g * g;
                    let step = self.rate * m[i] / (v[i].sqrt() * self.root + self.epsilon);
                    value[i] = self.keep * value[i] - step;
                    average[i] += (1.0 - self.average) * (value[i] - average[i]);
                }
            });
    }
}
