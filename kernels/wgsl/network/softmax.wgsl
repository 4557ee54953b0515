// Softmax over the last axis. CPU version: cpu/softmax.rs.

@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    place: Place,
) {
    let thread = thread_of(place);
    let row = workgroup_number(workgroup, workgroups);
    let base = min(row, call.rows - 1u) * call.length;
    var own = x[base];
    for (var i = thread; i < call.length; i += THREADS) {
        own = max(own, x[base + i]);
    }
    let most = largest(own, place);
    own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        own += exp(x[base + i] - most);
    }
    let sum = total(own, place);
    if row >= call.rows {
        return;
    }
    for (var i = thread; i < call.length; i += THREADS) {
        y[base + i] = exp(x[base + i] - most) / sum;
    }
}
