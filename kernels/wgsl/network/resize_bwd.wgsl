// Gradient of a bilinear resize: each input pixel sums the outputs that read it, in order. CPU version:
// cpu/resize.rs.

@group(0) @binding(1) var<storage, read> dy: array<f32>;
@group(0) @binding(2) var<storage, read_write> dx: array<f32>;

// Returns the first output of `to` that can read index `at` of an axis of `size`, and the end of
// those outputs.
fn readers(at: u32, size: u32, to: u32) -> vec2<u32> {
    if size < 2u || to < 2u {
        return vec2<u32>(0u, to);
    }
    let first = (max(at, 1u) - 1u) * (to - 1u) / (size - 1u);
    let last = (at + 1u) * (to - 1u) / (size - 1u) + 1u;
    return vec2<u32>(first, min(last + 1u, to));
}

// Returns the share of index `at` in a place.
fn share(place: Tap, at: u32) -> f32 {
    return select(0.0, 1.0 - place.share, place.index == at)
        + select(0.0, place.share, place.index + 1u == at);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.planes * call.input_size.x * call.input_size.y {
        return;
    }
    let column = i % call.input_size.y;
    let row = i / call.input_size.y % call.input_size.x;
    let plane = i / (call.input_size.x * call.input_size.y) * call.output_size.x * call.output_size.y;
    let ys = readers(row, call.input_size.x, call.output_size.x);
    let xs = readers(column, call.input_size.y, call.output_size.y);
    var sum = 0.0;
    for (var y = ys.x; y < ys.y; y++) {
        let by_row = share(tap(y, call.input_size.x, call.output_size.x), row);
        if by_row == 0.0 {
            continue;
        }
        for (var x = xs.x; x < xs.y; x++) {
            let by_column = share(tap(x, call.input_size.y, call.output_size.y), column);
            if by_column != 0.0 {
                sum += by_row * by_column * dy[plane + y * call.output_size.y + x];
            }
        }
    }
    dx[i] = sum;
}
