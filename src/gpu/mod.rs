//! The kernels as WGSL compute, on any adapter that wgpu finds (Vulkan, Metal, DX12).
//!
//! Same stems and arguments as [`crate::cpu`], same results within the tolerances that
//! `tests/gpu_twins.rs` states. [`Gpu::open`] chooses the adapter; every error leaves the
//! caller the CPU kernels. Nothing here needs more than WebGPU's default limits: 8 storage
//! buffers a stage, 256 threads and 16 KiB a workgroup, 128 MiB a binding.
//!
//! A kernel x is `kernels/x.wgsl`, a [`Kernel`] and a method of [`Gpu`] in `x.rs`, and
//! has a CPU twin of the same stem; `tests/shaders.rs` holds its text against
//! [`crate::abi`] and this table.

mod adapter;
mod attention_gather;
mod attention_gather_bwd;
mod buffers;
mod commands;
mod device;
mod error;
mod invert;
mod pipelines;
mod plane_sweep;
mod plane_sweep_bwd;
mod raster_kernels;
mod rasterize;
mod redistribute;
mod scene;
mod show;
mod sort;
mod spgr;
mod spgr_bwd;

pub use adapter::{AdapterSummary, DeviceChoice, adapters, choose, find_for, instance};
pub use attention_gather::AttentionGatherArgs;
pub use attention_gather_bwd::AttentionGatherGradients;
pub use buffers::Buffer;
pub use device::Gpu;
pub use error::GpuError;
pub use pipelines::{Access, Kernel};
pub use plane_sweep::PlaneSweepArgs;
pub use rasterize::Rasterizer;
pub use redistribute::RedistributeArgs;
pub use scene::Scene;
pub use spgr::SpgrArgs;
/// The wgpu that devices and textures belong to.
pub use wgpu;

/// Every kernel of the room.
pub const KERNELS: &[&Kernel] = &[
    &raster_kernels::PROJECT,
    &raster_kernels::SORT_COUNT,
    &raster_kernels::SORT_SCATTER,
    &raster_kernels::SCAN_REDUCE,
    &raster_kernels::SCAN_WHOLE,
    &raster_kernels::SCAN_APPLY,
    &raster_kernels::PLAN,
    &raster_kernels::INTERSECT,
    &raster_kernels::RANGES,
    &raster_kernels::RASTERIZE,
    &redistribute::REDISTRIBUTE,
    &show::SHOW,
    &attention_gather::ATTENTION_GATHER,
    &plane_sweep::PLANE_SWEEP,
    &spgr::SPGR,
    &spgr_bwd::SPGR_BWD,
    &spgr_bwd::SPGR_GAINS_BWD,
    &invert::COUNT,
    &invert::SCAN,
    &invert::FILL,
    &invert::ORDER,
    &attention_gather_bwd::ATTENTION_GATHER_BWD,
    &attention_gather_bwd::ATTENTION_GATHER_SCATTER,
    &plane_sweep_bwd::PLANE_SWEEP_TAPS,
    &plane_sweep_bwd::PLANE_SWEEP_REFERENCE_BWD,
    &plane_sweep_bwd::PLANE_SWEEP_SOURCE_BWD,
];
