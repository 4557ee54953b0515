//! Two posed photographs in, sub-pixel 3D Gaussians and sharper new views out.

pub mod abi;
pub mod camera;
pub mod check;
pub mod config;
pub mod cpu;
pub mod data;
pub mod io;
pub mod metrics;
pub mod model;
pub mod ops;
pub mod pipeline;
pub mod render;
pub mod sh;
pub mod splats;

pub use render::{Picture, render};
