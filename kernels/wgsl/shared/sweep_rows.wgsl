// Returns the reference row of a pair of the plane sweep.

fn row_of(pair: u32) -> u32 {
    var r = 0u;
    while pair_starts[r + 1u] <= pair {
        r++;
    }
    return r;
}
