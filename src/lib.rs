//! Two posed photographs in, sub-pixel 3D Gaussians and sharper new views out.

#![warn(missing_docs)]

pub mod abi;
pub mod camera;
pub mod config;
pub mod data;
pub mod io;
pub mod metrics;
pub mod model;
pub mod sh;
pub mod splats;
