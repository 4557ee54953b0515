//! Custom ops against their definitions in tensor operations: values and gradients.

mod norm;
mod small;
