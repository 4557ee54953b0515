// Sums over parts of each channel of the gradient before the activation, d, and of d times the
// normalised number: the gradients of summands and factors. CPU version: src/cpu/norm.rs.

@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> summands: array<f32>;
// Gradient of the result.
@group(0) @binding(5) var<storage, read> dy: array<f32>;
// [B, channels, channel_parts].
@group(0) @binding(6) var<storage, read_write> sums: array<vec2<f32>>;

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
    var sum = vec2<f32>();
    for (var i = thread; i < count; i += THREADS) {
        let v = (x[base + i] - own.x) * own.y;
        let d = dy[base + i] * activation_slope(ACTIVATION_KIND, v * factor + summand);
        sum += vec2<f32>(d, d * v);
    }
    let of_summand = total(sum.x, thread);
    let of_factor = total(sum.y, thread);
    if thread == 0u && number < all * call.channel_parts {
        sums[number] = vec2<f32>(of_summand, of_factor);
    }
}
