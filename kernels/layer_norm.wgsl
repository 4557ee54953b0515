// LayerNorm over the last axis. CPU version: src/cpu/norm.rs.

@group(0) @binding(2) var<storage, read> factors: array<f32>;
@group(0) @binding(3) var<storage, read> summands: array<f32>;
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    place: Place,
) {
    let thread = thread_of(place);
    let row = workgroup_number(workgroup, workgroups);
    let base = min(row, call.rows - 1u) * call.length;
    var own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        own += x[base + i];
    }
    let mean = total(own, place) / f32(call.length);
    own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        let away = x[base + i] - mean;
        own += away * away;
    }
    let scale = 1.0 / sqrt(total(own, place) / f32(call.length) + call.epsilon);
    if row >= call.rows {
        return;
    }
    for (var i = thread; i < call.length; i += THREADS) {
        y[base + i] = (x[base + i] - mean) * scale * factors[i] + summands[i];
    }
}
