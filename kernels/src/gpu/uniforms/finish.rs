//! Uniforms of the optimisation of a scene.

use super::UniformStruct;

uniform! {
    /// Parameters of wgsl/shared/loss.wgsl and its kernels.
    LossUniform {
        /// W, px.
        width: u32,
        /// H, px.
        height: u32,
        /// Windows of SSIM along x: W − 10.
        windows_x: u32,
        /// Along y.
        windows_y: u32,
        /// 1: pixels count by their coverage.
        covered: u32,
        /// 1: the loss has the dissimilarity.
        dssim: u32,
        /// 1: sums of SSIM are written.
        scores: u32,
        /// Coverage up to which a pixel does not count.
        coverage_min: f32,
        /// Factor of x − t in the gradient.
        squares_factor: f32,
        /// Factor of the derivative of the sum of SSIM.
        dssim_factor: f32,
        /// C₁ of SSIM.
        light_term: f32,
        /// C₂.
        structure_term: f32,
        /// Factor of variances and covariances.
        covariance: f32,
        /// Unused.
        pad_a: u32,
        /// Unused.
        pad_b: u32,
        /// Unused.
        pad_c: u32,
        /// Taps of the window's one axis; the last one is unused.
        taps: [[f32; 4]; 3],
    }
}

uniform! {
    /// Parameters of wgsl/shared/parameters.wgsl and its kernels.
    OptimiseUniform {
        /// N.
        count: u32,
        /// Parameters that move.
        moves: u32,
        /// E, elements of these parameters.
        elements: u32,
        /// Floats of an SH set.
        sh_stride: u32,
        /// 1: the gradients are added to those of the photographs before.
        adds: u32,
        /// 1: every Gaussian moves, not only those with a gradient.
        all_move: u32,
        /// Weight of the gradients across.
        across: f32,
        /// Factor of σ at the start.
        scale: f32,
        /// Step, for the choice of the Gaussians that it leaves out.
        step: u32,
        /// Gaussians with hashes below this are left out.
        limit: u32,
        /// Factor of the others' optical depth; 0: the step draws all.
        denser: f32,
        /// 1: only the Gaussians `first` to `past` are drawn; 2: only the others.
        range: u32,
        /// See `range`.
        first: u32,
        /// See `range`.
        past: u32,
        /// Decay of the first moment.
        first_decay: f32,
        /// Decay of the second moment.
        second_decay: f32,
        /// Bias correction of the first moment, a divisor.
        first_correction: f32,
        /// Bias correction of the second moment, a divisor.
        second_correction: f32,
        /// Term added to the root of the second moment.
        epsilon: f32,
        /// Unused.
        pad: u32,
        /// Of each parameter: buffer, first number, form, and the plane of its numbers before the
        /// phase.
        parameters: [[u32; 4]; 8],
        /// Of each parameter: learning rate, least and largest value.
        rates: [[f32; 4]; 8],
    }
}
