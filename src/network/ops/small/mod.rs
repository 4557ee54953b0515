//! The small backbone's own parts as candle ops with gradients. Kernels:
//! [`subsplat_kernels::cpu::small`]. Tests: tests/network/operators/small.rs, against tensor operations
//! and finite differences.

mod convex;
mod cross_check;
mod depth_consensus;
mod expectation;
mod heads;
mod rgbd;
mod unit;

pub use convex::upsample_convex;
pub use cross_check::cross_check;
pub use depth_consensus::depth_consensus;
pub(in crate::network::ops) use depth_consensus::tolerances as consensus_tolerances;
pub(in crate::network::ops) use expectation::LIFT_GAIN;
pub use expectation::{expectation, lift};
pub use heads::{Start, head_input, head_output, ray_distance};
pub use subsplat_kernels::cpu::small::expectation::MeanOver;
pub use subsplat_kernels::cpu::small::heads::Candidates;
pub use unit::unit_channels;
