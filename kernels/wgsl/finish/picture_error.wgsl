// Sums over pixels of the differences between a picture and its truth: w·d², w, and (w·d)², w the weight
// of a pixel and d² the sum over the channels. CPU version: the errors of `Target` in the optimiser of
// the crate subsplat.
//
// Input: picture and truth as in wgsl/shared/loss.wgsl. Output: sums [workgroups, 4], the last one unused.
// One workgroup for 1,024 pixels.

@group(0) @binding(0) var<uniform> call: LossUniform;
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4<f32>>;

const THREADS: u32 = 256u;
// Pixels of a thread.
const PIXELS: u32 = 4u;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let first = number * THREADS * PIXELS;
    let past = min(first + THREADS * PIXELS, call.width * call.height);
    var weighted = 0.0;
    var weights = 0.0;
    var squares = 0.0;
    for (var p = first + thread; p < past; p += THREADS) {
        let target_pixel = truth_of(p);
        let d = picture_of(p) - target_pixel.xyz;
        let weight = weight_of(p, target_pixel.w);
        // A picture that is not finite counts nowhere that has no weight.
        if weight > 0.0 {
            weighted += weight * dot(d, d);
            squares += weight * weight * dot(d, d);
        }
        weights += weight;
    }
    let all = vec3<f32>(
        total_in_memory(weighted, thread),
        total_in_memory(weights, thread),
        total_in_memory(squares, thread),
    );
    if thread == 0u {
        sums[number] = vec4<f32>(all, 0.0);
    }
}
