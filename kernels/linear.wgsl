// Linear layer: y = x W^T + b. CPU version: src/cpu/gemm.rs.
//
// A workgroup computes 64 rows of 64 outputs in steps of 16 terms; a thread 4 x 4 of them.

struct LinearUniform {
    rows: u32,
    outputs: u32,
    terms: u32,
    // 1 if there is a bias.
    has_bias: u32,
}

@group(0) @binding(0) var<uniform> call: LinearUniform;
// [rows, terms].
@group(0) @binding(1) var<storage, read> x: array<f32>;
// [outputs, terms].
@group(0) @binding(2) var<storage, read> weight: array<f32>;
@group(0) @binding(3) var<storage, read> bias: array<f32>;
// [rows, outputs].
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

const SIDE: u32 = 64u;
const STEP: u32 = 16u;

// [STEP, SIDE]: terms of the rows, and of the outputs.
var<workgroup> rows: array<f32, 1024>;
var<workgroup> columns: array<f32, 1024>;

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
    let line = thread / 4u;
    let own_term = thread % 4u * 4u;
    let own_output = thread % 16u * 4u;
    var sums: array<vec4<f32>, 4>;
    for (var first = 0u; first < call.terms; first += STEP) {
        for (var j = 0u; j < 4u; j++) {
            let term = first + own_term + j;
            let in_row = first_row + line < call.rows && term < call.terms;
            let in_column = first_output + line < call.outputs && term < call.terms;
            let row = x[select(0u, (first_row + line) * call.terms + term, in_row)];
            let column =
                weight[select(0u, (first_output + line) * call.terms + term, in_column)];
            rows[(own_term + j) * SIDE + line] = select(0.0, row, in_row);
            columns[(own_term + j) * SIDE + line] = select(0.0, column, in_column);
        }
        workgroupBarrier();
        for (var k = 0u; k < STEP; k++) {
            let r = k * SIDE + thread / 16u * 4u;
            let c = k * SIDE + own_output;
            let factors =
                vec4<f32>(columns[c], columns[c + 1u], columns[c + 2u], columns[c + 3u]);
            for (var i = 0u; i < 4u; i++) {
                sums[i] += rows[r + i] * factors;
            }
        }
        workgroupBarrier();
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
                y[row * call.outputs + output] = sums[i][j] + start;
            }
        }
    }
}
