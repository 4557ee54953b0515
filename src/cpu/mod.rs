//! Kernels on the CPU: plain slices in, plain slices out.

pub mod detail;
