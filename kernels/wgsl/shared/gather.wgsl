// Parameters and sizes of the attention gather. Formulas and layouts: cpu/attention_gather/mod.rs.

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
