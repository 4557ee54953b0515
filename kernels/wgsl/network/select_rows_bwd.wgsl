// Gradient of chosen indices of the middle axis of [outer, length, inner]: each index sums the places
// that chose it, in order. CPU version: tensor operations.

@group(0) @binding(0) var<uniform> call: SelectUniform;
// [outer, chosen, inner].
@group(0) @binding(1) var<storage, read> dy: array<f32>;
// Begin of the places of each index, and the end: [length + 1]; then the places: [chosen].
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read_write> dx: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.outer * call.length * call.inner {
        return;
    }
    let index = i / call.inner % call.length;
    let outer = i / call.inner / call.length;
    var sum = 0.0;
    for (var k = places[index]; k < places[index + 1u]; k++) {
        let place = places[call.length + 1u + k];
        sum += dy[(outer * call.chosen + place) * call.inner + i % call.inner];
    }
    dx[i] = sum;
}
