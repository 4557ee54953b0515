// Gradient of the logits of expectation.wgsl. The mode is a constant. CPU version:
// cpu/small/expectation.rs.

// [2, pictures, pixels]: gradients of mean and mass.
@group(0) @binding(2) var<storage, read> dy: array<f32>;
// [pictures, candidates, pixels].
@group(0) @binding(3) var<storage, read_write> dx: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let count = call.pictures * call.pixels;
    if i >= count {
        return;
    }
    let base = i / call.pixels * call.candidates * call.pixels + i % call.pixels;
    let own = mode_of(base);
    let mass = own.near.x / own.all.x;
    let mean = select(own.all.y / own.all.x, own.near.y / own.near.x, call.window_alone == 1u);
    for (var k = 0u; k < call.candidates; k++) {
        let away = i32(k) - i32(own.candidate);
        let inside = select(0.0, 1.0, abs(away) <= i32(call.window));
        let probability = exp(logits[base + k * call.pixels] - own.most) / own.all.x;
        var of_mean = f32(away) - mean;
        if call.window_alone == 1u {
            of_mean *= inside / mass;
        }
        dx[base + k * call.pixels] = probability * (of_mean * dy[i] + (inside - mass) * dy[count + i]);
    }
}
