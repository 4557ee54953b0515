// Consistency of each pixel's point with the other views of its scene: a factor of its opacity.
// CPU version: src/cpu/small/cross_check.rs.

struct CrossCheckUniform {
    scenes: u32,
    views: u32,
    height: u32,
    width: u32,
    // Factor of a pixel that is inconsistent everywhere; sum of |difference of colour| from which
    // inconsistency is 1; share of z by which a hidden point lies behind a surface.
    least: f32,
    colour: f32,
    behind: f32,
    pad: f32,
}

@group(0) @binding(0) var<uniform> call: CrossCheckUniform;
// [scenes views, 3, pixels].
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
// [scenes views, pixels]: along the unit ray, world units.
@group(0) @binding(2) var<storage, read> distances: array<f32>;
// Per view: rows of R (world from camera) with the position as the fourth column (12), focal
// lengths, principal point (4).
@group(0) @binding(3) var<storage, read> cameras: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> factors: array<f32>;

// Returns K^-1 (u, v, 1) of a pixel's centre.
fn ray(view: u32, x: u32, y: u32) -> vec3<f32> {
    let k = cameras[view * 4u + 3u];
    return vec3<f32>((vec2<f32>(f32(x), f32(y)) + 0.5 - k.zw) / k.xy, 1.0);
}

// Returns the camera z of a pixel's surface.
fn surface_z(view: u32, x: u32, y: u32) -> f32 {
    let at = view * call.height * call.width + y * call.width + x;
    return distances[at] / length(ray(view, x, y));
}

fn colour(view: u32, x: u32, y: u32) -> vec3<f32> {
    let plane = call.height * call.width;
    let at = view * 3u * plane + y * call.width + x;
    return vec3<f32>(rgb[at], rgb[at + plane], rgb[at + 2u * plane]);
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
    let x = i % call.width;
    let y = i % plane / call.width;
    let own = colour(view, x, y);
    let in_camera = vec4<f32>(ray(view, x, y) * surface_z(view, x, y), 1.0);
    let c = view * 4u;
    let point = vec3<f32>(
        dot(cameras[c], in_camera),
        dot(cameras[c + 1u], in_camera),
        dot(cameras[c + 2u], in_camera),
    );
    var sum = 0.0;
    var count = 0u;
    let first = view / call.views * call.views;
    for (var other = first; other < first + call.views; other++) {
        if other == view {
            continue;
        }
        let o = other * 4u;
        let away = point - vec3<f32>(cameras[o].w, cameras[o + 1u].w, cameras[o + 2u].w);
        let p = cameras[o].xyz * away.x + cameras[o + 1u].xyz * away.y
            + cameras[o + 2u].xyz * away.z;
        let k = cameras[o + 3u];
        let at = k.xy * p.xy / p.z + k.zw;
        let size = vec2<f32>(f32(call.width), f32(call.height));
        if !(all(at >= vec2<f32>()) && all(at < size) && p.z > 0.0) {
            continue;
        }
        let centre = vec2<i32>(at);
        let last = vec2<i32>(i32(call.width), i32(call.height)) - 1;
        let low = max(centre - 1, vec2<i32>());
        let high = min(centre + 1, last);
        var surface = 0.0;
        var apart = call.colour;
        for (var row = low.y; row <= high.y; row++) {
            for (var column = low.x; column <= high.x; column++) {
                surface = max(surface, surface_z(other, u32(column), u32(row)));
                let difference = abs(colour(other, u32(column), u32(row)) - own);
                apart = min(apart, difference.x + difference.y + difference.z);
            }
        }
        if p.z <= surface * (1.0 + call.behind) {
            sum += apart / call.colour;
            count++;
        }
    }
    factors[i] = 1.0 - (1.0 - call.least) * sum / f32(max(count, 1u));
}
