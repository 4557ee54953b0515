//! The kernels as WGSL compute shaders, on every adapter that wgpu supports (Vulkan, Metal,
//! DX12, and WebGPU of a browser: `wait_web.rs`).
//!
//! Results agree with those of [`crate::cpu`] within the tolerances of tests/gpu. [`Gpu::open`] opens an adapter. After an error the caller can use the CPU kernels.
//! WebGPU's default limits suffice: 8 storage buffers per stage, 256 threads and 16 KiB per
//! workgroup, 128 MiB per binding.
//!
//! A kernel consists of `wgsl/FAMILY/NAME.wgsl`, a [`Kernel`] and a method of [`Gpu`] or [`Array`]
//! in `gpu/FAMILY`, and a CPU version, which the header of the WGSL file names. Constants and the
//! uniform's struct of the WGSL come from Rust (`constants`, [`uniforms`]); the bind group
//! layout comes from the declarations in the WGSL ([`Source::bindings`]). tests/gpu/shaders.rs checks
//! every kernel with naga.
//!
//! | folder | content |
//! |---|---|
//! | `raster` | rasterizer, its gradients, drawing to a texture |
//! | `finish` | the optimisation of a scene on photographs |
//! | `spgr` | children of parents, opacity redistribution, their gradients |
//! | `network` | attention gather, plane sweep, their gradients |
//! | `array` | arrays in device memory and the network's other operations |
//! | `uniforms` | parameters of the kernels |
//!
//! The table lists the stages of a frame of N splats with P (splat, tile) pairs on T tiles and px
//! pixels. "Bytes" counts the reads and writes of the kernels without SH, gain and caches. "At
//! once" is the number of workgroups that one core executes concurrently, limited by threads and
//! workgroup memory: for a core with 1,024 threads and 32 KiB, and for one with 2,048 threads and
//! 100 KiB.
//!
//! | stage | dispatches | threads | workgroup bytes | at once | bytes |
//! |---|---|---|---|---|---|
//! | project | 1 a part | 64 | 0 | 16, 32 | 44 N + 64 N |
//! | sort by depth | 24 | 256 | 9,216 | 3, 8 | 160 N |
//! | prefix sum, plan | 4 | 256 | 1,092 | 4, 8 | 20 N |
//! | intersect | 1 | 64 | 0 | 16, 32 | 68 N + 8 P |
//! | sort by tile | 3 per 4 bits of T | 256 | 9,216 | 3, 8 | 20 P per 4 bits |
//! | ranges | 1 | 256 | 0 | 4, 8 | 12 P + 8 T |
//! | rasterize | 1 | 64 | 6,152 | 5, 16 | 56 P + 28 px |
//! | rasterize backward | 1 | 32 | 15,368 | 2, 6 | 96 P + 28 px |
//! | sum pairs | 1 | 64 | 0 | 16, 32 | 40 P + 68 N |
//! | project backward | 2 a part | 64 | 0 | 16, 32 | 236 N |
//!
//! Expected times on a device that memory bandwidth limits, for the benchmark scene: 524,288
//! splats at 512², 817,775 pairs on 1,024 tiles; 41 dispatches forward, 4 backward.
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
//! On most devices arithmetic limits the two `rasterize` kernels instead: at most P · 256 pixels,
//! here 209 M, of 35 and 60 flops each. That is 7 and 13 Gflop, or 0.7 and 1.3 ms at 10 Tflop/s.
//! A dispatch takes about 5 µs, together 0.2 ms.
//!
//! A binding of 128 MiB, WebGPU's default, holds 2.79 M footprints, 33 M pairs forward, 3.35 M
//! pairs backward, and 6.7 Mpx. Devices are opened with the sizes of their adapter
//! ([`limits_of`]). Splats and their gradients are divided into parts; frames with more
//! footprints, pairs or pixels are drawn in bands and layers (`layers`). A call is refused where
//! 4 bytes per splat or one row of tiles exceed a binding; the CPU kernels can be used instead.

mod adapter;
mod array;
mod buffers;
mod commands;
mod constants;
mod device;
mod error;
mod finish;
mod kernel;
mod network;
mod pipelines;
mod raster;
mod spgr;
pub mod uniforms;
#[cfg_attr(all(target_family = "wasm", target_os = "unknown"), path = "wait_web.rs")]
mod wait;

