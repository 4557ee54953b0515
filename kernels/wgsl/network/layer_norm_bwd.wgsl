// Gradient of LayerNorm over the last axis, and dy times the normalised number, whose sums over the
// rows are the factors' gradient. CPU version: cpu/norm.rs.

@group(0) @binding(2) var<storage, read> factors: array<f32>;
@group(0) @binding(3) var<storage, read> dy: array<f32>;
@group(0) @binding(4) var<storage, read_write> dx: array<f32>;
// [rows, length].
@group(0) @binding(5) var<storage, read_write> products: array<f32>;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    place: Place,
) {
    let thread = thread_of(place);
    let row = workgroup_number(workgroup, workgroups);
    let base = min(row, call.rows - 1u) * call.length;
    let length = f32(call.length);
    var own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        own += x[base + i];
    }
    let mean = total(own, place) / length;
    own = 0.0;
    for (var i = thread; i < call.length; i += THREADS) {
        let away = x[base + i] - mean;
        own += away * away;
    }
    let scale = 1.0 / sqrt(total(own, place) / length + call.epsilon);
    var sums = vec2<f32>();
    for (var i = thread; i < call.length; i += THREADS) {
        let d = dy[base + i] * factors[i];
        sums += vec2<f32>(d, d * (x[base + i] - mean) * scale);
    }
    let of_mean = total(sums.x, place) / length;
    let of_scale = total(sums.y, place) / length;
    if row >= call.rows {
        return;
    }
    for (var i = thread; i < call.length; i += THREADS) {
        let v = (x[base + i] - mean) * scale;
        dx[base + i] = scale * (dy[base + i] * factors[i] - of_mean - v * of_scale);
        products[base + i] = dy[base + i] * v;
    }
}
