//! Custom ops against their definitions in tensor operations: values and gradients.

#[path = "common/same.rs"]
mod same;

#[path = "ops/norm.rs"]
mod norm;
#[path = "ops/small.rs"]
mod small;
