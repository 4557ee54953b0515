// Gradients of the maps of convex.wgsl: each coarse pixel adds the sums of the pixels around it that
// read it; an edge repeats its pixels. CPU version: cpu/small/convex.rs.

@group(0) @binding(0) var<uniform> call: ConvexUniform;
// [2, pictures, 9 neighbours, height, width].
@group(0) @binding(1) var<storage, read> sums: array<f32>;
// [2, pictures, height, width].
@group(0) @binding(2) var<storage, read_write> dx: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= 2u * call.pictures * plane {
        return;
    }
    let last = vec2<i32>(i32(call.height), i32(call.width)) - 1;
    let own = vec2<i32>(i32(i % plane / call.width), i32(i % call.width));
    let low = max(own - 1, vec2<i32>());
    let high = min(own + 1, last);
    var sum = 0.0;
    for (var y = low.x; y <= high.x; y++) {
        for (var x = low.y; x <= high.y; x++) {
            for (var n = 0u; n < 9u; n++) {
                let near = vec2<i32>(y, x) + vec2<i32>(i32(n / 3u), i32(n % 3u)) - 1;
                if all(clamp(near, vec2<i32>(), last) == own) {
                    sum += sums[(i / plane * 9u + n) * plane + u32(y) * call.width + u32(x)];
                }
            }
        }
    }
    dx[i] = sum;
}
