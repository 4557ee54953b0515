//! Networks that give depth, density and raw Gaussian parameters.

pub mod small;
mod small_parts;

pub use small::SmallBackbone;
pub(crate) use small_parts::small_start;
