// Sum over the THREADS threads of a workgroup, in an order that depends on their number alone.

var<workgroup> partial: array<f32, THREADS>;

// Returns the sum of `own` over the workgroup.
fn total(own: f32, thread: u32) -> f32 {
    partial[thread] = own;
    workgroupBarrier();
    for (var half = THREADS / 2u; half > 0u; half /= 2u) {
        if thread < half {
            partial[thread] += partial[thread + half];
        }
        workgroupBarrier();
    }
    let sum = partial[0];
    workgroupBarrier();
    return sum;
}
