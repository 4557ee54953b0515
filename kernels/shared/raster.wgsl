// What the rasterizer's kernels share: the uniform (binding `call`), a projected splat, its
// tiles.

struct RasterUniform {
    right: vec4<f32>,
    down: vec4<f32>,
    ahead: vec4<f32>,
    focal_centre: vec4<f32>,
    limits: vec4<f32>,
    background: vec4<f32>,
    near: f32,
    z_epsilon: f32,
    lowpass: f32,
    alpha_max: f32,
    stop: f32,
    antialiased: u32,
    tile_cut: u32,
    width: u32,
    height: u32,
    columns: u32,
    rows: u32,
    first: u32,
    count: u32,
    children: u32,
    stride: u32,
    sh_stride: u32,
    sh_degree: u32,
    sh_mvsplat: u32,
    sh_shared: u32,
    gain_lanes: u32,
    capacity: u32,
    step: u32,
    channel: u32,
    top: u32,
    resumes: u32,
    carries: u32,
    own: u32,
    place: u32,
    places: u32,
    pad_a: u32,
    pad_b: u32,
    pad_c: u32,
}

// The call's band of the picture: its first row of pixels, and how many there are.
fn band() -> vec2<u32> {
    let first = call.top * TILE_GPU;
    return vec2<u32>(first, min(call.height, first + call.rows * TILE_GPU) - first);
}

// Of rows of tiles [x, y), those of the call.
fn lines_of_call(lines: vec2<u32>) -> vec2<u32> {
    let past = call.top + call.rows;
    let first = clamp(lines.x, call.top, past);
    return vec2<u32>(first, clamp(lines.y, first, past));
}

// A projected splat, as src/cpu/ewa.rs has it: mean u, v (px, pixel centres at integers),
// Cholesky factor of the conic sx, shear, sy in units of log2, log2 of the opacity, camera
// z, half-width and half-height of the support, px. In memory three vec4 a splat:
// (u, v, sx, shear), (sy, power, z, half_width), (r, g, b, half_height).
struct Footprint {
    u: f32,
    v: f32,
    sx: f32,
    shear: f32,
    sy: f32,
    power: f32,
    z: f32,
    half_width: f32,
    half_height: f32,
}

// Distance of a pixel from a splat's mean in coordinates in which the splat is round;
// `a` and `b` are the first two vec4 of its footprint.
fn whitened(a: vec4<f32>, b: vec4<f32>, pixel: vec2<f32>) -> vec2<f32> {
    let d = pixel - a.xy;
    return vec2<f32>((d.x + a.w * d.y) * a.z, d.y * b.x);
}

// log2 of alpha there, before the cap.
fn exponent(b: vec4<f32>, d: vec2<f32>) -> f32 {
    return b.y - d.x * d.x - d.y * d.y;
}

// Where exponents have fallen by this much, alpha is below 1/255; with slack.
fn support(power: f32) -> f32 {
    let reach = power - ALPHA_MIN_LOG2;
    return reach + SUPPORT_SLACK * (1.0 + reach);
}

// Tile columns [x, y) of tile row `row` that the ellipse can meet, within `columns`
// (Footprint::span of src/cpu/ewa.rs).
fn tiles_of_row(f: Footprint, row: u32, columns: vec2<u32>) -> vec2<u32> {
    let top = f32(row * TILE_GPU);
    let low = max(top - f.v, -f.half_height);
    let high = min(top + f32(TILE_GPU - 1u) - f.v, f.half_height);
    if low > high {
        return vec2<u32>(0u);
    }
    let reach = support(f.power);
    // The ellipse is convex: its right edge over the rows is farthest at the rightmost
    // point's row, or at the end nearest to it; the left mirrors it.
    let tip = -f.shear * f.half_height * f.half_height / f.half_width;
    let right_dy = clamp(tip, low, high);
    let left_dy = clamp(-tip, low, high);
    let right_edge = sqrt(max(reach - f.sy * f.sy * right_dy * right_dy, 0.0)) / f.sx;
    let left_edge = sqrt(max(reach - f.sy * f.sy * left_dy * left_dy, 0.0)) / f.sx;
    let right = f.u - f.shear * right_dy + right_edge + SPAN_SLACK_PX;
    let left = f.u - f.shear * left_dy - left_edge - SPAN_SLACK_PX;
    let side = f32(TILE_GPU);
    let most = f32(columns.y);
    // Beyond the picture on the left is column 0; a NaN gives all columns.
    let start = u32(clamp(floor(left / side), f32(columns.x), most));
    let past = u32(clamp(floor(right / side) + 1.0, f32(columns.x), most));
    return vec2<u32>(start, max(start, past));
}

// Whether a rectangle of tiles is so small that it is taken as it is.
fn small(x: vec2<u32>, y: vec2<u32>) -> bool {
    return x.y - x.x <= 2u && y.y - y.x <= 2u && (x.y - x.x) * (y.y - y.x) <= 2u;
}

// Two numbers below 2^16 in one word, and back.
fn pack(v: vec2<u32>) -> u32 {
    return v.x | (v.y << 16u);
}

fn unpack(v: u32) -> vec2<u32> {
    return vec2<u32>(v & 0xffffu, v >> 16u);
}

// Neither infinite nor NaN, told by the bits: a compiler may assume that there are none.
fn finite(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7f800000u) != 0x7f800000u;
}
