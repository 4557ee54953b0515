//! Sizes and layouts that only the GPU rasterizer uses, in Rust and in WGSL (gpu/constants.rs).

/// Side of the tiles of the GPU kernels, px: one thread per pixel.
pub const TILE_GPU: usize = 16;
/// Floats of a projected splat in the GPU kernels (wgsl/shared/raster.wgsl).
pub const FOOTPRINT_STRIDE: usize = 12;
/// Sums over pixels per (splat, tile) pair in the rasterizer's backward kernels: of
/// ∂L/∂ln α times six moments, and of weights times four gradients.
pub const PAIR_SUMS: usize = 10;
/// Elements per workgroup of the GPU's sort and prefix sum.
pub const GPU_BLOCK: usize = 2048;
/// Offset in the plan of a sort: number of elements.
pub const PLAN_COUNT: usize = 3;
/// Offset in the plan: number of blocks of [`GPU_BLOCK`] elements.
pub const PLAN_BLOCKS: usize = 4;
/// Offset in the plan: number of elements that the buffers would need.
pub const PLAN_REQUESTED: usize = 5;
/// Offset in the plan: workgroups of 256 elements along x, y and z. Those of blocks are at 0.
pub const PLAN_ELEMENT_GROUPS: usize = 8;
/// Words of a plan.
pub const PLAN_WORDS: usize = 12;
