//! CPU kernels: plain `f32` slices in and out, rayon for threads, no tensors.
//!
//! Kernels trust their callers (the crate `subsplat` checks shapes and dtypes) and do not
//! fail. This is the only module of this crate where `unsafe` may appear.
//!
//! One file or folder per kernel; [`raster`] is the rasterizer.

pub mod activation;
pub mod adam;
pub mod adapter;
pub mod attention;
pub mod attention_gather;
pub mod attributes;
pub mod conv;
pub mod detail;
pub mod dssim;
pub mod feed_forward;
pub mod gemm;
pub mod join;
pub mod matching;
pub mod moves;
pub mod norm;
pub mod parameters;
pub mod plane_sweep;
pub mod raster;
pub mod redistribute;
pub mod resize;
mod shared_slice;
pub mod simd;
pub mod small;
pub mod softmax;
pub mod spgr;
pub mod sums;
mod uninit;
pub mod work;

pub use raster::{
    BackwardTimes, Frame, Geometry, Gradients, Rasterizer, Rendered, SplatSlices, StageTimes, Stats,
};
pub use simd::SimdLevel;
pub use uninit::zeros;
