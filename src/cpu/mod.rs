//! CPU kernels: plain `f32` slices in and out, rayon for threads, no tensors.
//!
//! Kernels trust their callers ([`crate::ops`] checks shapes and dtypes) and do not
//! fail. This is the only module where `unsafe` may appear.
//!
//! The rasterizer's stages, one file each: [`ewa`] (one splat), `project` (all
//! splats), `tiles` (lists), `sort` (depth order in a tile), `blocks` and `blend` (one
//! tile), `rasterize` (the frame).

pub mod activation;
pub mod adam;
pub mod adapter;
pub mod attention;
pub mod attention_gather;
pub mod attributes;
mod blend;
mod blocks;
mod colour_bwd;
pub mod conv;
mod covariance;
pub mod detail;
pub mod dssim;
pub mod ewa;
mod ewa_bwd;
pub mod feed_forward;
pub mod gemm;
pub mod join;
pub mod matching;
pub mod moves;
pub mod norm;
pub mod plane_sweep;
mod project;
mod project_bwd;
mod raster_bwd;
mod raster_bwd_tile;
mod rasterize;
pub mod redistribute;
pub mod resize;
pub mod sh;
mod sh_bwd;
mod shared_slice;
pub mod simd;
pub mod small;
pub mod softmax;
mod sort;
pub mod spgr;
pub mod sums;
mod tiles;
mod uninit;
pub mod work;

pub use project::{Geometry, SplatSlices};
pub use project_bwd::Gradients;
pub use raster_bwd::{BackwardTimes, Frame};
pub use rasterize::{Rasterizer, Rendered, StageTimes, Stats};
pub use simd::SimdLevel;
pub use uninit::zeros;
