//! The WGSL kernels against the CPU versions.
#![cfg(feature = "gpu")]

mod array;
mod array_gradients;
mod fit;
mod layers;
mod loss;
mod model;
mod network;
mod ops;
mod optimizer;
mod primaries;
mod raster;
mod raster_bwd;
mod redistribute;
mod refine;
mod scenes;
mod shaders;
mod spgr;
mod subgroups;
mod training;
