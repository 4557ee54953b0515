// (x - mean) / sqrt(variance + epsilon), times factor, plus summand, then an activation, then plus a
// residual of the same sizes. CPU version: cpu/norm.rs and a sum.

@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> summands: array<f32>;
@group(0) @binding(5) var<storage, read> residual: array<f32>;
@group(0) @binding(6) var<storage, read_write> y: array<f32>;

override ACTIVATION_KIND: u32 = 0u;
// 1 if there is a residual.
override HAS_RESIDUAL: u32 = 0u;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let row = number / call.parts;
    if row >= call.rows {
        return;
    }
    let own = mean_and_scale(row);
    let first = number % call.parts * PART;
    let count = min(call.length - first, PART);
    let channels = call.length / call.run;
    for (var i = thread; i < count; i += THREADS) {
        let at = first + i;
        var v = (x[row * call.length + at] - own.x) * own.y;
        if call.has_affine == 1u {
            let channel = row % call.groups * channels + at / call.run;
            v = v * factors[channel] + summands[channel];
        }
        v = activation(ACTIVATION_KIND, v);
        if HAS_RESIDUAL == 1u {
            v += residual[row * call.length + at];
        }
        y[row * call.length + at] = v;
    }
}
