//! Kernels of the small backbone's own parts (src/network/shipped/README.md, "The small
//! backbone"), with gradients where training needs them. Each kernel is one pass over memory;
//! tensor operations would take dozens.

pub mod convex;
pub mod cross_check;
pub mod depth_consensus;
pub mod expectation;
pub mod heads;
pub mod rgbd;
pub mod unit;
