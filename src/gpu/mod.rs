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
//!
//! A frame of N splats with P (splat, tile) pairs on T tiles and px pixels, stage by stage;
//! bytes are those that kernels read and write, SH, gain and caches left out. A device runs
//! as many workgroups of a stage side by side on a core as its threads and its workgroup
//! memory hold: "at once" is said of a core of 1,024 threads and 32 KiB, and of one of
//! 2,048 and 100 KiB.
//!
//! | stage | dispatches | threads | workgroup bytes | at once | bytes |
//! |---|---|---|---|---|---|
//! | project | 1 a part | 64 | 0 | 16, 32 | 44 N + 64 N |
//! | sort by depth | 24 | 256 | 9,216 | 3, 8 | 160 N |
//! | prefix sum, plan | 4 | 256 | 1,092 | 4, 8 | 20 N |
//! | intersect | 1 | 64 | 0 | 16, 32 | 68 N + 8 P |
//! | sort by tile | 3 per 4 bits of T | 256 | 9,216 | 3, 8 | 20 P per 4 bits |
//! | ranges | 1 | 256 | 0 | 4, 8 | 12 P + 8 T |
//! | rasterize | 1 | 256 | 12,296 | 2, 8 | 56 P + 28 px |
//! | rasterize backward | 1 | 32 | 15,368 | 2, 6 | 96 P + 28 px |
//! | sum pairs | 1 | 64 | 0 | 16, 32 | 40 P + 68 N |
//! | project backward | 2 a part | 64 | 0 | 16, 32 | 236 N |
//!
//! What to expect of a device where memory is the limit: the benches' scene of 524,288
//! splats at 512², which has 817,775 pairs on 1,024 tiles; 41 dispatches forward, 4 back.
//!
//! | stage | MB | ms at 300 GB/s | ms at 1 TB/s |
//! |---|---|---|---|
//! | project | 57 | 0.19 | 0.06 |
//! | sort by depth | 84 | 0.28 | 0.08 |
//! | prefix sum, plan | 10 | 0.03 | 0.01 |
//! | intersect | 42 | 0.14 | 0.04 |
//! | sort by tile | 49 | 0.16 | 0.05 |
//! | ranges | 10 | 0.03 | 0.01 |
//! | rasterize | 53 | 0.18 | 0.05 |
//! | forward | 305 | 1.02 | 0.31 |
//! | rasterize backward | 86 | 0.29 | 0.09 |
//! | sum pairs | 68 | 0.23 | 0.07 |
//! | project backward | 124 | 0.41 | 0.12 |
//! | backward | 278 | 0.93 | 0.28 |
//!
//! Not memory but arithmetic limits the two `rasterize` on most devices: at most P · 256
//! pixels, 209 M here, of 35 and 60 flops: 7 and 13 Gflop, 0.7 and 1.3 ms at 10 Tflop/s.
//! A dispatch costs some 5 µs: 0.2 ms.
//!
//! A binding of 128 MiB, WebGPU's default, holds 2.79 M footprints, 33 M pairs forward and
//! 3.35 M back, and 6.7 Mpx; devices are opened with what their adapter has ([`limits_of`]).
//! Splats and their gradients are cut into parts; beyond the rest a frame is drawn in bands
//! and layers (`layers`). Where 4 bytes of every splat or one row of tiles do not fit, a call
//! is refused, and the caller's CPU does it.

mod adapter;
mod attention_gather;
mod attention_gather_bwd;
mod buffers;
mod commands;
mod device;
mod error;
mod frame;
mod invert;
mod layers;
mod pipelines;
mod plane_sweep;
mod plane_sweep_bwd;
mod raster_bwd;
mod raster_kernels;
mod rasterize;
mod redistribute;
mod scene;
mod show;
mod sort;
mod spgr;
mod spgr_bwd;

pub use crate::device::DeviceChoice;
pub use adapter::{AdapterSummary, adapters, choose, find_for, instance};
pub use attention_gather::AttentionGatherArgs;
pub use attention_gather_bwd::AttentionGatherGradients;
pub use buffers::Buffer;
pub use device::{Gpu, limits_of};
pub use error::GpuError;
pub use pipelines::{Access, Kernel};
pub use plane_sweep::PlaneSweepArgs;
pub use raster_bwd::Frame;
pub use rasterize::Rasterizer;
pub use redistribute::{RedistributeArgs, RedistributeGradients};
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
    &raster_kernels::PICK,
    &raster_kernels::INTERSECT,
    &raster_kernels::RANGES,
    &raster_kernels::RASTERIZE,
    &raster_kernels::RASTERIZE_BWD,
    &raster_kernels::PAIR_SUMS,
    &raster_kernels::PROJECT_BWD,
    &raster_kernels::COLOUR_BWD,
    &redistribute::REDISTRIBUTE,
    &redistribute::REDISTRIBUTE_BWD,
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
