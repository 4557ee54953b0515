// One step of Adam or AdamW on all parameters, with clipping and the moving average of the weights.
// CPU version: cpu/adam.rs.

@group(0) @binding(0) var<uniform> call: AdamUniform;
// [count].
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
// [count / 64]: parameter of each block of 64 elements.
@group(0) @binding(2) var<storage, read> owners: array<u32>;
// Of each parameter: learning rate and factor of the root, both with bias correction; factor of the
// values; 1 if the parameter takes the step.
@group(0) @binding(3) var<storage, read> parameters: array<vec4<f32>>;
// [count] each.
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read_write> first: array<f32>;
@group(0) @binding(6) var<storage, read_write> second: array<f32>;
@group(0) @binding(7) var<storage, read_write> averages: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let i = block * 64u + thread;
    if i >= call.count {
        return;
    }
    let parameter = parameters[owners[block]];
    if parameter.w == 0.0 {
        return;
    }
    let g = gradients[i] * call.clip;
    let m = call.first_decay * first[i] + (1.0 - call.first_decay) * g;
    let v = call.second_decay * second[i] + (1.0 - call.second_decay) * g * g;
    let step = parameter.x * m / (sqrt(v) * parameter.y + call.epsilon);
    let value = parameter.z * values[i] - step;
    first[i] = m;
    second[i] = v;
    values[i] = value;
    averages[i] += (1.0 - call.average) * (value - averages[i]);
}
