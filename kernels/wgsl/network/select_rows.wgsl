// Chosen indices of the middle axis of [outer, length, inner]. CPU version: tensor operations.

@group(0) @binding(0) var<uniform> call: SelectUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> indices: array<u32>;
// [outer, chosen, inner].
@group(0) @binding(3) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.outer * call.chosen * call.inner {
        return;
    }
    let index = indices[i / call.inner % call.chosen];
    let outer = i / call.inner / call.chosen;
    y[i] = x[(outer * call.length + index) * call.inner + i % call.inner];
}
