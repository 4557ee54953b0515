// Scores of windows of blocks: normalised cross-correlation at half and at quarter resolution,
// colour, share of valid samples. CPU version: cpu/matching.rs.

// [rows, candidates, PLANES, height, width].
@group(0) @binding(1) var<storage, read> sums: array<f32>;
// [rows, 4, candidates, height, width].
@group(0) @binding(2) var<storage, read_write> result: array<f32>;

// Returns the score of the window of (2 radius + 1)^2 blocks around a pixel, and the share of its
// `full` samples that are valid. `base` is the first plane's pixel 0.
fn score(base: u32, pixel: vec2<u32>, radius: u32, full: f32) -> vec2<f32> {
    let plane = call.height * call.width;
    let size = vec2<u32>(call.width, call.height);
    let low = max(pixel, vec2<u32>(radius)) - radius;
    let high = min(pixel + radius + 1u, size);
    var left: vec4<f32>;
    var right: vec2<f32>;
    for (var y = low.y; y < high.y; y++) {
        for (var x = low.x; x < high.x; x++) {
            let at = base + y * call.width + x;
            left += vec4<f32>(
                sums[at],
                sums[at + plane],
                sums[at + 2u * plane],
                sums[at + 3u * plane],
            );
            right += vec2<f32>(sums[at + 4u * plane], sums[at + 5u * plane]);
        }
    }
    let inverse = 1.0 / max(left.x, 1.0);
    let a = left.y * inverse;
    let b = left.z * inverse;
    let variance_a = max(left.w * inverse - a * a, 0.0) + call.variance_floor;
    let variance_b = max(right.x * inverse - b * b, 0.0) + call.variance_floor;
    let value = (right.y * inverse - a * b) / sqrt(variance_a * variance_b);
    return vec2<f32>(select(value, 0.0, left.x < 0.5 * full), left.x / full);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.rows * call.candidates * plane {
        return;
    }
    let pixel = vec2<u32>(i % call.width, i % plane / call.width);
    let base = i / plane * PLANES * plane;
    let fine = score(base, pixel, 1u, 36.0);
    let coarse = score(base + 6u * plane, pixel, 2u, 25.0);
    let row = i / plane / call.candidates;
    let volume = call.candidates * plane;
    let at = row * 4u * volume + i % volume;
    result[at] = fine.x;
    result[at + volume] = sums[base + COLOUR_PLANE * plane + i % plane];
    result[at + 2u * volume] = coarse.x;
    result[at + 3u * volume] = coarse.y;
}
