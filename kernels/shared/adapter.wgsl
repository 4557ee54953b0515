// Parameters of the kernels that place primaries (src/gpu/array/adapter.rs).

struct AdapterUniform {
    // Gaussians of all views.
    gaussians: u32,
    // Pixels of a view.
    pixels: u32,
    // Width of a view, px.
    width: u32,
    per_pixel: u32,
    // Numbers of a raw row.
    lanes: u32,
    // SH functions of a colour.
    functions: u32,
    // 1: SH have RGB innermost.
    interleaved: u32,
    // Exponent of the opacity mapping.
    exponent: f32,
}

