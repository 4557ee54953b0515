//! Prepares network inputs from scenes: crops, depth ranges, context pairs, chunks of pixelSplat's
//! data sets, training examples, and procedural rooms.

pub mod chunks;
pub mod crop;
pub mod dataset;
pub mod depth;
pub mod exposure;
pub mod pair;
pub(crate) mod photographic;
pub mod procedural;
pub mod sampler;
