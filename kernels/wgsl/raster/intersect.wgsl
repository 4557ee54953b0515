// Exact list of (splat, tile) pairs in order of depth. CPU version: cpu/raster/tiles.rs.
//
// Input: splats in order of depth, index of each splat's first pair. Output: tile and splat
// (owner) of every pair. The number of pairs equals the count of project.wgsl, even where a
// compiler rounds the two computations differently: missing pairs are assigned to the surplus
// tile after the last one, which is not drawn. One thread per splat.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> rectangles: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> offsets: array<u32>;
@group(0) @binding(6) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(7) var<storage, read_write> owners: array<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let place = workgroup_number(workgroup, workgroups) * 64u + thread;
    if place >= call.count {
        return;
    }
    let i = order[place];
    let count = counts[i];
    if count == 0u {
        return;
    }
    var next = offsets[place];
    let past = min(next + count, call.capacity);
    let rectangle = rectangles[i];
    let columns = unpack(rectangle.x);
    let lines = unpack(rectangle.y);
    let whole = is_small(columns, lines);
    let a = footprints[3u * i];
    let b = footprints[3u * i + 1u];
    let half_height = footprints[3u * i + 2u].w;
    let f = Footprint(a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, half_height);
    let band_lines = rows_in_band(lines);
    for (var line = band_lines.x; line < band_lines.y; line++) {
        var span = columns;
        if !whole {
            span = tiles_of_row(f, line, columns);
        }
        for (var column = span.x; column < span.y && next < past; column++) {
            tiles[next] = (line - call.top) * call.columns + column;
            owners[next] = i;
            next++;
        }
    }
    for (; next < past; next++) {
        tiles[next] = call.columns * call.rows;
        owners[next] = i;
    }
}
