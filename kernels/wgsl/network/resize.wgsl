// Bilinear resize, corner pixels on corner pixels, then an activation. CPU version:
// cpu/resize.rs.

override ACTIVATION_KIND: u32 = 0u;

@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.planes * call.output_size.x * call.output_size.y {
        return;
    }
    let row = tap(i / call.output_size.y % call.output_size.x, call.input_size.x, call.output_size.x);
    let column = tap(i % call.output_size.y, call.input_size.y, call.output_size.y);
    let plane = i / (call.output_size.x * call.output_size.y) * call.input_size.x * call.input_size.y;
    let top = plane + row.index * call.input_size.y;
    let bottom = top + select(0u, call.input_size.y, call.input_size.x > 1u);
    let left = column.index;
    let right = left + select(0u, 1u, call.input_size.y > 1u);
    let above = mix(x[top + left], x[top + right], column.share);
    let below = mix(x[bottom + left], x[bottom + right], column.share);
    y[i] = activation(ACTIVATION_KIND, mix(above, below, row.share));
}
