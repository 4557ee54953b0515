//! Inputs of a reconstruction: crops, context pairs, and the exposure of two pictures.

pub mod crop;
pub mod exposure;
mod frame;
pub mod pair;
