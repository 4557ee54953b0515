// Projection: footprint, colour and number of intersected tiles of each splat (3DGS, section 4).
// CPU version: cpu/raster/project.rs, with ewa, covariance, sh and tiles.
//
// Input: rows [N, 11] (mean, quat wxyz, σ, opacity) or [N, 10] (mean, covariance 6, opacity); sh
// [P, D, 3]; gain [], [N] or [N, 4]. Output, from splat `own` on: footprints [N, 12], packed
// rectangles of tiles [N, 2]; from splat `first` on: depth keys [N] (all bits set for dropped
// splats), counts [N] of intersected tiles of the call's band. One thread per splat.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> gain: array<f32>;
@group(0) @binding(4) var<storage, read_write> footprints: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> rectangles: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> counts: array<u32>;

fn load3(at: u32) -> vec3<f32> {
    return vec3<f32>(rows[at], rows[at + 1u], rows[at + 2u]);
}

// Returns the vector from the eye to splat i of the call, or to the mean of its finite siblings.
fn from_eye(i: u32) -> vec3<f32> {
    let eye = vec3<f32>(call.right.w, call.down.w, call.ahead.w);
    if call.sh_shared == 0u {
        return load3(i * call.stride) - eye;
    }
    let first = i / call.children * call.children;
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    for (var c = first; c < min(first + call.children, call.count); c++) {
        let d = load3(c * call.stride) - eye;
        if finite(d.x) && finite(d.y) && finite(d.z) {
            sum += d;
            count += 1.0;
        }
    }
    return sum / max(count, 1.0);
}

// Returns max(0, ½ + γ S + δ); w = 0 where the colour is not finite.
fn colour(i: u32) -> vec4<f32> {
    let d = from_eye(i);
    let norm = length(d);
    var direction = vec3<f32>(0.0);
    if norm > 0.0 && finite(norm) {
        direction = d / norm;
    }
    let own_sh = i / call.children * call.sh_stride;
    let sum = radiance(own_sh, call.sh_degree, call.sh_mvsplat != 0u, direction);
    var v = sum + 0.5;
    if call.gain_channels == 1u {
        v = gain[i] * sum + 0.5;
    } else if call.gain_channels == 4u {
        let at = 4u * i;
        v = gain[at] * sum + 0.5 + vec3<f32>(gain[at + 1u], gain[at + 2u], gain[at + 3u]);
    }
    let is_finite = finite(v.x) && finite(v.y) && finite(v.z);
    return vec4<f32>(max(v, vec3<f32>(0.0)), select(0.0, 1.0, is_finite));
}

// Projects splat i and writes the results; returns false for a dropped splat.
fn project(i: u32) -> bool {
    let row = i * call.stride;
    let d = load3(row) - vec3<f32>(call.right.w, call.down.w, call.ahead.w);
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
        let q = vec4<f32>(rows[row + 3u], load3(row + 4u));
        let norm2 = dot(q, q);
        // Smallest normal f32.
        if !(norm2 >= 1.1754944e-38 && finite(norm2)) {
            return false;
        }
        c = covariance_quat(j0, j1, q, load3(row + 7u));
    } else {
        c = covariance_cov6(j0, j1, load3(row + 3u), load3(row + 6u));
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
    let footprint = Footprint(mean.x, mean.y, sx, shear, sy, power, p.z, half.x, half.y);
    let band_lines = rows_in_band(lines);
    var tiles = (columns.y - columns.x) * (band_lines.y - band_lines.x);
    if !is_small(columns, lines) {
        tiles = 0u;
        for (var line = band_lines.x; line < band_lines.y; line++) {
            let span = tiles_of_row(footprint, line, columns);
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
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.count {
        return;
    }
    if !project(i) {
        keys[call.first + i] = 0xffffffffu;
        counts[call.first + i] = 0u;
    }
}
