// A thread of a workgroup, and reductions over the workgroup with subgroups. The same functions without:
// place.wgsl. Both add in the same order, so that their bytes are the same for subgroups of every size.

struct Place {
    @builtin(local_invocation_index) thread: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(num_subgroups) subgroups: u32,
}

// Returns whether all lanes of all subgroups are threads of the workgroup. A driver may leave lanes
// without a thread; reductions then use workgroup memory.
fn is_full(place: Place) -> bool {
    return place.size * place.subgroups == THREADS;
}

// Returns the number of a thread, below THREADS. Lanes of a subgroup have consecutive numbers, which
// local_invocation_index does not promise.
fn thread_of(place: Place) -> u32 {
    return select(place.thread, place.subgroup * place.size + place.lane, is_full(place));
}

// Returns `value` of subgroup `thread` % count. It is the same in all lanes of a subgroup.
fn exchanged(value: f32, count: u32, place: Place) -> f32 {
    if place.lane == 0u && place.subgroup < count {
        partial[place.subgroup] = value;
    }
    workgroupBarrier();
    let other = partial[thread_of(place) % count];
    workgroupBarrier();
    return other;
}

// Returns the sum of `own` over the workgroup.
fn total(own: f32, place: Place) -> f32 {
    if !is_full(place) {
        return total_in_memory(own, place.thread);
    }
    var sum = own;
    for (var count = THREADS; count > 1u; ) {
        let width = min(place.size, count);
        for (var away = 1u; away < width; away *= 2u) {
            sum += subgroupShuffleXor(sum, away);
        }
        count /= width;
        if count > 1u {
            sum = exchanged(sum, count, place);
        }
    }
    return sum;
}

// Returns the maximum of `own` over the workgroup.
fn largest(own: f32, place: Place) -> f32 {
    if !is_full(place) {
        return largest_in_memory(own, place.thread);
    }
    var most = own;
    for (var count = THREADS; count > 1u; ) {
        most = subgroupMax(most);
        count /= min(place.size, count);
        if count > 1u {
            most = exchanged(most, count, place);
        }
    }
    return most;
}
