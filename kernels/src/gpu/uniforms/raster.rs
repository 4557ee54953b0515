//! Uniforms of the rasterizer.

use super::UniformStruct;

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
    /// Parameters of wgsl/raster/show.wgsl.
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
