// Gradient [cells, stride] of the maps of the attention gather, from the factors of
// attention_gather_bwd and the lists of invert. Entries are summed in the order of the parents.
// CPU version: cpu/attention_gather/backward.rs (scatter). One thread per element.

@group(0) @binding(1) var<storage, read> query: array<f32>;
@group(0) @binding(2) var<storage, read> grad: array<f32>;
@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> starts: array<u32>;
@group(0) @binding(5) var<storage, read> list: array<u32>;
@group(0) @binding(6) var<storage, read_write> d_maps: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.cells * call.stride {
        return;
    }
    let cell = i / call.stride;
    let channel = i % call.stride;
    // Below the first channel the difference wraps around to a value that is not a channel.
    let key = channel - call.key;
    let value = channel - call.value;
    let has_key = call.has_key != 0u && key < call.dim;
    let has_value = value < call.dim;
    let group_dim = call.dim / call.groups;
    var sum = 0.0;
    for (var e = starts[cell]; e < starts[cell + 1u]; e++) {
        let entry = list[e];
        let n = entry / (4u * sample_count());
        let at = entry / 4u * (4u + 2u * call.groups);
        let w = factors[at + entry % 4u];
        if has_key {
            sum += w * factors[at + 4u + 2u * (key / group_dim)] * query[n * query_width() + key];
        }
        if has_value {
            sum += w * factors[at + 5u + 2u * (value / group_dim)] * grad[n * call.dim + value];
        }
    }
    d_maps[i] = sum;
}
