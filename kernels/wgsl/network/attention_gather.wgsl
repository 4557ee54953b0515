// Attention of parents over bilinear samples of the views' feature maps (SubSplat, supplement
// A.2). CPU version: cpu/attention_gather/mod.rs. Arguments except the last:
// wgsl/shared/gather_samples.wgsl.
//
// Output: [N, E], plus a residual of the same sizes. One workgroup per parent; its threads process the samples, then the weights,
// then the channels. Only the output leaves workgroup memory.

@group(0) @binding(5) var<storage, read> residual: array<f32>;
@group(0) @binding(6) var<storage, read_write> attended: array<f32>;

// 1 if there is a residual.
override HAS_RESIDUAL: u32 = 0u;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = workgroup_number(workgroup, workgroups);
    if n >= call.parents {
        return;
    }
    attention_weights(n, thread);
    workgroupBarrier();
    let samples = sample_count();
    for (var i = thread; i < samples * call.groups; i += GATHER_THREADS) {
        weights[i] *= gate(n, i / call.groups) * dropout_factor(n, i);
    }
    workgroupBarrier();
    let group_dim = call.dim / call.groups;
    for (var c = thread; c < call.dim; c += GATHER_THREADS) {
        var sum = 0.0;
        for (var j = 0u; j < samples; j++) {
            if states[j] == SAMPLED {
                let row = cells[j] * call.stride + call.value + c;
                let u = vec4<f32>(maps[row.x], maps[row.y], maps[row.z], maps[row.w]);
                sum += weights[j * call.groups + c / group_dim] * dot(corners[j], u);
            }
        }
        if HAS_RESIDUAL == 1u {
            sum += residual[n * call.dim + c];
        }
        attended[n * call.dim + c] = sum;
    }
}
