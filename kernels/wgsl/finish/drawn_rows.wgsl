// Rows of the Gaussians that a step draws: those that it leaves out, and those beyond a range, have
// opacity 0; the others are denser by the share that is left out. CPU version: `Dropout::draw` in the
// optimiser of the crate subsplat; a range is a part of the slice there.
//
// Input: rows [N, 11]. Output: drawn [N, 11]. One thread per Gaussian.

@group(0) @binding(0) var<uniform> call: OptimiseUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read_write> drawn: array<f32>;

fn is_drawn(i: u32) -> bool {
    let inside = i >= call.first && i < call.past;
    if (call.range == RANGE_INSIDE && !inside) || (call.range == RANGE_OUTSIDE && inside) {
        return false;
    }
    return call.denser == 0.0 || !is_left_out(i);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.count {
        return;
    }
    let row = i * SPLAT_STRIDE;
    for (var k = 0u; k < SPLAT_STRIDE; k++) {
        drawn[row + k] = rows[row + k];
    }
    let at = row + OPACITY_OFFSET;
    if !is_drawn(i) {
        drawn[at] = 0.0;
    } else if call.denser > 0.0 {
        drawn[at] = 1.0 - pow(1.0 - rows[at], call.denser);
    }
}
