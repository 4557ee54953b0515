// Gradient of a normalised array, from the sums of norm_sums_bwd. With v the normalised number and d
// the gradient before the activation: scale * (factor * d - mean(factor * d) - v * mean(factor * d * v)),
// means over the row. CPU version: cpu/norm.rs.

// [B, channels].
@group(0) @binding(6) var<storage, read> sums: array<vec2<f32>>;
@group(0) @binding(7) var<storage, read_write> dx: array<f32>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let part = channel_part(number);
    let channels = call.length / call.run;
    var of_row = vec2<f32>();
    for (var c = 0u; c < channels; c++) {
        let place = part.row * channels + c;
        of_row += factor_of(place) * sums[place];
    }
    let means = of_row / f32(call.length);
    if number >= all_channels() * call.channel_parts {
        return;
    }
    for (var i = thread; i < part.count; i += THREADS) {
        let own = normalised(part, part.base + i);
        dx[part.base + i] = part.own.y * (part.factor * own.y - means.x - own.x * means.y);
    }
}
