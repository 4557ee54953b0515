// Expected candidate of a softmax over candidates, and the mass within `window` of the mode. CPU
// version: src/cpu/small/expectation.rs.

struct ExpectationUniform {
    pictures: u32,
    candidates: u32,
    pixels: u32,
    window: u32,
    // 1: the mean is taken over the window alone.
    window_alone: u32,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

@group(0) @binding(0) var<uniform> call: ExpectationUniform;
// [pictures, candidates, pixels].
@group(0) @binding(1) var<storage, read> logits: array<f32>;
// [2, pictures, pixels].
@group(0) @binding(2) var<storage, read_write> result: array<f32>;

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
    var most = logits[base];
    var mode = 0u;
    for (var k = 1u; k < call.candidates; k++) {
        let x = logits[base + k * call.pixels];
        if x > most {
            most = x;
            mode = k;
        }
    }
    // Sums of weights and of distances from the mode: of all candidates, of the window.
    var all = vec2<f32>();
    var near = vec2<f32>();
    for (var k = 0u; k < call.candidates; k++) {
        let away = i32(k) - i32(mode);
        let weight = exp(logits[base + k * call.pixels] - most);
        let term = weight * vec2<f32>(1.0, f32(away));
        all += term;
        if abs(away) <= i32(call.window) {
            near += term;
        }
    }
    let mean = select(all.y / all.x, near.y / near.x, call.window_alone == 1u);
    result[i] = f32(mode) + mean;
    result[count + i] = near.x / all.x;
}
