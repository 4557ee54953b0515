// Uniform and sizes of the attention gather. Formulas and layouts: src/cpu/attention_gather.

struct AttentionGatherUniform {
    parents: u32,
    views: u32,
    levels: u32,
    points: u32,
    // Floats of one view's points.
    points_width: u32,
    dim: u32,
    groups: u32,
    stride: u32,
    key: u32,
    has_key: u32,
    value: u32,
    renormalise: u32,
    points_per_level: u32,
    half_pixel: f32,
    logit_scale: f32,
    drops: u32,
    // 1 / (1 - p).
    kept_factor: f32,
    first_parent: u32,
    seed_low: u32,
    seed_high: u32,
    // p * 2^53, rounded up, in two words: a weight is dropped where its 53 random bits are below
    // it.
    dropped_low: u32,
    dropped_high: u32,
    // Cells of the maps.
    cells: u32,
    point_gradient: u32,
}

@group(0) @binding(0) var<uniform> call: AttentionGatherUniform;
fn sample_count() -> u32 {
    return call.views * call.levels * call.points;
}

fn query_channels() -> u32 {
    return select(0u, call.dim, call.has_key != 0u);
}

fn query_width() -> u32 {
    return query_channels() + sample_count() * call.groups + call.views;
}
