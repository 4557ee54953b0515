// Consistency of each pixel's point with the other views of its scene: a factor of its opacity.
// CPU version: cpu/small/cross_check.rs.

@group(0) @binding(0) var<uniform> call: CrossCheckUniform;
// [scenes views, 3, pixels].
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
// [scenes views, pixels]: along the unit ray, world units.
@group(0) @binding(2) var<storage, read> distances: array<f32>;
// Per view: rows of R (world from camera) with the position as the fourth column (12), focal
// lengths, principal point (4).
@group(0) @binding(3) var<storage, read> cameras: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> factors: array<f32>;

// Returns the largest camera z of the 3x3 pixels around a position inside the picture.
fn farthest(view: u32, at: vec2<f32>) -> f32 {
    let window = around(at);
    var most = 0.0;
    for (var row = window.y; row <= window.w; row++) {
        for (var column = window.x; column <= window.z; column++) {
            most = max(most, surface_z(view, vec2<u32>(column, row)));
        }
    }
    return most;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.scenes * call.views * plane {
        return;
    }
    let view = i / plane;
    let pixel = vec2<u32>(i % call.width, i % plane / call.width);
    let own = colour(view, pixel);
    let point = world_point(view, centre(pixel), surface_z(view, pixel));
    var sum = 0.0;
    var count = 0u;
    let first = view / call.views * call.views;
    for (var other = first; other < first + call.views; other++) {
        if other == view {
            continue;
        }
        let seen = projected(other, point);
        if !(seen.z > 0.0) {
            continue;
        }
        if seen.z <= farthest(other, seen.xy) * (1.0 + call.behind) {
            sum += min(colour_difference(other, seen.xy, own), call.colour) / call.colour;
            count++;
        }
    }
    factors[i] = 1.0 - (1.0 - call.least) * sum / f32(max(count, 1u));
}
