// A thread of a workgroup, and reductions over the workgroup without subgroups. The same functions with
// subgroups: place_subgroups.wgsl.

struct Place {
    @builtin(local_invocation_index) thread: u32,
}

// Returns the number of a thread, below THREADS.
fn thread_of(place: Place) -> u32 {
    return place.thread;
}

// Returns the sum of `own` over the workgroup.
fn total(own: f32, place: Place) -> f32 {
    return total_in_memory(own, place.thread);
}

// Returns the maximum of `own` over the workgroup.
fn largest(own: f32, place: Place) -> f32 {
    return largest_in_memory(own, place.thread);
}
