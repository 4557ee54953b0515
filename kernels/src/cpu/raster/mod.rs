//! The rasterizer of 3D Gaussians, forward and backward.
//!
//! Stages, one file each: [`ewa`] (one splat), `project` (all splats), `tiles` (lists), `sort` (depth
//! order in a tile), `blocks` and `blend` (one tile), `rasterize` (the frame). Files that end in `_bwd`
//! have the gradients of the stage of the same stem.

pub(crate) mod blend;
pub(crate) mod blend_bwd;
pub(crate) mod blocks;
pub(crate) mod colour_bwd;
pub(crate) mod covariance;
pub mod ewa;
pub(crate) mod ewa_bwd;
pub(crate) mod project;
pub(crate) mod project_bwd;
pub(crate) mod rasterize;
pub(crate) mod rasterize_bwd;
pub mod sh;
pub(crate) mod sh_bwd;
pub(crate) mod sort;
pub(crate) mod tiles;

pub use project::{Geometry, SplatSlices};
pub use project_bwd::Gradients;
pub use rasterize::{Rasterizer, Rendered, StageTimes, Stats};
pub use rasterize_bwd::{BackwardTimes, Frame};
