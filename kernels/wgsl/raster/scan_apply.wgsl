// Third of three kernels of the prefix sum: adds the prefix sums within the blocks to those of
// the blocks. Output: index of each splat's first (splat, tile) pair, in order of depth. One
// workgroup per block. CPU version: cpu/raster/tiles.rs.

@group(0) @binding(0) var<storage, read> plan: array<u32>;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let first = block * GPU_BLOCK + 8u * thread;
    let past = min(first + 8u, plan[PLAN_COUNT]);
    var sum = 0u;
    for (var i = first; i < past; i++) {
        sum = saturating_add(sum, counts[order[i]]);
    }
    var before = saturating_add(sums[block], scan_threads(thread, sum));
    for (var i = first; i < past; i++) {
        offsets[i] = before;
        before = saturating_add(before, counts[order[i]]);
    }
}
