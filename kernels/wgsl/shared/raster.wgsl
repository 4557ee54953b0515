// Projected splat and tiles of the rasterizer's kernels. A kernel that uses this has `call`, a
// RasterUniform.

// Returns the first row of pixels of the call's band, and its number of rows.
fn band() -> vec2<u32> {
    let first = call.top * TILE_GPU;
    return vec2<u32>(first, min(call.height, first + call.rows * TILE_GPU) - first);
}

// Returns the rows of tiles of [x, y) inside the call's band.
fn rows_in_band(lines: vec2<u32>) -> vec2<u32> {
    let end = call.top + call.rows;
    let first = clamp(lines.x, call.top, end);
    return vec2<u32>(first, clamp(lines.y, first, end));
}

// A projected splat (cpu/raster/ewa.rs): mean u, v (px, pixel centres at integers); Cholesky factor
// sx, shear, sy of the conic in units of log2; log2 of the opacity; camera z; half-width and
// half-height of the support, px. In memory three vec4 per splat: (u, v, sx, shear), (sy, power,
// z, half_width), (r, g, b, half_height).
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

// Returns the distance of a pixel from the mean of a splat, in coordinates where the splat is
// isotropic. `a` and `b` are the first two vec4 of the footprint.
fn whitened(a: vec4<f32>, b: vec4<f32>, pixel: vec2<f32>) -> vec2<f32> {
    let d = pixel - a.xy;
    return vec2<f32>((d.x + a.w * d.y) * a.z, d.y * b.x);
}

// Returns log2 of alpha at the whitened distance `d`, before the cap.
fn exponent(b: vec4<f32>, d: vec2<f32>) -> f32 {
    return b.y - d.x * d.x - d.y * d.y;
}

// Returns the decrease of the exponent to alpha = 1/255, plus slack.
fn support(power: f32) -> f32 {
    let reach = power - ALPHA_MIN_LOG2;
    return reach + SUPPORT_SLACK * (1.0 + reach);
}

// Returns the tile columns [x, y) of tile row `row` that the ellipse can intersect, within
// `columns` (Footprint::span of cpu/raster/ewa.rs).
fn tiles_of_row(f: Footprint, row: u32, columns: vec2<u32>) -> vec2<u32> {
    let top = f32(row * TILE_GPU);
    let low = max(top - f.v, -f.half_height);
    let high = min(top + f32(TILE_GPU - 1u) - f.v, f.half_height);
    if low > high {
        return vec2<u32>(0u);
    }
    let reach = support(f.power);
    // The ellipse is convex. Its right edge over the rows is farthest at the row of the rightmost
    // point, or at the nearest end of the rows; the left edge mirrors it.
    let tip = -f.shear * f.half_height * f.half_height / f.half_width;
    let right_dy = clamp(tip, low, high);
    let left_dy = clamp(-tip, low, high);
    let right_edge = sqrt(max(reach - f.sy * f.sy * right_dy * right_dy, 0.0)) / f.sx;
    let left_edge = sqrt(max(reach - f.sy * f.sy * left_dy * left_dy, 0.0)) / f.sx;
    let right = f.u - f.shear * right_dy + right_edge + SPAN_SLACK_PX;
    let left = f.u - f.shear * left_dy - left_edge - SPAN_SLACK_PX;
    let side = f32(TILE_GPU);
    let last_column = f32(columns.y);
    // Columns left of the picture are clamped to column 0; a NaN gives all columns.
    let start = u32(clamp(floor(left / side), f32(columns.x), last_column));
    let end = u32(clamp(floor(right / side) + 1.0, f32(columns.x), last_column));
    return vec2<u32>(start, max(start, end));
}

// Returns whether a rectangle of tiles is so is_small that all its tiles count as intersected.
fn is_small(x: vec2<u32>, y: vec2<u32>) -> bool {
    return x.y - x.x <= 2u && y.y - y.x <= 2u && (x.y - x.x) * (y.y - y.x) <= 2u;
}

// Packs two numbers below 2^16 into one word.
fn pack(v: vec2<u32>) -> u32 {
    return v.x | (v.y << 16u);
}

fn unpack(v: u32) -> vec2<u32> {
    return vec2<u32>(v & 0xffffu, v >> 16u);
}
