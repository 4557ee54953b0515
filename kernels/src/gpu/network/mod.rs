//! Kernels of the network whose arguments are slices of host memory or arrays of the device: the
//! attention gather and the plane sweep with their gradients. WGSL: wgsl/network.

pub(crate) mod attention_gather;
pub(crate) mod attention_gather_bwd;
mod invert;
pub(crate) mod plane_sweep;
pub(crate) mod plane_sweep_bwd;

pub(crate) use invert::{COUNT, FILL, NONE, ORDER, SCAN};
