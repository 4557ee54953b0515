// Consensus of the views of a scene about depth: each pixel takes the depth that most support.
// CPU version: cpu/small/depth_consensus.rs.

@group(0) @binding(0) var<uniform> call: DepthConsensusUniform;
// [scenes views, 3, pixels].
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
// [scenes views, pixels]: along the unit ray, world units.
@group(0) @binding(2) var<storage, read> distances: array<f32>;
// [scenes views, pixels].
@group(0) @binding(3) var<storage, read> confidences: array<f32>;
// Per view: rows of R (world from camera) with the position as the fourth column (12), focal
// lengths, principal point (4).
@group(0) @binding(4) var<storage, read> cameras: array<vec4<f32>>;
// [scenes views]: sigma of the agreement of two disparities, 1 / world units.
@group(0) @binding(5) var<storage, read> tolerances: array<f32>;
@group(0) @binding(6) var<storage, read_write> result: array<f32>;

// Agreement of two depths, 0 to 1.
fn agreement(view: u32, z: f32, other: f32) -> f32 {
    let apart = (1.0 / z - 1.0 / other) / tolerances[view];
    return select(0.0, exp(-0.5 * apart * apart), abs(apart) < call.reach);
}

// Returns the depth at which a pixel's ray meets the surface of `other`, and its weight; the depth
// is 0 where it does not.
fn candidate(view: u32, pixel: vec2<u32>, other: u32) -> vec2<f32> {
    let own = centre(pixel);
    var z = surface_z(view, pixel);
    for (var step = 0u; step < call.steps; step++) {
        let seen = projected(other, world_point(view, own, z));
        if !(seen.z > 0.0) {
            break;
        }
        let there = vec2<u32>(seen.xy);
        let met = projected(view, world_point(other, seen.xy, surface_z(other, there)));
        if !(met.z > 0.0) {
            break;
        }
        if all(abs(met.xy - own) <= vec2<f32>(call.on_ray)) {
            return vec2<f32>(met.z, confidences[index(other, there)]);
        }
        z = met.z;
    }
    return vec2<f32>();
}

// Support of another view's point by a view.
fn support(view: u32, point: vec3<f32>, wanted: vec3<f32>) -> f32 {
    let seen = projected(view, point);
    if !(seen.z > 0.0) {
        return 0.0;
    }
    let there = vec2<u32>(seen.xy);
    let agreed = agreement(view, seen.z, surface_z(view, there));
    if agreed == 0.0 {
        return 0.0;
    }
    let same = exp(-colour_difference(view, seen.xy, wanted) / call.colour);
    return same * confidences[index(view, there)] * agreed;
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
    let own = vec2<f32>(surface_z(view, pixel), call.own_weight * confidences[i]);
    let wanted = colour(view, pixel);
    let first = view / call.views * call.views;
    let end = first + call.views;

    // The pixel's own depth is the first candidate.
    var most = 0.0;
    var best = 0.0;
    var count = 0u;
    for (var turn = 0u; turn <= call.views; turn++) {
        var z = own.x;
        if turn > 0u {
            let other = first + turn - 1u;
            if other == view {
                continue;
            }
            z = candidate(view, pixel, other).x;
            if !(z > 0.0) {
                continue;
            }
        }
        let point = world_point(view, centre(pixel), z);
        var supports = 0.0;
        for (var other = first; other < end; other++) {
            if other != view {
                supports += support(other, point, wanted);
            }
        }
        let total = own.y * agreement(view, z, own.x) + supports;
        if count == 0u || total > most {
            most = total;
            best = z;
        }
        count++;
    }
    if count == 1u {
        result[i] = distances[i];
        return;
    }
    let own_share = (own.y + call.least_weight) * agreement(view, own.x, best);
    var sum = own_share / own.x;
    var weights = own_share;
    for (var other = first; other < end; other++) {
        if other == view {
            continue;
        }
        let met = candidate(view, pixel, other);
        if met.x > 0.0 {
            let share = (met.y + call.least_weight) * agreement(view, met.x, best);
            sum += share / met.x;
            weights += share;
        }
    }
    result[i] = weights / sum * length(ray(view, centre(pixel)));
}
