// Correlation of every reference pixel with its projection into the source views at each
// candidate depth (MVSplat, cost volume). The warped features are not stored. CPU version:
// cpu/plane_sweep/mod.rs. Arguments except the last: wgsl/shared/sweep_taps.wgsl.
//
// Input: reference [R,C,h,w], source [S,C,h,w]. Output: [R,D,h,w]. One thread per element.

@group(0) @binding(6) var<storage, read_write> correlation: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.rows * call.candidates * plane {
        return;
    }
    let pixel = i % plane;
    let k = i / plane % call.candidates;
    let r = i / plane / call.candidates;
    let depth = depths[r * call.candidates + k];
    let own = r * call.channels * plane + pixel;
    var sum = 0.0;
    for (var pair = pair_starts[r]; pair < pair_starts[r + 1u]; pair++) {
        let t = taps(project(pair, pixel % call.width, pixel / call.width, depth));
        if all(t.weights == vec4<f32>()) {
            continue;
        }
        var at = t.cells + source_row(pair) * call.channels * plane;
        var product = 0.0;
        for (var c = 0u; c < call.channels; c++) {
            let g = vec4<f32>(source[at.x], source[at.y], source[at.z], source[at.w]);
            product += reference[own + c * plane] * dot(t.weights, g);
            at += plane;
        }
        sum += product;
    }
    correlation[i] = pair_factor(r) * sum;
}
