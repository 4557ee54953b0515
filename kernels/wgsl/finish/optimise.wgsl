// Adam's step of the parameters of Gaussians, and the numbers that follow from them. CPU version:
// cpu/adam.rs (SelectiveAdam), cpu/parameters.rs (write).
//
// Input: gradient [E, N]; origin as in wgsl/finish/parameter_gradients.wgsl; status: not 0 where the step
// must change nothing (wgsl/finish/watch_pairs.wgsl). Changed: values [E, N], moments [2, E, N]; rows
// [N, 11], gain [N, 4], SH sets [N, D, 3]. The state of a Gaussian without a gradient stays as it is,
// unless all move. One thread per Gaussian.

@group(0) @binding(0) var<uniform> call: OptimiseUniform;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> gradient: array<f32>;
@group(0) @binding(3) var<storage, read> origin: array<f32>;
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read_write> moments: array<f32>;
@group(0) @binding(6) var<storage, read_write> rows: array<f32>;
@group(0) @binding(7) var<storage, read_write> gain: array<f32>;
@group(0) @binding(8) var<storage, read_write> sh: array<f32>;

fn has_gradient(i: u32) -> bool {
    for (var e = 0u; e < call.elements; e++) {
        if gradient[e * call.count + i] != 0.0 {
            return true;
        }
    }
    return false;
}

// Takes the step of element `at` of the state; returns its new value.
fn advance(at: u32, rate: vec4<f32>) -> f32 {
    let g = gradient[at];
    let second_at = call.elements * call.count + at;
    let m = call.first_decay * moments[at] + (1.0 - call.first_decay) * g;
    let v = call.second_decay * moments[second_at] + (1.0 - call.second_decay) * g * g;
    moments[at] = m;
    moments[second_at] = v;
    let root = sqrt(v / call.second_correction) + call.epsilon;
    let value = clamp(values[at] - rate.x * (m / call.first_correction) / root, rate.y, rate.z);
    values[at] = value;
    return value;
}

fn write(buffer: u32, i: u32, number: u32, value: f32) {
    switch buffer {
        case BUFFER_GAIN: { gain[4u * i + number] = value; }
        case BUFFER_SH: { sh[i * call.sh_stride + number] = value; }
        default: { rows[i * SPLAT_STRIDE + number] = value; }
    }
}

// Writes the numbers of a parameter: buffer, first number, form, plane of its numbers before the phase.
fn write_all(parameter: vec4<u32>, i: u32, value: vec4<f32>) {
    let first = parameter.w * call.count + i;
    let form = parameter.z;
    if form == FORM_LOGIT {
        write(parameter.x, i, parameter.y, 1.0 / (1.0 + exp(-value.x)));
        return;
    }
    var before = vec4<f32>(0.0);
    let numbers = select(3u, 4u, form == FORM_DIRECTION);
    for (var k = 0u; k < numbers; k++) {
        before[k] = origin[first + k * call.count];
    }
    var after = before + value;
    if form == FORM_FACTOR {
        after = before * (call.scale * exp(value));
    } else if form == FORM_COMMON_FACTOR {
        after = before * (call.scale * exp(value.x));
    } else if form == FORM_PIXEL_OFFSET {
        after = before + origin[i] * value;
    } else if form == FORM_DIRECTION {
        let norm = sqrt(dot(after, after));
        // A quaternion of zero has no direction: the last one stays.
        if !(norm > 0.0) {
            return;
        }
        after /= norm;
    }
    for (var k = 0u; k < numbers; k++) {
        write(parameter.x, i, parameter.y + k, after[k]);
    }
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.count || status[0] != 0u {
        return;
    }
    if call.all_move == 0u && !has_gradient(i) {
        return;
    }
    var at = i;
    for (var m = 0u; m < call.moves; m++) {
        let parameter = call.parameters[m];
        var value = vec4<f32>(0.0);
        for (var e = 0u; e < elements_of(parameter.z); e++) {
            value[e] = advance(at, call.rates[m]);
            at += call.count;
        }
        write_all(parameter, i, value);
    }
}
