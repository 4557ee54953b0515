// Moves every element to its position by one digit; equal digits keep their order. `places` holds
// the prefix sums of the histogram. With IDENTITY_VALUES the values are the indices of the keys.
// One workgroup per block. CPU version: cpu/raster/sort.rs.

override IDENTITY_VALUES: bool = false;

@group(0) @binding(0) var<uniform> call: SortUniform;
@group(0) @binding(1) var<storage, read> plan: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = workgroup_number(workgroup, workgroups);
    let first = block * GPU_BLOCK + 8u * thread;
    let past = min(first + 8u, plan[PLAN_COUNT]);
    let blocks = plan[PLAN_BLOCKS];
    var counters = vec2<u32>(0u);
    for (var i = first; i < past; i++) {
        counters = tally_add(counters, (keys[i] >> call.shift) & 15u);
    }
    sum_segments(thread, counters);
    if thread < 8u {
        var sum = 0u;
        for (var i = 32u * thread; i < 32u * thread + 32u; i++) {
            let v = sort_segments[i];
            sort_segments[i] = sum;
            sum += v;
        }
    }
    workgroupBarrier();
    counters = vec2<u32>(0u);
    for (var i = first; i < past; i++) {
        let key = keys[i];
        let digit = (key >> call.shift) & 15u;
        let row = digit & 7u;
        let before = sort_table[row * 256u + thread] + sort_segments[row * 32u + thread / 8u];
        let place = places[digit * blocks + block] + half_of(before, digit) + tally_get(counters, digit);
        counters = tally_add(counters, digit);
        keys_out[place] = key;
        if IDENTITY_VALUES {
            values_out[place] = i;
        } else {
            values_out[place] = values[i];
        }
    }
}
