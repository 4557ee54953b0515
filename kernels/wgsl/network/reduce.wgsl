// Sum, mean or maximum over the middle axis of [outer, length, inner]. CPU version: tensor
// operations.

const SUM: u32 = 0u;
const MAXIMUM: u32 = 1u;

override FUNCTION: u32 = 0u;

@group(0) @binding(0) var<uniform> call: ReduceUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.outer * call.inner {
        return;
    }
    let base = i / call.inner * call.length * call.inner + i % call.inner;
    var result = x[base];
    for (var k = 1u; k < call.length; k++) {
        let v = x[base + k * call.inner];
        if FUNCTION == MAXIMUM {
            result = max(result, v);
        } else {
            result += v;
        }
    }
    y[i] = result * call.factor;
}
