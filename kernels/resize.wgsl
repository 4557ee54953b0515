// Bilinear resize, corner pixels on corner pixels, then an activation. CPU version:
// src/cpu/resize.rs.

struct ResizeUniform {
    // Height and width.
    input_size: vec2<u32>,
    output_size: vec2<u32>,
    planes: u32,
    pad: u32,
}

override ACTIVATION_KIND: u32 = 0u;

@group(0) @binding(0) var<uniform> call: ResizeUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

// A place on an axis: the index before it, and the share of the next.
struct Tap {
    index: u32,
    share: f32,
}

// Returns the place of output i of `to` on an axis of `size`.
fn tap(i: u32, size: u32, to: u32) -> Tap {
    if size < 2u || to < 2u {
        return Tap(0u, 0.0);
    }
    let place = i * (size - 1u);
    let index = min(place / (to - 1u), size - 2u);
    return Tap(index, f32(place - index * (to - 1u)) / f32(to - 1u));
}

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
