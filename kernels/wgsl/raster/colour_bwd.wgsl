// Gradients of SH and gain, and the part of the mean's gradient through the view direction. CPU
// version: cpu/raster/colour_bwd.rs. The gradient of a parent's SH is summed over its children in
// their order.
//
// Input: rows, sh, gain as in project.wgsl; sums [N, 10] from splat `own` on. Output: gradients
// of sh and gain; the mean's part is added to `d_rows`, which project_bwd.wgsl has written. One
// thread per parent.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> gain: array<f32>;
@group(0) @binding(4) var<storage, read> sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_rows: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_sh: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_gain: array<f32>;

// Returns the vector from the eye to splat i.
fn from_eye(i: u32) -> vec3<f32> {
    let row = i * call.stride;
    let eye = vec3<f32>(call.right.w, call.down.w, call.ahead.w);
    return vec3<f32>(rows[row], rows[row + 1u], rows[row + 2u]) - eye;
}

fn is_finite(d: vec3<f32>) -> bool {
    return finite(d.x) && finite(d.y) && finite(d.z);
}

fn gain_of(i: u32) -> f32 {
    if call.gain_channels == 0u {
        return 1.0;
    }
    return gain[i * call.gain_channels];
}

fn add_to_mean(i: u32, g: vec3<f32>) {
    let row = i * call.stride;
    d_rows[row] += g.x;
    d_rows[row + 1u] += g.y;
    d_rows[row + 2u] += g.z;
}

fn store_gain(i: u32, g: f32, rgb: vec3<f32>) {
    let at = i * call.gain_channels;
    if call.gain_channels > 0u {
        d_gain[at] = g;
    }
    if call.gain_channels == 4u {
        d_gain[at + 1u] = rgb.x;
        d_gain[at + 2u] = rgb.y;
        d_gain[at + 3u] = rgb.z;
    }
}

// Adds the gradients for children with a direction each.
fn children_by_direction(own_sh: u32, first: u32, past: u32) {
    for (var i = first; i < past; i++) {
        let m = moments(call.own + i);
        if !has_gradient(m) {
            store_gain(i, 0.0, vec3<f32>(0.0));
            continue;
        }
        let own = gain_of(i);
        radiance_gradient(own_sh, call.sh_degree, call.sh_mvsplat != 0u, from_eye(i), m.rgb, own * m.rgb);
        add_to_mean(i, own * direction_sums.slope);
        store_gain(i, direction_sums.value, m.rgb);
    }
}

// Adds the gradients for children that share one direction: the mean of their finite means.
fn children_of_one_direction(own_sh: u32, first: u32, past: u32) {
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    var weighted = vec3<f32>(0.0);
    for (var i = first; i < past; i++) {
        let d = from_eye(i);
        if is_finite(d) {
            sum += d;
            count += 1.0;
        }
        let rgb = moments(call.own + i).rgb;
        if any(rgb != vec3<f32>(0.0)) {
            weighted += gain_of(i) * rgb;
        }
    }
    let towards = sum / max(count, 1.0);
    let mvsplat = call.sh_mvsplat != 0u;
    var direction = vec3<f32>(0.0);
    let norm = length(towards);
    if norm > 0.0 && finite(norm) {
        direction = towards / norm;
    }
    let radiated = radiance(own_sh, call.sh_degree, mvsplat, direction);
    for (var i = first; i < past; i++) {
        let rgb = moments(call.own + i).rgb;
        let visible = any(rgb != vec3<f32>(0.0));
        store_gain(i, select(0.0, dot(rgb, radiated), visible), rgb);
    }
    if all(weighted == vec3<f32>(0.0)) {
        return;
    }
    radiance_gradient(own_sh, call.sh_degree, mvsplat, towards, weighted, weighted);
    let share = direction_sums.slope / max(count, 1.0);
    for (var i = first; i < past; i++) {
        if is_finite(from_eye(i)) {
            add_to_mean(i, share);
        }
    }
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let p = workgroup_number(workgroup, workgroups) * 64u + thread;
    let first = p * call.children;
    if first >= call.count {
        return;
    }
    let past = min(first + call.children, call.count);
    let own_sh = p * call.sh_stride;
    for (var k = own_sh; k < own_sh + call.sh_stride; k++) {
        d_sh[k] = 0.0;
    }
    if call.sh_shared != 0u {
        children_of_one_direction(own_sh, first, past);
    } else {
        children_by_direction(own_sh, first, past);
    }
}
