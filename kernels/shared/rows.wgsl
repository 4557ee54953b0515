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

// Returns the maximum of `own` over the workgroup.
fn largest(own: f32, thread: u32) -> f32 {
    partial[thread] = own;
    workgroupBarrier();
    for (var half = THREADS / 2u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] = max(partial[thread], partial[thread + half]);
        }
        workgroupBarrier();
    }
    let most = partial[0];
    workgroupBarrier();
    return most;
}
