//! Prepares network inputs from scenes: crops, context pairs, chunks of pixelSplat's
//! data sets, training examples, and procedural rooms.

pub mod chunks;
pub mod dataset;
pub(crate) mod photographic;
pub mod procedural;
pub mod sampler;
