// Visibility of points before the views' surfaces. CPU version: cpu/attention_gather/mod.rs.

@group(0) @binding(0) var<uniform> call: OcclusionUniform;
// [points, views] in units of each picture's size.
@group(0) @binding(1) var<storage, read> places: array<vec2<f32>>;
// [points, views]: camera z.
@group(0) @binding(2) var<storage, read> depths: array<f32>;
// [views, height, width]: camera z.
@group(0) @binding(3) var<storage, read> surfaces: array<f32>;
// [points, views].
@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.points * call.views {
        return;
    }
    let at = places[i];
    let z = depths[i];
    if !(z > 0.0 && all(at > vec2<f32>()) && all(at < vec2<f32>(1.0))) {
        visibility[i] = 1.0;
        return;
    }
    let last = vec2<u32>(call.width, call.height) - 1u;
    let size = vec2<f32>(f32(call.width), f32(call.height));
    let place = clamp(at * size - 0.5, vec2<f32>(), vec2<f32>(last));
    let low = min(vec2<u32>(place), last);
    let high = min(low + 1u, last);
    let share = place - vec2<f32>(low);
    let base = i % call.views * call.height * call.width;
    let top = base + low.y * call.width;
    let bottom = base + high.y * call.width;
    let above = mix(surfaces[top + low.x], surfaces[top + high.x], share.x);
    let below = mix(surfaces[bottom + low.x], surfaces[bottom + high.x], share.x);
    let excess = max(z - mix(above, below, share.y) - call.tolerance * z, 0.0);
    visibility[i] = exp(-excess / (call.tolerance * z));
}
