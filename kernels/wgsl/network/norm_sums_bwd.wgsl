// Sums over parts of each channel of the gradient before the activation, d, and of d times the
// normalised number: the gradients of summands and factors. CPU version: cpu/norm.rs.

// [B, channels, channel_parts].
@group(0) @binding(6) var<storage, read_write> sums: array<vec2<f32>>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    place: Place,
) {
    let thread = thread_of(place);
    let number = workgroup_number(workgroup, workgroups);
    let part = channel_part(number);
    var sum = vec2<f32>();
    for (var i = thread; i < part.count; i += THREADS) {
        let own = normalised(part, part.base + i);
        sum += vec2<f32>(own.y, own.y * own.x);
    }
    let of_summand = total(sum.x, place);
    let of_factor = total(sum.y, place);
    if thread == 0u && number < all_channels() * call.channel_parts {
        sums[number] = vec2<f32>(of_summand, of_factor);
    }
}
