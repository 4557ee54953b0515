//! Inputs of a reconstruction: crops, context pairs, exposure, depth range and input size.

pub mod crop;

pub mod exposure;
pub mod pair;
