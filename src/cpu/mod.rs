//! CPU kernels: plain `f32` slices in and out, rayon for threads, no tensors.
//!
//! Kernels trust their callers (`ops` checks shapes and dtypes) and do not fail.
//! This is the only room where `unsafe` may appear.

pub mod activation;
pub mod attention;
pub mod conv2d;
pub mod gemm;
pub mod math;
pub mod norm;
pub mod plane_sweep;
pub mod resize;
