//! Scenes of Gaussians, their pictures and their measures.

pub mod levels;
pub mod mask;
pub mod metrics;
pub mod navigation;
pub mod pictures;
pub mod render;
pub mod score;
pub mod splats;

pub use render::render;
