//! The small backbone's own parts as candle ops with gradients. Kernels:
//! [`crate::cpu::small`]. Tests: tests/network/operators/small.rs, against tensor operations
//! and finite differences.

mod convex;
mod cross_check;
mod expectation;
mod heads;
mod unit;

pub use crate::cpu::small::expectation::MeanOver;
pub use crate::cpu::small::heads::Candidates;
pub use convex::upsample_convex;
pub use cross_check::cross_check;
pub use expectation::{expectation, lift};
pub use heads::{Start, head_input, head_output, ray_distance};
pub use unit::unit_channels;
