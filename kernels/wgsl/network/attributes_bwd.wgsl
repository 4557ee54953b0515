// Gradient of the packed rows from the gradient of their attributes. CPU version:
// cpu/attributes.rs.

// [parents, 11]: position 3, scale 3, quaternion 4, opacity 1.
@group(0) @binding(2) var<storage, read> dy: array<f32>;
// [parents, SPLAT_STRIDE].
@group(0) @binding(3) var<storage, read_write> dx: array<f32>;

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
    let first = i * 11u;
    let m = row + MEAN_OFFSET;
    let mean = vec3<f32>(rows[m], rows[m + 1u], rows[m + 2u]);
    var d_position = vec3<f32>(dy[first], dy[first + 1u], dy[first + 2u]);
    let q = row + QUAT_OFFSET;
    var quat_w = rows[q];
    var position = mean;
    if call.framed == 1u {
        let away = mean - vec3<f32>(call.frame[0].w, call.frame[1].w, call.frame[2].w);
        position = call.frame[0].xyz * away.x + call.frame[1].xyz * away.y
            + call.frame[2].xyz * away.z;
        quat_w = dot(call.turn[0], vec4<f32>(rows[q], rows[q + 1u], rows[q + 2u], rows[q + 3u]));
    }
    if call.ray == 1u {
        let z = max(position.z, call.z_min);
        let slopes = position.xy / z;
        let inside = abs(slopes) < vec2<f32>(call.slope_max);
        let d_slopes = select(vec2<f32>(), d_position.xy, inside);
        let d_z = d_position.z - dot(d_slopes, slopes);
        d_position = vec3<f32>(d_slopes / z, select(0.0, d_z / z, position.z > call.z_min));
    }
    var d_mean = d_position;
    if call.framed == 1u {
        d_mean = vec3<f32>(
            dot(call.frame[0].xyz, d_position),
            dot(call.frame[1].xyz, d_position),
            dot(call.frame[2].xyz, d_position),
        );
    }
    var d_scale = vec3<f32>(dy[first + 3u], dy[first + 4u], dy[first + 5u]);
    if call.log_px == 1u {
        let away = mean - vec3<f32>(call.source[0].w, call.source[1].w, call.source[2].w);
        let axis = vec3<f32>(call.source[0].z, call.source[1].z, call.source[2].z);
        let z = dot(axis, away);
        let sum = d_scale.x + d_scale.y + d_scale.z;
        d_mean += axis * select(0.0, -sum / max(z, call.z_min), z > call.z_min);
        let s = row + SCALE_OFFSET;
        let scale = vec3<f32>(rows[s], rows[s + 1u], rows[s + 2u]);
        let least = vec3<f32>(call.scale_min);
        d_scale = select(vec3<f32>(), d_scale / max(scale, least), scale > least);
    }
    var d_quat = vec4<f32>(dy[first + 6u], dy[first + 7u], dy[first + 8u], dy[first + 9u]);
    if quat_w < 0.0 {
        d_quat = -d_quat;
    }
    if call.framed == 1u {
        d_quat = call.turn[0] * d_quat.x + call.turn[1] * d_quat.y + call.turn[2] * d_quat.z
            + call.turn[3] * d_quat.w;
    }
    var d_opacity = dy[first + 10u];
    if call.logit == 1u {
        let opacity = rows[row + OPACITY_OFFSET];
        let low = call.logit_low;
        let p = clamp(opacity, low, 1.0 - low);
        let inside = opacity > low && opacity < 1.0 - low;
        d_opacity = select(0.0, d_opacity / (p * (1.0 - p)), inside);
    }
    for (var k = 0u; k < 3u; k++) {
        dx[row + MEAN_OFFSET + k] = d_mean[k];
        dx[row + SCALE_OFFSET + k] = d_scale[k];
    }
    for (var k = 0u; k < 4u; k++) {
        dx[row + QUAT_OFFSET + k] = d_quat[k];
    }
    dx[row + OPACITY_OFFSET] = d_opacity;
}
