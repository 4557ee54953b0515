// Expected candidate of a softmax over candidates, and the mass within `window` of the mode. CPU
// version: cpu/small/expectation.rs.

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
    let own = mode_of(base);
    let mean = select(own.all.y / own.all.x, own.near.y / own.near.x, call.window_alone == 1u);
    result[i] = f32(own.candidate) + mean;
    result[count + i] = own.near.x / own.all.x;
}
