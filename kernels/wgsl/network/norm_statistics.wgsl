// Mean and sum of squared deviations of each part of a row. CPU version: cpu/norm.rs.

// [rows, parts].
@group(0) @binding(2) var<storage, read_write> statistics: array<vec2<f32>>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    place: Place,
) {
    let thread = thread_of(place);
    let number = workgroup_number(workgroup, workgroups);
    let row = min(number / call.parts, call.rows - 1u);
    let first = number % call.parts * PART;
    let count = min(call.length - first, PART);
    let base = row * call.length + first;
    var own = 0.0;
    for (var i = thread; i < count; i += THREADS) {
        own += x[base + i];
    }
    let mean = total(own, place) / f32(count);
    own = 0.0;
    for (var i = thread; i < count; i += THREADS) {
        let away = x[base + i] - mean;
        own += away * away;
    }
    let squares = total(own, place);
    if thread == 0u && number < call.rows * call.parts {
        statistics[number] = vec2<f32>(mean, squares);
    }
}
