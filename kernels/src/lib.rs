//! Kernels of `subsplat`: arithmetic on slices and on GPU buffers, without a tensor library.
//!
//! * [`cpu`]: kernels on slices, with rayon for threads and SIMD levels chosen at run time.
//! * [`gpu`](crate::backend): the same kernels as WGSL compute shaders, through wgpu (feature `gpu`).
//! * [`layout`]: strides, offsets, constants and options that both share.
//! * [`camera`]: the pinhole camera, which defines all geometric conventions.
//!
//! The crate `subsplat` is the interface for applications. This crate carries no promise between
//! versions. The crate `subsplat` has no `unsafe` code; of the
//! programs, only the allocator and the browser module have it.

pub mod backend;
pub mod camera;
pub mod clock;
pub mod cpu;
pub mod device;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod layout;
pub mod sh;
