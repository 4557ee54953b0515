// Gradient of a convolution's weight: dW = sum of dy times samples of the picture over pictures and
// pixels, divided into parts of the pixels, which a later pass adds in order. CPU version: cpu/conv/mod.rs.
//
// A workgroup computes 64 outputs of 64 terms of one part in steps of 16 pixels; a thread 4 x 4 of
// them.

@group(0) @binding(0) var<uniform> call: ConvolutionUniform;
// [B, channels, input_size].
@group(0) @binding(1) var<storage, read> picture: array<f32>;
// [B, outputs, output_size].
@group(0) @binding(2) var<storage, read> dy: array<f32>;
// [B, parts, outputs, terms].
@group(0) @binding(3) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_term = workgroup.x * SIDE;
    let first_output = workgroup.y * SIDE;
    let b = workgroup.z / call.output_size.w;
    let begin = workgroup.z % call.output_size.w * call.kernel.w;
    let end = min(begin + call.kernel.w, call.pixels);
    let plane = call.input_size.x * call.input_size.y * call.input_size.z;
    let volume = call.kernel.x * call.kernel.y * call.kernel.z;
    let area = call.kernel.y * call.kernel.z;
    let size = vec3<i32>(call.input_size.xyz);
    // A thread loads one pixel of four outputs and of four terms. Neighbouring threads read
    // neighbouring pixels.
    let own_pixel = thread % 16u;
    let line = thread / 16u * 4u;
    var bases: array<u32, 4>;
    var taps: array<vec3<i32>, 4>;
    for (var j = 0u; j < 4u; j++) {
        let term = min(first_term + line + j, call.terms - 1u);
        bases[j] = (b * call.channels + term / volume) * plane;
        taps[j] = vec3<i32>(vec3<u32>(
            term % volume / area,
            term % area / call.kernel.z,
            term % call.kernel.z,
        )) - vec3<i32>(call.padding.xyz);
    }
    var sums: array<vec4<f32>, 4>;
    for (var first = begin; first < end; first += STEP) {
        let pixel = first + own_pixel;
        let place = vec3<u32>(
            pixel / (call.output_size.y * call.output_size.z),
            pixel / call.output_size.z % call.output_size.y,
            pixel % call.output_size.z,
        );
        let corner = vec3<i32>(place * call.stride.xyz);
        var outputs: vec4<f32>;
        var samples: vec4<f32>;
        for (var j = 0u; j < 4u; j++) {
            let output = first_output + line + j;
            let has_output = pixel < end && output < call.outputs;
            let place_of_dy = (b * call.outputs + output) * call.pixels + pixel;
            outputs[j] = select(0.0, dy[select(0u, place_of_dy, has_output)], has_output);
            let at = corner + taps[j];
            let inside = pixel < end && first_term + line + j < call.terms
                && all(at >= vec3<i32>()) && all(at < size);
            let offset = u32((at.x * size.y + at.y) * size.z + at.z);
            samples[j] = select(0.0, picture[select(0u, bases[j] + offset, inside)], inside);
        }
        rows[own_pixel * SIDE / 4u + line / 4u] = outputs;
        columns[own_pixel * SIDE / 4u + line / 4u] = samples;
        add_step(&sums, thread);
    }
    for (var i = 0u; i < 4u; i++) {
        let output = first_output + thread / 16u * 4u + i;
        for (var j = 0u; j < 4u; j++) {
            let term = first_term + thread % 16u * 4u + j;
            if output < call.outputs && term < call.terms {
                result[(workgroup.z * call.outputs + output) * call.terms + term] = sums[i][j];
            }
        }
    }
}
