//! The rasterizer: projection, sort, lists of (splat, tile) pairs, blending, their gradients, and
//! drawing to a texture of the application. CPU version: cpu/raster. WGSL: wgsl/raster.

pub(crate) mod constants;
pub(crate) mod frame;
pub(crate) mod kernels;
pub(crate) mod layers;
pub(crate) mod rasterize;
pub(crate) mod rasterize_bwd;
pub(crate) mod scene;
pub(crate) mod show;
pub(crate) mod sort;
