// Constants of src/abi.rs, by the same names; tests/shaders.rs compares every one.

// Rule (how a parent's opacity is shared).
const RULE_LINEAR: u32 = 0u;
const RULE_OPTICAL_DEPTH: u32 = 1u;
const RULE_TRANSMITTANCE: u32 = 2u;
const RULE_AREA: u32 = 3u;
const RULE_NONE: u32 = 4u;

const AREA_EPS: f32 = 1e-8;
const AREA_RULE_OPACITY_MAX: f32 = 0.99;
const OPACITY_CEILING: f32 = 0.9999;
const RELATIVE_AREA_MIN: f32 = 1e-12;

// Most samples of a parent, and samples x groups, that attention_gather holds.
const GATHER_SAMPLES_MAX: u32 = 128u;
const GATHER_WEIGHTS_MAX: u32 = 1024u;

// Floats of one pair of views of a plane sweep.
const SWEEP_PAIR_LANES: u32 = 20u;
