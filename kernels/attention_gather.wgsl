// Attention of parents over bilinear samples of the views' feature maps (SubSplat A.2):
// twin of src/cpu/attention_gather. Arguments but the last: kernels/shared/gather_samples.wgsl.
//
// Out: [N, E].   One workgroup per parent: threads are samples, then weights, then
// channels; nothing of it leaves workgroup memory but the output.

@group(0) @binding(5) var<storage, read_write> attended: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let n = workgroup_number(workgroup, workgroups);
    if n >= call.parents {
        return;
    }
    attend(n, lane);
    workgroupBarrier();
    let samples = sample_count();
    for (var i = lane; i < samples * call.groups; i += GATHER_THREADS) {
        weights[i] *= gate(n, i / call.groups) * kept(n, i);
    }
    workgroupBarrier();
    let wide = call.dim / call.groups;
    for (var c = lane; c < call.dim; c += GATHER_THREADS) {
        var sum = 0.0;
        for (var j = 0u; j < samples; j++) {
            if states[j] == LIVE {
                let row = cells[j] * call.stride + call.value + c;
                let u = vec4<f32>(maps[row.x], maps[row.y], maps[row.z], maps[row.w]);
                sum += weights[j * call.groups + c / wide] * dot(corners[j], u);
            }
        }
        attended[n * call.dim + c] = sum;
    }
}
