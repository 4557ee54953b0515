//! From a scene to what the network takes: crops, depth ranges, context pairs.

pub mod crop;
pub mod depth;
pub mod pair;
//! Where examples come from.
pub mod procedural;
