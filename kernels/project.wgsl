// Projection: geometry to footprint, SH to colour, and how many tiles each splat meets.
// Twin: src/cpu/project.rs (and ewa, covariance, sh, tiles there).
//
// In: rows [N, 11] (mean, quat wxyz, σ, opacity) or [N, 10] (mean, covariance 6, opacity);
// sh [P, D, 3]; gain [], [N] or [N, 4].  Out, from splat `own` on: footprints [N, 12],
// rectangles of tiles [N, 2] (packed); from splat `first` on: depth keys [N] (all ones
// where dropped), counts [N] of the call's tiles.   One thread per splat.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> gain: array<f32>;
@group(0) @binding(4) var<storage, read_write> footprints: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> rectangles: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> counts: array<u32>;

fn three(at: u32) -> vec3<f32> {
    return vec3<f32>(rows[at], rows[at + 1u], rows[at + 2u]);
}

// From the eye to splat i of the call, or to the mean of its siblings that are finite.
fn away(i: u32) -> vec3<f32> {
    let eye = vec3<f32>(call.right.w, call.down.w, call.ahead.w);
    if call.sh_shared == 0u {
        return three(i * call.stride) - eye;
    }
    let first = i / call.children * call.children;
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    for (var c = first; c < min(first + call.children, call.count); c++) {
        let d = three(c * call.stride) - eye;
        if finite(d.x) && finite(d.y) && finite(d.z) {
            sum += d;
            count += 1.0;
        }
    }
    return sum / max(count, 1.0);
}

// max(0, ½ + γ S + δ); w = 0 where that is no number.
fn colour(i: u32) -> vec4<f32> {
    let d = away(i);
    let norm = length(d);
    var direction = vec3<f32>(0.0);
    if norm > 0.0 && finite(norm) {
        direction = d / norm;
    }
    let own_sh = i / call.children * call.sh_stride;
    let sum = radiance(own_sh, call.sh_degree, call.sh_mvsplat != 0u, direction);
    var v = sum + 0.5;
    if call.gain_lanes == 1u {
        v = gain[i] * sum + 0.5;
    } else if call.gain_lanes == 4u {
        let at = 4u * i;
        v = gain[at] * sum + 0.5 + vec3<f32>(gain[at + 1u], gain[at + 2u], gain[at + 3u]);
    }
    let good = finite(v.x) && finite(v.y) && finite(v.z);
    return vec4<f32>(max(v, vec3<f32>(0.0)), select(0.0, 1.0, good));
}

// Writes the splat; false where it is dropped.
fn project(i: u32) -> bool {
    let row = i * call.stride;
    let d = three(row) - vec3<f32>(call.right.w, call.down.w, call.ahead.w);
    let p = vec3<f32>(dot(call.right.xyz, d), dot(call.down.xyz, d), dot(call.ahead.xyz, d));
    if !(p.z > call.near && finite(dot(p, p))) {
        return false;
    }
    let slopes = p.xy / p.z;
    let f = call.focal_centre.xy / p.z;
    let j0 = jacobian(slopes.x, call.limits.xy, f.x, call.right.xyz);
    let j1 = jacobian(slopes.y, call.limits.zw, f.y, call.down.xyz);
    var opacity = rows[row + call.stride - 1u];
    var c: Covariance;
    if call.stride == 11u {
        let q = vec4<f32>(rows[row + 3u], three(row + 4u));
        let norm2 = dot(q, q);
        // The smallest normal number.
        if !(norm2 >= 1.1754944e-38 && finite(norm2)) {
            return false;
        }
        c = covariance_quat(j0, j1, q, three(row + 7u));
    } else {
        c = covariance_cov6(j0, j1, three(row + 3u), three(row + 6u));
    }
    let xx = c.xx + call.lowpass;
    let yy = c.yy + call.lowpass;
    let det = c.det + call.lowpass * (c.xx + c.yy + call.lowpass);
    if call.antialiased != 0u {
        opacity *= sqrt(max(c.det / det, 0.0));
    }
    if !(opacity >= ALPHA_MIN && finite(opacity) && det > 0.0 && finite(det) && xx > 0.0 && yy > 0.0) {
        return false;
    }
    let power = log2(min(opacity, OPACITY_MAX));
    // 2 ln 2.
    let reach = 1.3862944 * support(power);
    let uv = select(slopes, p.xy / (p.z + call.z_epsilon), call.z_epsilon != 0.0);
    let mean = call.focal_centre.xy * uv + call.focal_centre.zw;
    // log2(e) / 2.
    let sx = sqrt(0.72134752 * (yy / det));
    let shear = -c.xy / yy;
    let sy = sqrt(0.72134752 / yy);
    let half = sqrt(reach * vec2<f32>(xx, yy));
    if !finite(mean.x + mean.y + sx + shear + sy + p.z + half.x + half.y) {
        return false;
    }
    let cut = call.tile_cut != 0u;
    let mid = 0.5 * (xx + yy);
    let spread = sqrt(max(mid * mid - det, DISCRIMINANT_MIN_MVSPLAT));
    let radius = ceil(RADIUS_SIGMAS_MVSPLAT * sqrt(mid + spread));
    let across = extent(mean.x, half.x, call.width, cut, radius);
    let down = extent(mean.y, half.y, call.height, cut, radius);
    if !(across.x < across.y && down.x < down.y) {
        return false;
    }
    let rgb = colour(i);
    if rgb.w == 0.0 {
        return false;
    }
    let columns = vec2<u32>(u32(across.x) / TILE_GPU, (u32(across.y) + TILE_GPU - 1u) / TILE_GPU);
    let lines = vec2<u32>(u32(down.x) / TILE_GPU, (u32(down.y) + TILE_GPU - 1u) / TILE_GPU);
    let found = Footprint(mean.x, mean.y, sx, shear, sy, power, p.z, half.x, half.y);
    let met = lines_of_call(lines);
    var tiles = (columns.y - columns.x) * (met.y - met.x);
    if !small(columns, lines) {
        tiles = 0u;
        for (var line = met.x; line < met.y; line++) {
            let span = tiles_of_row(found, line, columns);
            tiles += span.y - span.x;
        }
    }
    let i_out = call.own + i;
    footprints[3u * i_out] = vec4<f32>(mean, sx, shear);
    footprints[3u * i_out + 1u] = vec4<f32>(sy, power, p.z, half.x);
    footprints[3u * i_out + 2u] = vec4<f32>(rgb.xyz, half.y);
    rectangles[i_out] = vec2<u32>(pack(columns), pack(lines));
    keys[call.first + i] = bitcast<u32>(p.z);
    counts[call.first + i] = tiles;
    return true;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + lane;
    if i >= call.count {
        return;
    }
    if !project(i) {
        keys[call.first + i] = 0xffffffffu;
        counts[call.first + i] = 0u;
    }
}
