// Draws a band of a rendered picture to a texture of the application: one triangle that covers
// the texture, clipped to the band.
// Colours are display values (sRGB). A texture that encodes sRGB itself receives linear values.
// No CPU version: the CPU has no texture.

@group(0) @binding(0) var<uniform> call: ShowUniform;
@group(0) @binding(1) var<storage, read> picture: array<f32>;

@vertex
fn vertex(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {
    let corner = vec2<f32>(f32((i << 1u) & 2u), f32(i & 2u));
    return vec4<f32>(2.0 * corner - 1.0, 0.0, 1.0);
}

// IEC 61966-2-1.
fn linear(v: f32) -> f32 {
    if v <= 0.04045 {
        return v / 12.92;
    }
    return pow((v + 0.055) / 1.055, 2.4);
}

@fragment
fn fragment(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let p = min(u32(at.y) - call.top, call.height - 1u) * call.width + min(u32(at.x), call.width - 1u);
    let i = 3u * p;
    var rgb = clamp(vec3<f32>(picture[i], picture[i + 1u], picture[i + 2u]), vec3<f32>(0.0), vec3<f32>(1.0));
    if call.srgb != 0u {
        rgb = vec3<f32>(linear(rgb.x), linear(rgb.y), linear(rgb.z));
    }
    return vec4<f32>(rgb, picture[3u * call.width * call.height + p]);
}
