// Last of three kernels of the prefix sum: places within blocks, on top of the blocks' own.

@group(0) @binding(0) var<storage, read> plan: array<u32>;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let first = block * GPU_BLOCK + 8u * lane;
    let past = min(first + 8u, plan[PLAN_COUNT]);
    var sum = 0u;
    for (var i = first; i < past; i++) {
        sum = saturating(sum, counts[order[i]]);
    }
    var before = saturating(sums[block], scan_threads(lane, sum));
    for (var i = first; i < past; i++) {
        offsets[i] = before;
        before = saturating(before, counts[order[i]]);
    }
}
