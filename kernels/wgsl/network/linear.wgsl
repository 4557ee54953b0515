// Linear layer: y = x W^T + b. CPU version: cpu/gemm.rs.
//
// A workgroup computes 64 rows of 64 outputs in steps of 16 terms; a thread 4 x 4 of them.

// An activation function of the results.
override ACTIVATION_KIND: u32 = 0u;

@group(0) @binding(0) var<uniform> call: LinearUniform;
// [rows, terms].
@group(0) @binding(1) var<storage, read> x: array<f32>;
// [outputs, terms].
@group(0) @binding(2) var<storage, read> weight: array<f32>;
@group(0) @binding(3) var<storage, read> bias: array<f32>;
// [rows, outputs].
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let across = (call.outputs + SIDE - 1u) / SIDE;
    let number = workgroup_number(workgroup, workgroups);
    let first_row = number / across * SIDE;
    let first_output = number % across * SIDE;
    if first_row >= call.rows {
        return;
    }
    // A thread loads one term of four rows and of four outputs. The terms of a row lie side by
    // side, so that neighbouring threads read one row.
    let own_term = thread % 16u;
    let line = thread / 16u * 4u;
    let own_output = thread % 16u * 4u;
    var sums: array<vec4<f32>, 4>;
    for (var first = 0u; first < call.terms; first += STEP) {
        let term = first + own_term;
        var row_terms: vec4<f32>;
        var column_terms: vec4<f32>;
        for (var j = 0u; j < 4u; j++) {
            let in_row = first_row + line + j < call.rows && term < call.terms;
            let in_column = first_output + line + j < call.outputs && term < call.terms;
            let row = x[select(0u, (first_row + line + j) * call.terms + term, in_row)];
            let column =
                weight[select(0u, (first_output + line + j) * call.terms + term, in_column)];
            row_terms[j] = select(0.0, row, in_row);
            column_terms[j] = select(0.0, column, in_column);
        }
        rows[own_term * SIDE / 4u + line / 4u] = row_terms;
        columns[own_term * SIDE / 4u + line / 4u] = column_terms;
        add_step(&sums, thread);
    }
    for (var j = 0u; j < 4u; j++) {
        let output = first_output + own_output + j;
        if output >= call.outputs {
            continue;
        }
        var start = 0.0;
        if call.has_bias == 1u {
            start = bias[output];
        }
        for (var i = 0u; i < 4u; i++) {
            let row = first_row + thread / 16u * 4u + i;
            if row < call.rows {
                y[row * call.outputs + output] =
                    activation(ACTIVATION_KIND, sums[i][j] + start);
            }
        }
    }
}
