// LayerNorm over the last axis, of a sum or before a sum with an array of the same sizes. CPU version:
// cpu/norm.rs and a sum.

@group(0) @binding(2) var<storage, read> factors: array<f32>;
@group(0) @binding(3) var<storage, read> summands: array<f32>;
@group(0) @binding(4) var<storage, read> other: array<f32>;
@group(0) @binding(5) var<storage, read_write> y: array<f32>;

// Place of the sum with the other array; 0: none.
const SUM_BEFORE: u32 = 1u;
const SUM_AFTER: u32 = 2u;
override SUM: u32 = 0u;

fn value(at: u32) -> f32 {
    if SUM == SUM_BEFORE {
        return x[at] + other[at];
    }
    return x[at];
}

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
        own += value(base + i);
    }
    let mean = total(own, place) / f32(call.length);
    own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        let away = value(base + i) - mean;
        own += away * away;
    }
    let scale = 1.0 / sqrt(total(own, place) / f32(call.length) + call.epsilon);
    if row >= call.rows {
        return;
    }
    for (var i = thread; i < call.length; i += THREADS) {
        var v = (value(base + i) - mean) * scale * factors[i] + summands[i];
        if SUM == SUM_AFTER {
            v += other[base + i];
        }
        y[base + i] = v;
    }
}
