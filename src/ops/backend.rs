//! The device of the ops: [`crate::backend`], under the names that the ops use.

pub use crate::backend::{Backend, DeviceError as NoDevice};
