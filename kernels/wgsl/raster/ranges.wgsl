// Half-open range of pairs of every tile, and of the surplus tile after the last one, from pairs
// sorted by tile. Tiles without pairs keep the cleared value. One thread per pair.
// CPU version: cpu/raster/tiles.rs.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> plan: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 256u + thread;
    let count = plan[PLAN_COUNT];
    if i >= count {
        return;
    }
    let tile = tiles[i];
    if i == 0u || tiles[max(i, 1u) - 1u] != tile {
        ranges[2u * tile] = i;
    }
    if i + 1u == count || tiles[min(i + 1u, count - 1u)] != tile {
        ranges[2u * tile + 1u] = i + 1u;
    }
}
