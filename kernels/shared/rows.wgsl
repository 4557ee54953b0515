// Rows that one workgroup processes together.

struct RowsUniform {
    rows: u32,
    length: u32,
    epsilon: f32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> call: RowsUniform;
// [rows, length].
@group(0) @binding(1) var<storage, read> x: array<f32>;

const THREADS: u32 = 64u;
