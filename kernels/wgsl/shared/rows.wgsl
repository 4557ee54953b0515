// Rows that one workgroup processes together.

@group(0) @binding(0) var<uniform> call: RowsUniform;
// [rows, length].
@group(0) @binding(1) var<storage, read> x: array<f32>;

const THREADS: u32 = 64u;
