//! CPU kernels: plain `f32` slices in and out, rayon for threads, no tensors.
//!
//! Kernels trust their callers ([`crate::ops`] checks shapes and dtypes) and do not
//! fail. This is the only room where `unsafe` may appear.
//!
//! The rasterizer's stages, one file each: [`ewa`] (one splat), `project` (all
//! splats), `sort` (depth order), `tiles` (lists), `blend` (one tile), `rasterize`
//! (the frame).

pub mod activation;
pub mod attention;
pub mod attention_gather;
mod blend;
pub mod conv2d;
pub mod detail;
pub mod ewa;
pub mod gemm;
pub mod lanes;
pub mod matching;
pub mod math;
pub mod norm;
pub mod plane_sweep;
mod project;
mod rasterize;
pub mod real;
pub mod redistribute;
pub mod resize;
pub mod sh;
mod sort;
pub mod spgr;
mod tiles;

pub use project::{Geometry, SplatSlices};
pub use rasterize::{Rasterizer, Rendered, Stats};
