// A digit of a stable radix sort: 4 bits, blocks of GPU_BLOCK elements, 8 consecutive ones
// a thread. Separate dispatches count, sum and scatter: no workgroup waits for another, as
// WebGPU promises none progress (src/cpu/sort.rs has the same order).

struct SortUniform {
    shift: u32,
    pad_a: u32,
    pad_b: u32,
    pad_c: u32,
}

// Row r of 256 threads: how many of a thread's elements have digit r (low half) and digit
// r + 8 (high half); at most 2048 in all, so that sums of packed halves do not carry.
var<workgroup> sort_table: array<u32, 2048>;
// Sums of 8 threads, 32 to a row.
var<workgroup> sort_segments: array<u32, 256>;

// Counters of 16 digits, 4 bits each: a thread has 8 elements.
fn tally_add(counters: vec2<u32>, digit: u32) -> vec2<u32> {
    let one = 1u << ((digit & 7u) * 4u);
    return counters + select(vec2<u32>(0u, one), vec2<u32>(one, 0u), digit < 8u);
}

fn tally_get(counters: vec2<u32>, digit: u32) -> u32 {
    return (select(counters.y, counters.x, digit < 8u) >> ((digit & 7u) * 4u)) & 15u;
}

// Half of a packed pair that belongs to `digit`.
fn half_of(pair: u32, digit: u32) -> u32 {
    return select(pair >> 16u, pair & 0xffffu, digit < 8u);
}

// Turns the table into sums over the threads of the same segment before, and fills in the
// segments' sums. Ends with a barrier.
fn sum_segments(lane: u32, counters: vec2<u32>) {
    for (var row = 0u; row < 8u; row++) {
        let low = (counters.x >> (4u * row)) & 15u;
        let high = (counters.y >> (4u * row)) & 15u;
        sort_table[row * 256u + lane] = low | (high << 16u);
    }
    workgroupBarrier();
    var sum = 0u;
    for (var i = 8u * lane; i < 8u * lane + 8u; i++) {
        let v = sort_table[i];
        sort_table[i] = sum;
        sum += v;
    }
    sort_segments[lane] = sum;
    workgroupBarrier();
}
