//! SSIM of a plane with its derivative, for losses: no op, since losses hang their own
//! gradients into the graph. Kernel: [`crate::cpu::dssim`].

pub use crate::cpu::dssim::{Window, plane};
