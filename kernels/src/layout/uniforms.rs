//! Uniforms of the WGSL kernels: the parameters of a call beside its arrays.
//!
//! Fields have the order, the types and the offsets of the WGSL struct of the same name
//! (`tests/gpu/shaders.rs` compares them). bytemuck refuses hidden padding.

/// A uniform struct and the table of its fields' offsets.
macro_rules! uniform {
    ($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $ty:ty,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $ty,)*
        }

        impl $name {
            /// Name and byte offset of every field.
            pub const FIELDS: &'static [(&'static str, usize)] =
                &[$((stringify!($field), std::mem::offset_of!($name, $field)),)*];
        }
    };
}

mod network;

pub use network::{
    AdamUniform, AdapterUniform, AttentionUniform, AttributesUniform, ConvexUniform,
    ConvolutionUniform, CrossCheckUniform, DepthConsensusUniform, ElementwiseUniform,
    ExpectationUniform, HeadOutputUniform, LinearUniform, LinearWeightBwdUniform, NormUniform,
    OcclusionUniform, RawMatchingUniform, ReduceUniform, ResizeUniform, RowsUniform, SelectUniform,
    SumPartsUniform,
};

uniform! {
    /// Parameters of kernels/redistribute.wgsl.
    RedistributeUniform {
        /// P.
        parents: u32,
        /// K.
        children: u32,
        /// [`super::OpacityRule`] as a number.
        rule: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of the rasterizer's kernels: camera, options, sizes, offsets.
    RasterUniform {
        /// Row 0 of the rotation from world to camera; the camera's x in world.
        right: [f32; 4],
        /// Row 1; the camera's y.
        down: [f32; 4],
        /// Row 2; the camera's z.
        ahead: [f32; 4],
        /// fx, fy, px; principal point, px, pixel centres at integers.
        focal_centre: [f32; 4],
        /// Bounds of x/z, then of y/z, inside the Jacobian: low, high.
        limits: [f32; 4],
        /// Background R, G, B; unused.
        background: [f32; 4],
        /// Nearest camera z that is rendered, world units.
        near: f32,
        /// Term added to camera z in the projection of a mean, world units.
        z_epsilon: f32,
        /// Low-pass, px².
        lowpass: f32,
        /// Largest alpha of a splat at a pixel.
        alpha_max: f32,
        /// Blending stops where the transmittance would fall to this or below.
        stop: f32,
        /// 1: opacities are scaled by √(det Σ / det(Σ + low-pass)).
        antialiased: u32,
        /// 1: splats are cut at the edges of 16×16 tiles.
        tile_cut: u32,
        /// W, px.
        width: u32,
        /// H, px.
        height: u32,
        /// Tiles along x.
        columns: u32,
        /// Tiles along y of the call.
        rows: u32,
        /// First splat of the call, in the scene.
        first: u32,
        /// Splats of the call.
        count: u32,
        /// K.
        children: u32,
        /// Floats of a splat's row: 11, or 10 with covariances.
        stride: u32,
        /// Floats of an SH set.
        sh_stride: u32,
        /// Degree evaluated.
        sh_degree: u32,
        /// 1: the basis of MVSplat.
        sh_mvsplat: u32,
        /// 1: one direction per parent.
        sh_shared: u32,
        /// Floats of a splat's gain: 0, 1 or 4.
        gain_channels: u32,
        /// Largest number of (splat, tile) pairs that the buffers hold.
        capacity: u32,
        /// Channel c of pixel p is at p·`step` + c·`channel` of the picture.
        step: u32,
        /// See `step`.
        channel: u32,
        /// First row of tiles of the call; a picture may be rendered in bands.
        top: u32,
        /// 1: pixels and sums start from the results of the previous call.
        resumes: u32,
        /// 1: the next call continues the pixels.
        carries: u32,
        /// Index of the call's first splat in its footprints and sums.
        own: u32,
        /// First position of the call in the order by depth.
        place: u32,
        /// Positions of the call.
        places: u32,
        /// Unused.
        pad_a: u32,
        /// Unused.
        pad_b: u32,
        /// Unused.
        pad_c: u32,
    }
}

uniform! {
    /// Parameters of the kernels of the sort.
    SortUniform {
        /// Lowest bit of the digit.
        shift: u32,
        /// Unused.
        pad_a: u32,
        /// Unused.
        pad_b: u32,
        /// Unused.
        pad_c: u32,
    }
}

uniform! {
    /// Parameters of kernels/show.wgsl.
    ShowUniform {
        /// W, px.
        width: u32,
        /// Rows of pixels of the band.
        height: u32,
        /// 1: the texture encodes sRGB itself.
        srgb: u32,
        /// First row of pixels of the band.
        top: u32,
    }
}

uniform! {
    /// Parameters of kernels/shared/gather.wgsl; [`super::Gather`] documents the fields in full.
    AttentionGatherUniform {
        /// N.
        parents: u32,
        /// V.
        views: u32,
        /// L.
        levels: u32,
        /// M.
        points: u32,
        /// Floats of the points of one parent and view.
        points_width: u32,
        /// E.
        dim: u32,
        /// G.
        groups: u32,
        /// Floats of a cell's row.
        stride: u32,
        /// First key channel.
        key: u32,
        /// 1: there are keys.
        has_key: u32,
        /// First value channel.
        value: u32,
        /// 1: samples outside the map are left out of the softmax.
        renormalise: u32,
        /// 1: each level has points of its own.
        points_per_level: u32,
        /// ½ or 0, px.
        half_pixel: f32,
        /// Factor of q·k.
        logit_scale: f32,
        /// 1: dropout.
        drops: u32,
        /// 1 / (1 − p).
        kept_factor: f32,
        /// Index in the scene of the call's first parent.
        first_parent: u32,
        /// Low word of the seed.
        seed_low: u32,
        /// High word.
        seed_high: u32,
        /// Low word of ⌈p·2⁵³⌉.
        dropped_low: u32,
        /// High word.
        dropped_high: u32,
        /// Number of cells of the maps.
        cells: u32,
        /// 1: the gradient of the points is computed.
        point_gradient: u32,
    }
}

uniform! {
    /// Parameters of kernels/shared/sweep.wgsl; [`super::Sweep`] documents the fields in full.
    PlaneSweepUniform {
        /// R of the call.
        rows: u32,
        /// C.
        channels: u32,
        /// D.
        candidates: u32,
        /// h.
        height: u32,
        /// w.
        width: u32,
        /// Pairs of all rows.
        pairs: u32,
        /// S.
        sources: u32,
        /// Unused.
        pad0: u32,
        /// Coordinate of the centre of pixel 0.
        centre: f32,
        /// Smallest divisor z.
        min_z: f32,
        /// Factor of the correlation.
        scale: f32,
        /// Unused.
        pad1: u32,
    }
}

uniform! {
    /// Parameters of kernels/shared/spgr.wgsl; [`super::Rules`] documents the options.
    SpgrUniform {
        /// N.
        parents: u32,
        /// Parents per view.
        per_view: u32,
        /// Index in the scene of the call's first parent.
        first: u32,
        /// V.
        views: u32,
        /// [`super::OpacityRule`] as a number.
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
        /// Columns of [`super::Positions`].
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
    /// Parameters of kernels/spgr_gains_bwd.wgsl.
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

uniform! {
    /// Parameters of kernels/invert.wgsl.
    InvertUniform {
        /// Number of entries.
        entries: u32,
        /// Number of cells that the entries refer to.
        cells: u32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
    }
}
