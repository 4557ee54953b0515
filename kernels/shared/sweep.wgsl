// Uniform of the plane sweep. Formulas: src/cpu/plane_sweep.

struct PlaneSweepUniform {
    // R, C and D of this call; h and w of the feature maps.
    rows: u32,
    channels: u32,
    candidates: u32,
    height: u32,
    width: u32,
    pairs: u32,
    sources: u32,
    pad0: u32,
    centre: f32,
    min_z: f32,
    scale: f32,
    pad1: u32,
}

@group(0) @binding(0) var<uniform> call: PlaneSweepUniform;
