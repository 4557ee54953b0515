// Taps of the gradients of the plane sweep: cell of the source maps and coefficient of each tap
// of each candidate, multiplied by the gradient of the correlation. CPU version:
// cpu/plane_sweep/backward.rs. Arguments except the last three:
// wgsl/shared/sweep_taps.wgsl.
//
// Output: [pairs, D, h·w, 4] cells of [S, h·w], or NONE, and coefficients. One thread per
// candidate and pixel.

@group(0) @binding(6) var<storage, read> grad: array<f32>;
@group(0) @binding(7) var<storage, read_write> cells_of: array<u32>;
@group(0) @binding(8) var<storage, read_write> factors: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.pairs * call.candidates * plane {
        return;
    }
    let pixel = i % plane;
    let k = i / plane % call.candidates;
    let pair = i / plane / call.candidates;
    let r = row_of(pair);
    let candidate = r * call.candidates + k;
    let t = taps(project(pair, pixel % call.width, pixel / call.width, depths[candidate]));
    let g = pair_factor(r) * grad[candidate * plane + pixel];
    for (var j = 0u; j < 4u; j++) {
        let used = t.weights[j] != 0.0;
        cells_of[4u * i + j] = select(NONE, source_row(pair) * plane + t.cells[j], used);
        factors[4u * i + j] = t.weights[j] * g;
    }
}
