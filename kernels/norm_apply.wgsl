// (x - mean) / sqrt(variance + epsilon), times factor, plus summand, then an activation. CPU
// version: src/cpu/norm.rs.

// [rows, parts].
@group(0) @binding(2) var<storage, read> statistics: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> summands: array<f32>;
@group(0) @binding(5) var<storage, read_write> y: array<f32>;

override ACTIVATION_KIND: u32 = 0u;

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
    // The parts' statistics, joined in order (Chan, Golub and LeVeque 1979).
    var mean = 0.0;
    var squares = 0.0;
    for (var part = 0u; part < call.parts; part++) {
        let own = statistics[row * call.parts + part];
        let before = f32(part * PART);
        let count = f32(min(call.length - part * PART, PART));
        let away = own.x - mean;
        mean += away * (count / (before + count));
        squares += own.y + away * away * (before * count / (before + count));
    }
    let scale = 1.0 / sqrt(squares / f32(call.length) + call.epsilon);
    let first = number % call.parts * PART;
    let count = min(call.length - first, PART);
    let channels = call.length / call.run;
    for (var i = thread; i < count; i += THREADS) {
        let at = first + i;
        var v = (x[row * call.length + at] - mean) * scale;
        if call.has_affine == 1u {
            let channel = row % call.groups * channels + at / call.run;
            v = v * factors[channel] + summands[channel];
        }
        y[row * call.length + at] = activation(ACTIVATION_KIND, v);
    }
}
