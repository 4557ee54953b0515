// Gradient [S, C, h, w] of the source of the plane sweep, from the taps of plane_sweep_taps and
// the lists of invert. Taps are summed in order of pair, candidate and pixel. CPU version:
// cpu/plane_sweep/backward.rs. One thread per element.

@group(0) @binding(1) var<storage, read> reference: array<f32>;
@group(0) @binding(2) var<storage, read> pair_starts: array<u32>;
@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> starts: array<u32>;
@group(0) @binding(5) var<storage, read> list: array<u32>;
@group(0) @binding(6) var<storage, read_write> d_source: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.sources * call.channels * plane {
        return;
    }
    let c = i / plane % call.channels;
    let cell = i / plane / call.channels * plane + i % plane;
    var sum = 0.0;
    for (var e = starts[cell]; e < starts[cell + 1u]; e++) {
        let entry = list[e];
        let tap = entry / 4u;
        let r = row_of(tap / plane / call.candidates);
        sum += factors[entry] * reference[(r * call.channels + c) * plane + tap % plane];
    }
    d_source[i] = sum;
}
