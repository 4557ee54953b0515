// Copies the splats of one layer, consecutive in order of depth. Pictures whose footprints or
// pairs exceed a binding are drawn in layers (gpu/raster/layers.rs). No CPU version:
// the CPU needs no layers.
//
// Input: splats in order of depth, tile counts [N]; footprints and rectangles of splats `first`
// to `first` + `count`. Output, by place in the layer: footprints, rectangles and counts of those
// splats, and the identity as their order. One thread per place.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> rectangles: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> own_footprints: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> own_rectangles: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read_write> own_order: array<u32>;
@group(0) @binding(8) var<storage, read_write> own_counts: array<u32>;

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
    let own = i - call.first;
    if own >= call.count {
        return;
    }
    own_footprints[3u * place] = footprints[3u * own];
    own_footprints[3u * place + 1u] = footprints[3u * own + 1u];
    own_footprints[3u * place + 2u] = footprints[3u * own + 2u];
    own_rectangles[place] = rectangles[own];
    own_order[place] = place;
    own_counts[place] = counts[i];
}
