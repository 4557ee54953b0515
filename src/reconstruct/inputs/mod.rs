//! Inputs of a reconstruction: crops, context pairs, exposure, depth range and input size.

pub mod crop;
pub mod depth;
pub mod exposure;
pub mod pair;
