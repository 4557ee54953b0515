//! Uniforms of SPGR and of opacity redistribution.

use super::UniformStruct;

uniform! {
    /// Parameters of wgsl/spgr/redistribute.wgsl.
    RedistributeUniform {
        /// P.
        parents: u32,
        /// K.
        children: u32,
        /// [`crate::layout::OpacityRule`] as a number.
        rule: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of wgsl/shared/spgr.wgsl; [`crate::layout::Rules`] documents the options.
    SpgrUniform {
        /// N.
        parents: u32,
        /// Parents per view.
        per_view: u32,
        /// Index in the scene of the call's first parent.
        first: u32,
        /// V.
        views: u32,
        /// [`crate::layout::OpacityRule`] as a number.
        rule: u32,
        /// 1: v* is the nearest of the views in whose picture the parent lies.
        nearest_visible: u32,
        /// 1: offsets are bounded.
        bounded: u32,
        /// 1: depth residuals are applied along the viewing ray.
        ray: u32,
        /// 1: β_z is in units of the parent's depth.
        relative_depth: u32,
        /// 1: children move along the parent's disc.
        disc: u32,
        /// 1: the Jacobian of a footprint is taken at the parent.
        area_at_parent: u32,
        /// 1: the clamp of the footprint grows two axes.
        two_axis: u32,
        /// 1: gains have four floats.
        rgb_gain: u32,
        /// Columns of [`crate::layout::Positions`].
        columns: u32,
        /// Its rows.
        rows: u32,
        /// Its step.
        step: u32,
        /// √K.
        zoom: f32,
        /// ρ, sub-pixels.
        offset_bound: f32,
        /// β_z.
        beta_z: f32,
        /// λ_s.
        lambda_s: f32,
        /// c of the soft bound of Δlog s.
        dlog_clamp: f32,
        /// A_min, target px².
        a_min: f32,
        /// Low-pass of the target picture, target px².
        lowpass_target: f32,
        /// Low-pass of a native render, input px².
        lowpass_input: f32,
        /// δ.
        delta: f32,
    }
}

uniform! {
    /// Parameters of wgsl/spgr/spgr_gains_bwd.wgsl.
    SpgrGainsBwdUniform {
        /// N·K.
        records: u32,
        /// Floats of gain per record, 1 or 4.
        lanes: u32,
        /// δ.
        delta: f32,
        /// Unused.
        pad: u32,
    }
}
