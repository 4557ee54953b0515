// Gradients of convex.wgsl: of the logits, and the maps' sums over the fine pixels of each neighbour,
// from which convex_maps_bwd takes the maps' gradients. CPU version: cpu/small/convex.rs. One
// thread per coarse pixel.

@group(0) @binding(0) var<uniform> call: ConvexUniform;
// [pictures, 16 fine pixels, 9 neighbours, height, width].
@group(0) @binding(1) var<storage, read> logits: array<f32>;
// [pictures, height, width].
@group(0) @binding(2) var<storage, read> first_map: array<f32>;
@group(0) @binding(3) var<storage, read> second_map: array<f32>;
// [16, 9].
@group(0) @binding(4) var<storage, read> start: array<f32>;
// [2, pictures, 4 height, 4 width].
@group(0) @binding(5) var<storage, read> dy: array<f32>;
// As `logits`.
@group(0) @binding(6) var<storage, read_write> d_logits: array<f32>;
// [2, pictures, 9 neighbours, height, width].
@group(0) @binding(7) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    let count = call.pictures * plane;
    if i >= count {
        return;
    }
    let picture = i / plane;
    let coarse = vec2<i32>(i32(i % plane / call.width), i32(i % call.width));
    let last = vec2<i32>(i32(call.height), i32(call.width)) - 1;
    var values: array<vec2<f32>, 9>;
    var of_maps: array<vec2<f32>, 9>;
    for (var n = 0u; n < 9u; n++) {
        let near = clamp(coarse + vec2<i32>(i32(n / 3u), i32(n % 3u)) - 1, vec2<i32>(), last);
        let at = picture * plane + u32(near.x) * call.width + u32(near.y);
        values[n] = vec2<f32>(first_map[at], second_map[at]);
        of_maps[n] = vec2<f32>();
    }
    for (var fine = 0u; fine < 16u; fine++) {
        let base = (picture * 144u + fine * 9u) * plane + i % plane;
        var most = -3.0e38;
        for (var n = 0u; n < 9u; n++) {
            most = max(most, logits[base + n * plane] + start[fine * 9u + n]);
        }
        var shares: array<f32, 9>;
        var sum = 0.0;
        for (var n = 0u; n < 9u; n++) {
            shares[n] = exp(logits[base + n * plane] + start[fine * 9u + n] - most);
            sum += shares[n];
        }
        let row = 4u * u32(coarse.x) + fine / 4u;
        let column = 4u * u32(coarse.y) + fine % 4u;
        let at = picture * 16u * plane + row * 4u * call.width + column;
        let d = vec2<f32>(dy[at], dy[16u * count + at]);
        var mean = 0.0;
        for (var n = 0u; n < 9u; n++) {
            shares[n] /= sum;
            mean += shares[n] * dot(d, values[n]);
            of_maps[n] += shares[n] * d;
        }
        for (var n = 0u; n < 9u; n++) {
            d_logits[base + n * plane] = shares[n] * (dot(d, values[n]) - mean);
        }
    }
    for (var n = 0u; n < 9u; n++) {
        let at = (picture * 9u + n) * plane + i % plane;
        sums[at] = of_maps[n].x;
        sums[9u * count + at] = of_maps[n].y;
    }
}
