//! Direct convolution: the sums of the definition over packed tiles, for any kernel, stride
//! and padding. For inputs in ±1 and n products per sum, results are within 1.5e-6·√n of the
//! exact ones (conv/tests.rs).

mod forward;
mod narrow_weight_grad;
mod weight_grad;
mod wide_weight_grad;

pub(super) use forward::Direct;
pub(super) use weight_grad::{DirectWeightGrad, LaneAxis};
