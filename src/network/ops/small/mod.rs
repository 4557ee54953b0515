//! The small backbone's own parts as candle ops with gradients. Kernels:
//! [`subsplat_kernels::cpu::small`]. Tests: tests/network/operators/small.rs, against tensor operations
//! and finite differences.

mod array;
mod convex;
mod cross_check;
mod depth_consensus;
mod expectation;
mod heads;
mod normalize_channels;
mod rgbd;

pub use array::SmallArray;
pub use convex::upsample_convex;
pub use cross_check::cross_check;
pub use depth_consensus::depth_consensus;
#[cfg(feature = "gpu")]
pub(in crate::network::ops) use depth_consensus::tolerances as consensus_tolerances;
#[cfg(feature = "gpu")]
pub(in crate::network::ops) use expectation::SCORE_GAIN;
pub use expectation::{add_scores, expectation};
pub use heads::{Start, head_input, head_output, ray_distance};
pub use normalize_channels::normalize_channels;
pub use subsplat_kernels::cpu::small::expectation::MeanOver;
pub use subsplat_kernels::cpu::small::heads::Candidates;
