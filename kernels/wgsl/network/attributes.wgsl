// Attributes of parents as the embeddings read them. CPU version: cpu/attributes.rs.

// [parents, 11]: position 3, scale 3, quaternion 4, opacity 1.
@group(0) @binding(2) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.parents {
        return;
    }
    let row = i * SPLAT_STRIDE;
    let m = row + MEAN_OFFSET;
    let mean = vec3<f32>(rows[m], rows[m + 1u], rows[m + 2u]);
    let q = row + QUAT_OFFSET;
    var quat = vec4<f32>(rows[q], rows[q + 1u], rows[q + 2u], rows[q + 3u]);
    var position = mean;
    if call.framed == 1u {
        let away = mean - vec3<f32>(call.frame[0].w, call.frame[1].w, call.frame[2].w);
        position = call.frame[0].xyz * away.x + call.frame[1].xyz * away.y
            + call.frame[2].xyz * away.z;
        quat = vec4<f32>(
            dot(call.turn[0], quat),
            dot(call.turn[1], quat),
            dot(call.turn[2], quat),
            dot(call.turn[3], quat),
        );
    }
    if call.ray == 1u {
        let z = max(position.z, call.z_min);
        let slopes = clamp(position.xy / z, vec2<f32>(-call.slope_max), vec2<f32>(call.slope_max));
        position = vec3<f32>(slopes, log(z));
    }
    let s = row + SCALE_OFFSET;
    var scale = vec3<f32>(rows[s], rows[s + 1u], rows[s + 2u]);
    if call.log_px == 1u {
        let away = mean - vec3<f32>(call.source[0].w, call.source[1].w, call.source[2].w);
        let z = call.source[0].z * away.x + call.source[1].z * away.y + call.source[2].z * away.z;
        let unit = log(max(z, call.z_min)) - call.log_focal;
        scale = log(max(scale, vec3<f32>(call.scale_min))) - unit;
    }
    if quat.x < 0.0 {
        quat = -quat;
    }
    var opacity = rows[row + OPACITY_OFFSET];
    if call.logit == 1u {
        let p = clamp(opacity, call.logit_low, 1.0 - call.logit_low);
        opacity = log(p) - log(1.0 - p);
    }
    let to = i * 11u;
    for (var k = 0u; k < 3u; k++) {
        result[to + k] = position[k];
        result[to + 3u + k] = scale[k];
    }
    for (var k = 0u; k < 4u; k++) {
        result[to + 6u + k] = quat[k];
    }
    result[to + 10u] = opacity;
}
