// Convolution over three axes as a matrix product whose second factor is read from the picture:
// outputs x pixels, summed over (channel, z, y, x) of the kernel. CPU version: cpu/conv/mod.rs.
//
// A workgroup computes 64 outputs of 64 pixels in steps of 16 terms; a thread 4 x 4 of them.

// An activation function of the results.
override ACTIVATION_KIND: u32 = 0u;

@group(0) @binding(0) var<uniform> call: ConvolutionUniform;
// [B, channels, input_size].
@group(0) @binding(1) var<storage, read> picture: array<f32>;
// [outputs, terms].
@group(0) @binding(2) var<storage, read> weight: array<f32>;
@group(0) @binding(3) var<storage, read> bias: array<f32>;
// [B, outputs, output_size].
@group(0) @binding(4) var<storage, read_write> result: array<f32>;

// Returns the first sample of a pixel: its place times the stride, minus the padding.
fn corner(pixel: u32) -> vec3<i32> {
    let place = vec3<u32>(
        pixel / (call.output_size.y * call.output_size.z),
        pixel / call.output_size.z % call.output_size.y,
        pixel % call.output_size.z,
    );
    return vec3<i32>(place * call.stride.xyz) - vec3<i32>(call.padding.xyz);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_pixel = workgroup.x * SIDE;
    let first_output = workgroup.y * SIDE;
    let plane = call.input_size.x * call.input_size.y * call.input_size.z;
    let input = workgroup.z * call.channels * plane;
    let volume = call.kernel.x * call.kernel.y * call.kernel.z;
    let area = call.kernel.y * call.kernel.z;
    let size = vec3<i32>(call.input_size.xyz);
    // A thread loads one term of four outputs and of four pixels.
    let own_term = thread / 16u;
    let own_output = first_output + thread % 16u * 4u;
    let own_pixel = thread % 16u * 4u;
    var corners: array<vec3<i32>, 4>;
    for (var j = 0u; j < 4u; j++) {
        corners[j] = corner(min(first_pixel + own_pixel + j, call.pixels - 1u));
    }
    var sums: array<vec4<f32>, 4>;
    for (var first = 0u; first < call.terms; first += STEP) {
        let term = first + own_term;
        var terms: vec4<f32>;
        for (var j = 0u; j < 4u; j++) {
            let inside = own_output + j < call.outputs && term < call.terms;
            let at = select(0u, (own_output + j) * call.terms + term, inside);
            terms[j] = select(0.0, weight[at], inside);
        }
        rows[thread] = terms;
        let channel = term / volume;
        let tap = vec3<i32>(vec3<u32>(
            term % volume / area,
            term % area / call.kernel.z,
            term % call.kernel.z,
        ));
        let base = input + channel * plane;
        var samples: vec4<f32>;
        for (var j = 0u; j < 4u; j++) {
            let at = corners[j] + tap;
            let inside = term < call.terms && all(at >= vec3<i32>()) && all(at < size);
            let offset = u32((at.x * size.y + at.y) * size.z + at.z);
            let sample = picture[select(0u, base + offset, inside)];
            samples[j] = select(0.0, sample, inside);
        }
        columns[thread] = samples;
        add_step(&sums, thread);
    }
    for (var i = 0u; i < 4u; i++) {
        let output = first_output + thread / 16u * 4u + i;
        if output >= call.outputs {
            continue;
        }
        var start = 0.0;
        if call.padding.w == 1u {
            start = bias[output];
        }
        for (var j = 0u; j < 4u; j++) {
            let pixel = first_pixel + own_pixel + j;
            if pixel < call.pixels {
                result[(workgroup.z * call.outputs + output) * call.pixels + pixel] =
                    activation(ACTIVATION_KIND, sums[i][j] + start);
            }
        }
    }
}
