//! Kernels on the CPU: plain slices in, plain slices out, parallel through rayon,
//! no tensors. Shapes and dtypes are checked by [`crate::ops`]; here lengths are
//! the caller's promise (`debug_assert!`).
//!
//! The rasterizer's stages, one file each: [`ewa`] (one splat), `project` (all
//! splats), `sort` (depth order), `tiles` (lists), `blend` (one tile), `rasterize`
//! (the frame).

mod blend;
pub mod ewa;
mod project;
mod rasterize;
pub mod sh;
mod sort;
mod tiles;

pub use project::{Geometry, SplatSlices};
pub use rasterize::{Rasterizer, Rendered, Stats};
