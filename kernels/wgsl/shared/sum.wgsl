// Sum and maximum over the THREADS threads of a workgroup, in workgroup memory: the path without
// subgroups. Threads t and t + 1 are added first, then pairs of them, and so on: an order that depends
// on THREADS alone. wgsl/shared/place_subgroups.wgsl has the same order.

var<workgroup> partial: array<f32, THREADS>;

// Returns the element of `partial` that a thread writes. With the bits of its number reversed,
// neighbours lie in different halves of the array, and the threads that add are neighbours.
fn slot_of(thread: u32) -> u32 {
    return reverseBits(thread) >> countLeadingZeros(THREADS - 1u);
}

// Returns the sum of `own` over the workgroup.
fn total_in_memory(own: f32, thread: u32) -> f32 {
    partial[slot_of(thread)] = own;
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

// Returns the maximum of `own` over the workgroup.
fn largest_in_memory(own: f32, thread: u32) -> f32 {
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
