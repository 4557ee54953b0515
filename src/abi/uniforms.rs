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
        /// Tiles along y.
        rows: u32,
        /// First splat of the call.
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
        /// Unused.
        pad: u32,
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
        /// H, px.
        height: u32,
        /// 1: the texture encodes sRGB itself.
        srgb: u32,
        /// Unused.
        pad: u32,
    }
}
