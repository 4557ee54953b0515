//! Kernels of the small backbone's own parts (ARCHITECTURE.md, "The small backbone"),
//! each with its gradient where one is owed: what in tensor operations would be dozens of passes over
//! memory is one.

pub mod convex;
pub mod cross_check;
pub mod expectation;
pub mod heads;
pub mod unit;
