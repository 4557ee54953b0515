// Counts each digit in each block. Output: histogram [16, blocks]. One workgroup per block.
// CPU version: cpu/raster/sort.rs.

@group(0) @binding(0) var<uniform> call: SortUniform;
@group(0) @binding(1) var<storage, read> plan: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let first = block * GPU_BLOCK + 8u * thread;
    var counters = vec2<u32>(0u);
    for (var i = first; i < min(first + 8u, plan[PLAN_COUNT]); i++) {
        counters = tally_add(counters, (keys[i] >> call.shift) & 15u);
    }
    sum_segments(thread, counters);
    let blocks = plan[PLAN_BLOCKS];
    if thread < 8u && block < blocks {
        var sum = 0u;
        for (var i = 32u * thread; i < 32u * thread + 32u; i++) {
            sum += sort_segments[i];
        }
        histogram[thread * blocks + block] = sum & 0xffffu;
        histogram[(thread + 8u) * blocks + block] = sum >> 16u;
    }
}
