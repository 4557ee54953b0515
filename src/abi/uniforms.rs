//! Uniforms of the WGSL kernels: what a kernel is told beside its arrays.
//!
//! Fields have the order, the types and the offsets of the WGSL struct of the same name
//! (`tests/shaders.rs` compares). No hidden padding: bytemuck refuses it.

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

uniform! {
    /// Of kernels/redistribute.wgsl.
    RedistributeUniform {
        /// P.
        parents: u32,
        /// K.
        children: u32,
        /// [`super::Rule`] as a number.
        rule: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Of the rasterizer's kernels: camera, options, and where what lies.
    RasterUniform {
        /// Row 0 of the rotation from world to camera; the eye's x.
        right: [f32; 4],
        /// Row 1; the eye's y.
        down: [f32; 4],
        /// Row 2; the eye's z.
        ahead: [f32; 4],
        /// fx, fy, px; pixel position of the axis, centres at integers.
        focal_centre: [f32; 4],
        /// Interval of x/z, then of y/z, inside the Jacobian.
        limits: [f32; 4],
        /// Background R, G, B; unused.
        background: [f32; 4],
        /// Nearest camera z drawn.
        near: f32,
        /// Added to camera z where a mean is projected.
        z_epsilon: f32,
        /// px².
        lowpass: f32,
        /// Largest alpha of a splat at a pixel.
        alpha_max: f32,
        /// Blending stops where T would become this or less.
        stop: f32,
        /// 1: opacities shrink with what the low-pass adds.
        antialiased: u32,
        /// 1: splats end at tile edges.
        tile_cut: u32,
        /// W, px.
        width: u32,
        /// H, px.
        height: u32,
        /// Tiles along x.
        columns: u32,
        /// Tiles along y, of the call.
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
        gain_lanes: u32,
        /// Room for (splat, tile) pairs.
        capacity: u32,
        /// Channel c of pixel p stands at p·`step` + c·`channel` of the picture.
        step: u32,
        /// See `step`.
        channel: u32,
        /// First row of tiles of the call: a picture may be drawn in bands.
        top: u32,
        /// 1: pixels and sums go on from what a call before left.
        resumes: u32,
        /// 1: pixels are left for a call after.
        carries: u32,
        /// Where the call's first splat stands in its footprints and sums.
        own: u32,
        /// First place of the call, in the order by depth.
        place: u32,
        /// Places of the call.
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
    /// Of the sort's kernels.
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
    /// Of kernels/show.wgsl.
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
    /// Of kernels/shared/gather.wgsl; fields as in [`super::Gather`] where not said.
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
        /// Whether there are keys.
        has_key: u32,
        /// First value channel.
        value: u32,
        /// Whether samples outside leave the softmax.
        renormalise: u32,
        /// Whether each level has points of its own.
        points_per_level: u32,
        /// ½ or 0, px.
        half_pixel: f32,
        /// Factor of q·k.
        logit_scale: f32,
        /// Whether weights are dropped.
        drops: u32,
        /// 1 / (1 − p).
        kept_factor: f32,
        /// Index of parent 0 in the scene.
        first_parent: u32,
        /// Low word of the seed.
        seed_low: u32,
        /// High word.
        seed_high: u32,
        /// Low word of ⌈p·2⁵³⌉.
        dropped_low: u32,
        /// High word.
        dropped_high: u32,
        /// Cells of the maps.
        cells: u32,
        /// Whether the points' gradient is wanted.
        point_gradient: u32,
    }
}

uniform! {
    /// Of kernels/shared/sweep.wgsl; fields as in [`super::Sweep`] where not said.
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
        /// Least z that the division sees.
        min_z: f32,
        /// Factor of the correlation.
        scale: f32,
        /// Unused.
        pad1: u32,
    }
}

uniform! {
    /// Of kernels/shared/spgr.wgsl; what each rule means is said at [`super::Rules`].
    SpgrUniform {
        /// N.
        parents: u32,
        /// r.
        side: u32,
        /// Parents per view.
        per_view: u32,
        /// Index of parent 0 in the scene.
        first: u32,
        /// V.
        views: u32,
        /// [`super::Rule`] as a number.
        rule: u32,
        /// Whether v* is the nearest view that sees the parent.
        nearest_visible: u32,
        /// Whether offsets are bounded.
        bounded: u32,
        /// Whether depth residuals run along the ray.
        ray: u32,
        /// Whether β_z is in units of the depth.
        relative_depth: u32,
        /// Whether children slide along the disc.
        disc: u32,
        /// Whether footprints take the parent's Jacobian.
        area_at_parent: u32,
        /// Whether two axes grow.
        two_axis: u32,
        /// Whether gains have four lanes.
        rgb_gain: u32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
        /// ρ, sub-pixels.
        offset_bound: f32,
        /// β_z.
        beta_z: f32,
        /// λ_s.
        lambda_s: f32,
        /// c.
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
    /// Of kernels/spgr_gains_bwd.wgsl.
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
    /// Of kernels/invert.wgsl.
    InvertUniform {
        /// Entries.
        entries: u32,
        /// Cells that they fall on.
        cells: u32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
    }
}
