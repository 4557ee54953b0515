//! Prepares network inputs from scenes: crops, depth ranges, context pairs, chunks of pixelSplat's
//! data sets, training examples, and procedural rooms.

pub mod chunks;
pub mod dataset;
pub(crate) mod photographic;
pub mod procedural;
pub mod sampler;
