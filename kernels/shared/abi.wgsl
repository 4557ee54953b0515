// Constants of src/abi.rs, under the same names; tests/gpu/shaders.rs compares the values.

// Redistribution rules.
const RULE_LINEAR: u32 = 0u;
const RULE_OPTICAL_DEPTH: u32 = 1u;
const RULE_TRANSMITTANCE: u32 = 2u;
const RULE_AREA: u32 = 3u;
const RULE_NONE: u32 = 4u;

const AREA_EPS: f32 = 1e-8;
const AREA_RULE_OPACITY_MAX: f32 = 0.99;
const OPACITY_CEILING: f32 = 0.9999;
const RELATIVE_AREA_MIN: f32 = 1e-12;

// The rasterizer.
const ALPHA_MIN: f32 = 0.003921568859368563;
const ALPHA_MIN_LOG2: f32 = -7.9943533;
const DISCRIMINANT_MIN_MVSPLAT: f32 = 0.1;
const RADIUS_SIGMAS_MVSPLAT: f32 = 3.0;
const SUPPORT_SLACK: f32 = 1e-4;
const SPAN_SLACK_PX: f32 = 1e-3;
const OPACITY_MAX: f32 = 1e36;
const TILE_GPU: u32 = 16u;
const FOOTPRINT_STRIDE: u32 = 12u;
const PAIR_SUMS: u32 = 10u;
const GPU_BLOCK: u32 = 2048u;
const PLAN_COUNT: u32 = 3u;
const PLAN_BLOCKS: u32 = 4u;
const PLAN_REQUESTED: u32 = 5u;
const PLAN_ELEMENT_GROUPS: u32 = 8u;
// Maximum samples per parent, and samples x groups, of attention_gather.
const GATHER_SAMPLES_MAX: u32 = 128u;
const GATHER_WEIGHTS_MAX: u32 = 1024u;

// Floats of a pair of views of a plane sweep.
const SWEEP_PAIR_STRIDE: u32 = 20u;

// Strides and offsets of packed splats and of head records, floats.
const SPLAT_STRIDE: u32 = 11u;
const MEAN_OFFSET: u32 = 0u;
const QUAT_OFFSET: u32 = 3u;
const SCALE_OFFSET: u32 = 7u;
const OPACITY_OFFSET: u32 = 10u;
const HEAD_STRIDE: u32 = 11u;
const HEAD_UV_OFFSET: u32 = 0u;
const HEAD_DEPTH_OFFSET: u32 = 2u;
const HEAD_LOG_SCALE_OFFSET: u32 = 3u;
const HEAD_ROTATION_OFFSET: u32 = 6u;
const HEAD_LOGIT_OFFSET: u32 = 9u;
const HEAD_GAIN_OFFSET: u32 = 10u;

// SPGR.
const SPGR_CAMERA_STRIDE: u32 = 23u;
const AREA_SQ_EPS: f32 = 1e-24;
const DEPTH_FRACTION_MIN: f32 = 0.1;
const DISC_AREA_SQ_MIN: f32 = 1e-20;
const GROWTH_MAX: f32 = 50.0;
const VISIBLE_Z_MIN: f32 = 1e-5;

// Index of no cell, in the lists of invert.
const NONE: u32 = 0xffffffffu;
