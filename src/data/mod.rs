//! From scenes to what the network takes: crops, depth ranges, context pairs, and
//! procedural rooms.

pub mod crop;
pub mod depth;
pub mod pair;
pub mod procedural;
