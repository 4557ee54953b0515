//! Two posed photographs in, sub-pixel 3D Gaussians and sharper new views out.

#![warn(missing_docs)]

pub mod abi;
pub mod camera;
pub mod config;
pub mod cpu;
pub mod io;
pub mod model;
pub mod ops;
pub mod sh;
pub mod splats;
