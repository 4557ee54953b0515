// Raw rows and opacities from the output of the small backbone's heads. CPU version:
// cpu/small/heads.rs.

@group(0) @binding(0) var<uniform> call: HeadOutputUniform;
// [pictures, raw + 1, pixels].
@group(0) @binding(1) var<storage, read> x: array<f32>;
// [pictures, pixels], a logit.
@group(0) @binding(2) var<storage, read> confidence: array<f32>;
// [pictures, 3, pixels].
@group(0) @binding(3) var<storage, read> rgb: array<f32>;
// [raw].
@group(0) @binding(4) var<storage, read> start: array<f32>;
// [pictures, pixels, raw].
@group(0) @binding(5) var<storage, read_write> rows: array<f32>;
// [pictures, pixels].
@group(0) @binding(6) var<storage, read_write> opacity: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.pictures * call.pixels {
        return;
    }
    let picture = i / call.pixels;
    let pixel = i % call.pixels;
    let base = picture * (call.raw + 1u) * call.pixels + pixel;
    for (var c = 0u; c < call.raw; c++) {
        var v = x[base + c * call.pixels] + start[c];
        for (var k = 0u; k < 3u; k++) {
            if call.coloured == 1u && call.places[k] == c {
                v += call.factor * rgb[(picture * 3u + k) * call.pixels + pixel] + call.offset;
            }
        }
        rows[i * call.raw + c] = v;
    }
    let residual = x[base + call.raw * call.pixels];
    if call.confident == 1u {
        let s = sigmoid(confidence[i] + residual);
        opacity[i] = s * s;
    } else {
        opacity[i] = sigmoid(residual + 2.0);
    }
}
