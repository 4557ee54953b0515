//! Baselines: each job written the plain way that most programs do it, so that a
//! ratio has something under it. They use nothing of the crate's kernels, and
//! tests/conventional.rs holds them to the same references.

pub mod attention;
pub mod conv;
pub mod project;
pub mod raster;
pub mod redistribute;
pub mod sh;
pub mod sweep;
