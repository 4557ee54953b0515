//! The device of the ops: [`subsplat_kernels::backend`], under the names that the ops use.

pub use subsplat_kernels::backend::{Backend, DeviceError as NoDevice};
