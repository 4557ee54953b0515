// Sums of every `parts`-th element of the middle axis of [outer, length, inner]: [outer, parts, inner].
// Repeated calls give the sum over the axis in an order that depends on the sizes alone. CPU version:
// cpu/sums.rs.

@group(0) @binding(0) var<uniform> call: SumPartsUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.outer * call.parts * call.inner {
        return;
    }
    let part = i / call.inner % call.parts;
    let base = i / call.inner / call.parts * call.length * call.inner + i % call.inner;
    var sum = 0.0;
    for (var k = part; k < call.length; k += call.parts) {
        sum += x[base + k * call.inner];
    }
    y[i] = sum;
}
