// Gradient of a linear layer's weight: dW = dy^T x, divided into parts of the rows, which a later pass
// adds in order. CPU version: cpu/gemm.rs.
//
// A workgroup computes 64 outputs of 64 terms of one part in steps of 16 rows; a thread 4 x 4 of them.

@group(0) @binding(0) var<uniform> call: LinearWeightBwdUniform;
// [rows, outputs].
@group(0) @binding(1) var<storage, read> dy: array<f32>;
// [rows, terms].
@group(0) @binding(2) var<storage, read> x: array<f32>;
// [parts, outputs, terms].
@group(0) @binding(3) var<storage, read_write> result: array<f32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_term = workgroup.x * SIDE;
    let first_output = workgroup.y * SIDE;
    let begin = workgroup.z * call.part;
    let end = min(begin + call.part, call.rows);
    // A thread loads one row of four outputs and of four terms.
    let own_row = thread / 16u;
    let line = thread % 16u * 4u;
    var sums: array<vec4<f32>, 4>;
    for (var first = begin; first < end; first += STEP) {
        let row = first + own_row;
        var outputs: vec4<f32>;
        var terms: vec4<f32>;
        for (var j = 0u; j < 4u; j++) {
            let output = first_output + line + j;
            let term = first_term + line + j;
            let has_output = row < end && output < call.outputs;
            let has_term = row < end && term < call.terms;
            outputs[j] = select(0.0, dy[select(0u, row * call.outputs + output, has_output)], has_output);
            terms[j] = select(0.0, x[select(0u, row * call.terms + term, has_term)], has_term);
        }
        rows[thread] = outputs;
        columns[thread] = terms;
        add_step(&sums, thread);
    }
    for (var i = 0u; i < 4u; i++) {
        let output = first_output + thread / 16u * 4u + i;
        for (var j = 0u; j < 4u; j++) {
            let term = first_term + line + j;
            if output < call.outputs && term < call.terms {
                result[(workgroup.z * call.outputs + output) * call.terms + term] = sums[i][j];
            }
        }
    }
}
