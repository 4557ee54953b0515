// First of three kernels of the prefix sum over the splats' numbers of (splat, tile) pairs, in
// order of depth: sums of blocks of GPU_BLOCK counts. One workgroup per block. CPU version:
// cpu/raster/tiles.rs.

@group(0) @binding(0) var<storage, read> plan: array<u32>;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let first = block * GPU_BLOCK + 8u * thread;
    var sum = 0u;
    for (var i = first; i < min(first + 8u, plan[PLAN_COUNT]); i++) {
        sum = saturating_add(sum, counts[order[i]]);
    }
    scan_threads(thread, sum);
    if thread == 0u && block < plan[PLAN_BLOCKS] {
        sums[block] = scan_totals[16];
    }
}
