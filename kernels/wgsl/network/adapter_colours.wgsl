// SH of primaries: a matrix of each view masks, maps and rotates the raw coefficients. CPU version:
// cpu/adapter/colour.rs.

@group(0) @binding(0) var<uniform> call: AdapterUniform;
// [views * pixels, lanes].
@group(0) @binding(1) var<storage, read> raw: array<f32>;
// [views, functions, functions].
@group(0) @binding(2) var<storage, read> matrices: array<f32>;
// [gaussians, functions, 3] where call.interleaved is 1, else [gaussians, 3, functions].
@group(0) @binding(3) var<storage, read_write> colours: array<f32>;

// Numbers of a raw row before its SH.
const GEOMETRY: u32 = 9u;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = workgroup_number(workgroup, workgroups) * 64u + thread;
    let d = call.functions;
    if index >= call.gaussians * d {
        return;
    }
    let i = index / d;
    let row = index % d;
    let pixel = i / call.per_pixel;
    let first = pixel * call.lanes + GEOMETRY;
    let matrix = (pixel / call.pixels * d + row) * d;
    var sum = vec3(0.0);
    for (var j = 0u; j < d; j++) {
        let factor = matrices[matrix + j];
        if factor != 0.0 {
            sum += factor * vec3(raw[first + j], raw[first + d + j], raw[first + 2u * d + j]);
        }
    }
    let interleaved = call.interleaved == 1u;
    let to = i * 3u * d + select(row, 3u * row, interleaved);
    let step = select(d, 1u, interleaved);
    colours[to] = sum.x;
    colours[to + step] = sum.y;
    colours[to + 2u * step] = sum.z;
}
