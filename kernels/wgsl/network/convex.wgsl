// Upsampling by 4: a fine pixel is a mean of 3 x 3 coarse pixels, edges repeated, weighted by a
// softmax of logits + start. CPU version: cpu/small/convex.rs.

@group(0) @binding(0) var<uniform> call: ConvexUniform;
// [pictures, 16 fine pixels, 9 neighbours, height, width].
@group(0) @binding(1) var<storage, read> logits: array<f32>;
// [pictures, height, width].
@group(0) @binding(2) var<storage, read> first_map: array<f32>;
@group(0) @binding(3) var<storage, read> second_map: array<f32>;
// [16, 9].
@group(0) @binding(4) var<storage, read> start: array<f32>;
// [2, pictures, 4 height, 4 width].
@group(0) @binding(5) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    let count = call.pictures * 16u * plane;
    if i >= count {
        return;
    }
    let fine_width = 4u * call.width;
    let column = i % fine_width;
    let row = i / fine_width % (4u * call.height);
    let picture = i / (16u * plane);
    let coarse = vec2<i32>(i32(row / 4u), i32(column / 4u));
    let fine = row % 4u * 4u + column % 4u;
    let base = (picture * 144u + fine * 9u) * plane + u32(coarse.x) * call.width + u32(coarse.y);
    var most = -3.0e38;
    for (var n = 0u; n < 9u; n++) {
        most = max(most, logits[base + n * plane] + start[fine * 9u + n]);
    }
    var sums = vec3<f32>();
    let last = vec2<i32>(i32(call.height), i32(call.width)) - 1;
    for (var n = 0u; n < 9u; n++) {
        let weight = exp(logits[base + n * plane] + start[fine * 9u + n] - most);
        let near = clamp(coarse + vec2<i32>(i32(n / 3u), i32(n % 3u)) - 1, vec2<i32>(), last);
        let at = picture * plane + u32(near.x) * call.width + u32(near.y);
        sums += weight * vec3<f32>(1.0, first_map[at], second_map[at]);
    }
    result[i] = sums.y / sums.x;
    result[count + i] = sums.z / sums.x;
}
