//! CPU kernels: plain slices in and out, rayon for threads, no tensors.
//!
//! Kernels trust their callers (`ops` checks shapes and dtypes) and do not fail.
//! This is the only room where `unsafe` may appear.

pub mod attention_gather;
pub mod real;
pub mod redistribute;
pub mod spgr;
