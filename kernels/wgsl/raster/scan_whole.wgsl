// Exclusive prefix sum in place, by one workgroup, of an array with PER_BLOCK elements per block
// of the plan. The total follows the last element. CPU version: cpu/raster/tiles.rs.

override PER_BLOCK: u32 = 1u;

@group(0) @binding(0) var<storage, read> plan: array<u32>;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) thread: u32) {
    let length = PER_BLOCK * plan[PLAN_BLOCKS];
    var carry = 0u;
    for (var base = 0u; base < length; base += GPU_BLOCK) {
        let first = base + 8u * thread;
        let past = min(first + 8u, length);
        var sum = 0u;
        for (var i = first; i < past; i++) {
            sum = saturating_add(sum, data[i]);
        }
        var before = saturating_add(carry, scan_threads(thread, sum));
        for (var i = first; i < past; i++) {
            let v = data[i];
            data[i] = before;
            before = saturating_add(before, v);
        }
        carry = saturating_add(carry, scan_totals[16]);
        workgroupBarrier();
    }
    if thread == 0u {
        data[length] = carry;
    }
}
