// Sums over each splat's (splat, tile) pairs, in the order of its tiles, which makes the results
// reproducible. CPU version: the gather of cpu/raster/rasterize_bwd.rs.
//
// Input: splats in order of depth, index of each splat's first pair, ten sums per pair. Output:
// ten sums per splat [N, 10] from splat `own` on, zeros for dropped splats; a clamped colour
// channel has no gradient. A call that resumes adds to the existing sums. Only the splats `first`
// to `first` + `count` are written. One thread per place in the order by depth.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> counts: array<u32>;
@group(0) @binding(4) var<storage, read> offsets: array<u32>;
@group(0) @binding(5) var<storage, read> pairs: array<f32>;
@group(0) @binding(6) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let place = workgroup_number(workgroup, workgroups) * 64u + thread;
    if place >= call.places {
        return;
    }
    let i = order[call.place + place];
    // Wraps around for a splat before the first.
    if i - call.first >= call.count {
        return;
    }
    let own = call.own + i - call.first;
    var m = Moments(0.0, vec2<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0), 0.0);
    if call.resumes != 0u {
        m = moments(own);
    }
    let count = counts[i];
    var at = PAIR_SUMS * offsets[place];
    for (var k = 0u; k < count; k++) {
        m.one += pairs[at];
        m.first += vec2<f32>(pairs[at + 1u], pairs[at + 2u]);
        m.second += vec3<f32>(pairs[at + 3u], pairs[at + 4u], pairs[at + 5u]);
        m.rgb += vec3<f32>(pairs[at + 6u], pairs[at + 7u], pairs[at + 8u]);
        m.z += pairs[at + 9u];
        at += PAIR_SUMS;
    }
    if count > 0u {
        m.rgb = select(vec3<f32>(0.0), m.rgb, footprints[3u * own + 2u].xyz > vec3<f32>(0.0));
    }
    let to = PAIR_SUMS * own;
    sums[to] = m.one;
    sums[to + 1u] = m.first.x;
    sums[to + 2u] = m.first.y;
    sums[to + 3u] = m.second.x;
    sums[to + 4u] = m.second.y;
    sums[to + 5u] = m.second.z;
    sums[to + 6u] = m.rgb.x;
    sums[to + 7u] = m.rgb.y;
    sums[to + 8u] = m.rgb.z;
    sums[to + 9u] = m.z;
}
