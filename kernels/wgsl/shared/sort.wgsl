// One digit of a stable radix sort: 4 bits, blocks of GPU_BLOCK elements, 8 consecutive elements
// per thread. Counting, prefix sum and scatter are separate dispatches, because WebGPU guarantees
// no progress between workgroups. The order is that of cpu/raster/sort.rs.

// Row r, 256 threads: counts of digit r (low half) and of digit r + 8 (high half) among a
// thread's elements. The total is at most 2048, so sums of packed halves do not carry.
var<workgroup> sort_table: array<u32, 2048>;
// Sums over segments of 8 threads, 32 segments per row.
var<workgroup> sort_segments: array<u32, 256>;

// Increments one of 16 counters of 4 bits each; a thread has 8 elements.
fn tally_add(counters: vec2<u32>, digit: u32) -> vec2<u32> {
    let one = 1u << ((digit & 7u) * 4u);
    return counters + select(vec2<u32>(0u, one), vec2<u32>(one, 0u), digit < 8u);
}

fn tally_get(counters: vec2<u32>, digit: u32) -> u32 {
    return (select(counters.y, counters.x, digit < 8u) >> ((digit & 7u) * 4u)) & 15u;
}

// Returns the half of a packed pair that belongs to `digit`.
fn half_of(pair: u32, digit: u32) -> u32 {
    return select(pair >> 16u, pair & 0xffffu, digit < 8u);
}

// Replaces the counts in the table by sums over the preceding threads of the segment, and
// computes the sums of the segments. Ends with a barrier.
fn sum_segments(thread: u32, counters: vec2<u32>) {
    for (var row = 0u; row < 8u; row++) {
        let low = (counters.x >> (4u * row)) & 15u;
        let high = (counters.y >> (4u * row)) & 15u;
        sort_table[row * 256u + thread] = low | (high << 16u);
    }
    workgroupBarrier();
    var sum = 0u;
    for (var i = 8u * thread; i < 8u * thread + 8u; i++) {
        let v = sort_table[i];
        sort_table[i] = sum;
        sum += v;
    }
    sort_segments[thread] = sum;
    workgroupBarrier();
}
