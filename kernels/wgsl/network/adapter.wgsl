// Primaries in world frame from raw head rows, distances and densities. CPU version:
// cpu/adapter/mod.rs.

@group(0) @binding(0) var<uniform> call: AdapterUniform;
// [views * pixels, lanes].
@group(0) @binding(1) var<storage, read> raw: array<f32>;
// [views * pixels, per_pixel]: distances along the unit ray, world units.
@group(0) @binding(2) var<storage, read> depths: array<f32>;
// [views * pixels, per_pixel].
@group(0) @binding(3) var<storage, read> densities: array<f32>;
// [views, 9]: focal lengths and principal point; sigma at distance 1: the minimum and the span; rows
// of R, world from camera, each with a coordinate of the eye; images of x, y, z, w as wxyz.
@group(0) @binding(4) var<storage, read> views: array<vec4<f32>>;
// [views * pixels * per_pixel, SPLAT_STRIDE].
@group(0) @binding(5) var<storage, read_write> rows: array<f32>;

const VIEW_STRIDE: u32 = 9u;
// Epsilon of the raw quaternion's normalisation (MVSplat).
const QUAT_EPS: f32 = 1e-8;
// Squared length of a normalised quaternion below which it counts as zero.
const QUAT_ZERO: f32 = 1e-12;
// Lower clamp of p and 1 - p in logarithms.
const SHARE_MIN: f32 = 1e-30;

// Returns y^e of y in [0, 1].
fn power(y: f32, e: f32) -> f32 {
    return select(exp(e * log(max(y, SHARE_MIN))), 0.0, y < SHARE_MIN);
}

// Returns the opacity of density p.
fn opacity(p: f32) -> f32 {
    let share = 1.0 / f32(call.per_pixel);
    if call.exponent == 1.0 {
        return p * share;
    }
    return 0.5 * share * (1.0 - power(1.0 - p, call.exponent) + power(p, 1.0 / call.exponent));
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.gaussians {
        return;
    }
    let pixel = i / call.per_pixel;
    let view = pixel / call.pixels * VIEW_STRIDE;
    let place = pixel % call.pixels;
    let at = pixel * call.lanes;
    let camera = views[view];
    let share = vec2(sigmoid(raw[at]), sigmoid(raw[at + 1u]));
    let whole = vec2(f32(place % call.width), f32(place / call.width));
    let slope = (whole + share - camera.zw) / camera.xy;
    let ray = vec3(slope, 1.0) / sqrt(dot(slope, slope) + 1.0);
    let distance = depths[i];
    let to = i * SPLAT_STRIDE;
    let sigma = views[view + 1u].xy;
    for (var k = 0u; k < 3u; k++) {
        let row = views[view + 2u + k];
        rows[to + MEAN_OFFSET + k] = dot(row.xyz, ray) * distance + row.w;
        let least = sigma.y * sigmoid(raw[at + 2u + k]) + sigma.x;
        rows[to + SCALE_OFFSET + k] = least * distance;
    }
    var own = vec4(raw[at + 5u], raw[at + 6u], raw[at + 7u], raw[at + 8u]);
    own /= sqrt(dot(own, own)) + QUAT_EPS;
    own.w += select(0.0, 1.0, dot(own, own) < QUAT_ZERO);
    var quat = own.x * views[view + 5u] + own.y * views[view + 6u];
    quat += own.z * views[view + 7u] + own.w * views[view + 8u];
    let norm = sqrt(dot(quat, quat));
    quat /= select(norm, -norm, quat.x < 0.0);
    for (var k = 0u; k < 4u; k++) {
        rows[to + QUAT_OFFSET + k] = quat[k];
    }
    rows[to + OPACITY_OFFSET] = opacity(densities[i]);
}
