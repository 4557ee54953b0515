// Gradient [R, C, h, w] of the reference of the plane sweep, from the taps of plane_sweep_taps.
// CPU version: cpu/plane_sweep/backward.rs. One thread per element.

@group(0) @binding(1) var<storage, read> source: array<f32>;
@group(0) @binding(2) var<storage, read> pair_starts: array<u32>;
@group(0) @binding(3) var<storage, read> cells_of: array<u32>;
@group(0) @binding(4) var<storage, read> factors: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_reference: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.rows * call.channels * plane {
        return;
    }
    let pixel = i % plane;
    let c = i / plane % call.channels;
    let r = i / plane / call.channels;
    var sum = 0.0;
    for (var k = pair_starts[r] * call.candidates; k < pair_starts[r + 1u] * call.candidates; k++) {
        let entry = 4u * (k * plane + pixel);
        for (var j = entry; j < entry + 4u; j++) {
            let cell = cells_of[j];
            if cell != NONE {
                sum += factors[j] * source[(cell / plane * call.channels + c) * plane
                    + cell % plane];
            }
        }
    }
    d_reference[i] = sum;
}