pub use crate::device::DeviceChoice;
pub use adapter::{AdapterSummary, adapters, choose, find_for, instance};
pub use array::{
    ADAM_BLOCK, AdamCall, AdapterCall, AdapterView, Array, AttentionCall, ConvolutionCall,
    CrossCheckCall, DepthConsensusCall, FULL_GRID, Function, HeadOutputCall, NormSum,
    PointwiseFunction, RawMatchingCall, Recorder, Reduction, Work,
};
pub use buffers::{Buffer, ReadBacks};
pub use device::{Gpu, features_of, limits_of};
pub use error::GpuError;
pub use finish::loss::{LOSS_TAPS, LossRules, PictureLoss, PixelWeights, TargetPicture};
pub use finish::optimiser::{GivenGradients, LeftOut, OptimisedSplats, Rates};
pub use finish::steps::{
    MeasuredSplats, OptimiserRules, OptimiserStep, OptimiserTarget, SceneOptimiser,
};
pub use kernel::{Access, Kernel, Source};
pub use network::attention_gather::AttentionGatherArgs;
pub use network::attention_gather_bwd::AttentionGatherGradients;
pub use network::plane_sweep::PlaneSweepArgs;
pub use raster::constants::{FOOTPRINT_STRIDE, PAIR_SUMS, PLAN_WORDS};
pub use raster::rasterize::Rasterizer;
pub use raster::rasterize_bwd::Frame;
pub use raster::scene::{Scene, SceneArrays};
pub use spgr::SpgrArgs;
pub use spgr::redistribute::{RedistributeArgs, RedistributeGradients};
#[cfg(all(target_family = "wasm", target_os = "unknown"))]
pub use wait::set_gpu_wait;
/// The version of wgpu whose devices and textures [`Gpu`] uses.
pub use wgpu;

/// All kernels of this module.
pub const KERNELS: &[&Kernel] = &[
    &raster::kernels::PROJECT,
    &raster::kernels::SORT_COUNT,
    &raster::kernels::SORT_SCATTER,
    &raster::kernels::SCAN_REDUCE,
    &raster::kernels::SCAN_WHOLE,
    &raster::kernels::SCAN_APPLY,
    &raster::kernels::PLAN,
    &raster::kernels::PICK,
    &raster::kernels::INTERSECT,
    &raster::kernels::RANGES,
    &raster::kernels::BLEND,
    &raster::kernels::BLEND_BWD,
    &raster::kernels::PAIR_SUMS,
    &raster::kernels::PROJECT_BWD,
    &raster::kernels::COLOUR_BWD,
    &spgr::redistribute::REDISTRIBUTE,
    &spgr::redistribute::REDISTRIBUTE_BWD,
    &raster::show::SHOW,
    &finish::loss::DSSIM_WINDOWS,
    &finish::loss::LOSS_GRADIENT,
    &finish::loss::PICTURE_ERROR,
    &finish::optimiser::DRAWN_ROWS,
    &finish::optimiser::WATCH_PAIRS,
    &finish::optimiser::PARAMETER_GRADIENTS,
    &finish::optimiser::OPTIMISE,
    &network::attention_gather::ATTENTION_GATHER,
    &network::plane_sweep::PLANE_SWEEP,
    &spgr::SPGR,
    &spgr::backward::SPGR_BWD,
    &spgr::backward::SPGR_GAINS_BWD,
    &network::COUNT,
    &network::SCAN,
    &network::FILL,
    &network::ORDER,
    &network::attention_gather_bwd::ATTENTION_GATHER_BWD,
    &network::attention_gather_bwd::ATTENTION_GATHER_SCATTER,
    &network::plane_sweep_bwd::PLANE_SWEEP_TAPS,
    &network::plane_sweep_bwd::PLANE_SWEEP_REFERENCE_BWD,
    &network::plane_sweep_bwd::PLANE_SWEEP_SOURCE_BWD,
    &array::ADAM,
    &array::ADAPTER,
    &array::ADAPTER_COLOURS,
    &array::ELEMENTWISE,
    &array::CONVOLUTION,
    &array::LINEAR,
    &array::NORM_STATISTICS,
    &array::NORM_APPLY,
    &array::LAYER_NORM,
    &array::SOFTMAX,
    &array::REDUCE,
    &array::SELECT_ROWS,
    &array::RESIZE,
    &array::ATTENTION,
    &array::EXPECTATION,
    &array::CONVEX,
    &array::HEAD_OUTPUT,
    &array::CROSS_CHECK,
    &array::DEPTH_CONSENSUS,
    &array::RAW_MATCHING_BLOCKS,
    &array::RAW_MATCHING_SCORES,
    &array::ATTRIBUTES,
    &array::OCCLUSION,
    &array::SUM_PARTS,
    &array::CONVOLUTION_WEIGHT_BWD,
    &array::LINEAR_WEIGHT_BWD,
    &array::NORM_SUMS_BWD,
    &array::NORM_BWD,
    &array::LAYER_NORM_BWD,
    &array::RESIZE_BWD,
    &array::SELECT_ROWS_BWD,
    &array::EXPECTATION_BWD,
    &array::CONVEX_BWD,
    &array::CONVEX_MAPS_BWD,
    &array::ATTRIBUTES_BWD,
];
