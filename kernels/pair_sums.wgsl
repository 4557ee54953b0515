// Adds up each splat's (splat, tile) pairs, in the order of its tiles: the same bytes each
// time. Twin: the gather of src/cpu/raster_bwd.rs.
//
// In: splats by depth, the place of each one's first pair, ten sums a pair.  Out: ten sums
// a splat [N, 10] from splat `own` on, zeros for dropped ones; a colour channel that is
// clamped has no gradient. A call that resumes adds to what is there, and leaves alone
// what is not of splats `first` to `first` + `count`.   One thread per place.

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
    @builtin(local_invocation_index) lane: u32,
) {
    let place = workgroup_number(workgroup, workgroups) * 64u + lane;
    if place >= call.places {
        return;
    }
    let i = order[call.place + place];
    // Wraps for a splat before the first.
    if i - call.first >= call.count {
        return;
    }
    let own = call.own + i - call.first;
    let to = PAIR_SUMS * own;
    let count = counts[i];
    var v_low = vec3<f32>(0.0);
    var v_high = vec3<f32>(0.0);
    var rgb = vec3<f32>(0.0);
    var z = 0.0;
    if call.resumes != 0u {
        v_low = vec3<f32>(sums[to], sums[to + 1u], sums[to + 2u]);
        v_high = vec3<f32>(sums[to + 3u], sums[to + 4u], sums[to + 5u]);
        rgb = vec3<f32>(sums[to + 6u], sums[to + 7u], sums[to + 8u]);
        z = sums[to + 9u];
    }
    var at = PAIR_SUMS * offsets[place];
    for (var k = 0u; k < count; k++) {
        v_low += vec3<f32>(pairs[at], pairs[at + 1u], pairs[at + 2u]);
        v_high += vec3<f32>(pairs[at + 3u], pairs[at + 4u], pairs[at + 5u]);
        rgb += vec3<f32>(pairs[at + 6u], pairs[at + 7u], pairs[at + 8u]);
        z += pairs[at + 9u];
        at += PAIR_SUMS;
    }
    if count > 0u {
        rgb = select(vec3<f32>(0.0), rgb, footprints[3u * own + 2u].xyz > vec3<f32>(0.0));
    }
    sums[to] = v_low.x;
    sums[to + 1u] = v_low.y;
    sums[to + 2u] = v_low.z;
    sums[to + 3u] = v_high.x;
    sums[to + 4u] = v_high.y;
    sums[to + 5u] = v_high.z;
    sums[to + 6u] = rgb.x;
    sums[to + 7u] = rgb.y;
    sums[to + 8u] = rgb.z;
    sums[to + 9u] = z;
}
