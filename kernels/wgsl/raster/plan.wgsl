// Number of workgroups for the sort of the (splat, tile) pairs, from the number of pairs. `sums`
// holds that number after the sums of its blocks; it exists on the device only. No CPU version: the
// CPU knows the number.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> splats: array<u32>;
@group(0) @binding(2) var<storage, read> sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> plan: array<u32>;

// Writes the x, y and z counts for `groups` workgroups, within the limit of one dimension.
fn spread(groups: u32, at: u32) {
    let y = max((groups + 65534u) / 65535u, 1u);
    plan[at] = (groups + y - 1u) / y;
    plan[at + 1u] = y;
    plan[at + 2u] = 1u;
}

@compute @workgroup_size(1)
fn main() {
    let requested = sums[splats[PLAN_BLOCKS]];
    let count = min(requested, call.capacity);
    let blocks = (count + GPU_BLOCK - 1u) / GPU_BLOCK;
    spread(blocks, 0u);
    spread((count + 255u) / 256u, PLAN_ELEMENT_GROUPS);
    plan[PLAN_COUNT] = count;
    plan[PLAN_BLOCKS] = blocks;
    plan[PLAN_REQUESTED] = requested;
}
