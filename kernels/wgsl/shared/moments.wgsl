// Sums over the pixels of one splat: the ten sums of wgsl/raster/pair_sums.wgsl (cpu/raster/ewa_bwd.rs).
// Reads the binding `sums`.

struct Moments {
    // Sum of v = ∂L/∂ln α.
    one: f32,
    // Sum of v times (d, s), the whitened distance.
    first: vec2<f32>,
    // Sum of v times d², d·s, s².
    second: vec3<f32>,
    // Sum of the weight times ∂L/∂(R, G, B).
    rgb: vec3<f32>,
    // Sum of the weight times ∂L/∂(Σ w·z).
    z: f32,
}

fn moments(i: u32) -> Moments {
    let at = PAIR_SUMS * i;
    return Moments(
        sums[at],
        vec2<f32>(sums[at + 1u], sums[at + 2u]),
        vec3<f32>(sums[at + 3u], sums[at + 4u], sums[at + 5u]),
        vec3<f32>(sums[at + 6u], sums[at + 7u], sums[at + 8u]),
        sums[at + 9u],
    );
}

// Returns whether any sum is nonzero or NaN.
fn has_gradient(m: Moments) -> bool {
    return m.one != 0.0 || any(m.first != vec2<f32>(0.0)) || any(m.second != vec3<f32>(0.0))
        || any(m.rgb != vec3<f32>(0.0)) || m.z != 0.0;
}
