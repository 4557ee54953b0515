//! Baselines: each task as most programs implement it, without the kernels of this crate.
//! tests/raster/baseline.rs checks them against the same references.

pub mod attention;
pub mod conv;
pub mod project;
pub mod raster;
pub mod redistribute;
pub mod sh;
pub mod sweep;
