// Gradient of a normalised array, from the sums of norm_sums_bwd. With v the normalised number and d
// the gradient before the activation: scale * (factor * d - mean(factor * d) - v * mean(factor * d * v)),
// means over the row. CPU version: src/cpu/norm.rs.

@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> summands: array<f32>;
// Gradient of the result.
@group(0) @binding(5) var<storage, read> dy: array<f32>;
// [B, channels].
@group(0) @binding(6) var<storage, read> sums: array<vec2<f32>>;
@group(0) @binding(7) var<storage, read_write> dx: array<f32>;

override ACTIVATION_KIND: u32 = 0u;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let channels = call.length / call.run;
    let all = call.rows * channels;
    let number = workgroup_number(workgroup, workgroups);
    // A channel of a picture, and its row.
    let place = min(number / call.channel_parts, all - 1u);
    let row = place / channels;
    let channel = place % (call.groups * channels);
    let own = mean_and_scale(row);
    var factor = 1.0;
    var summand = 0.0;
    if call.has_affine == 1u {
        factor = factors[channel];
        summand = summands[channel];
    }
    let first = number % call.channel_parts * PART;
    let count = min(call.run - first, PART);
    let base = place * call.run + first;
    var of_row = vec2<f32>();
    for (var c = 0u; c < channels; c++) {
        let at = row * channels + c;
        var own_factor = 1.0;
        if call.has_affine == 1u {
            own_factor = factors[at % (call.groups * channels)];
        }
        of_row += own_factor * sums[at];
    }
    let means = of_row / f32(call.length);
    if number >= all * call.channel_parts {
        return;
    }
    for (var i = thread; i < count; i += THREADS) {
        let v = (x[base + i] - own.x) * own.y;
        let d = dy[base + i] * activation_slope(ACTIVATION_KIND, v * factor + summand);
        dx[base + i] = own.y * (factor * d - means.x - v * means.y);
    }
}
