// Gradient of the colour gains with respect to the head records [M, 11], M = N·K: element
// HEAD_GAIN_OFFSET; the others are 0. CPU version: cpu/spgr/backward.rs (gains). One thread per
// record.

@group(0) @binding(0) var<uniform> call: SpgrGainsBwdUniform;
@group(0) @binding(1) var<storage, read> head: array<f32>;
@group(0) @binding(2) var<storage, read> grad: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_head: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.records {
        return;
    }
    var d = grad[i * call.lanes];
    for (var k = 1u; k < call.lanes; k++) {
        d += 0.5 * grad[i * call.lanes + k];
    }
    let t = tanh_of(head[i * HEAD_STRIDE + HEAD_GAIN_OFFSET]);
    for (var k = 0u; k < HEAD_STRIDE; k++) {
        d_head[i * HEAD_STRIDE + k] = select(0.0, d * call.delta * (1.0 - t * t), k == HEAD_GAIN_OFFSET);
    }
}
