// Exclusive prefix sum in place, by one workgroup: of an array of blocks, so short. The sum
// over all follows the last. Length: a multiple of the plan's blocks.

override PER_BLOCK: u32 = 1u;

@group(0) @binding(0) var<storage, read> plan: array<u32>;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let length = PER_BLOCK * plan[PLAN_BLOCKS];
    var carry = 0u;
    for (var base = 0u; base < length; base += GPU_BLOCK) {
        let first = base + 8u * lane;
        let past = min(first + 8u, length);
        var sum = 0u;
        for (var i = first; i < past; i++) {
            sum = saturating(sum, data[i]);
        }
        var before = saturating(carry, scan_threads(lane, sum));
        for (var i = first; i < past; i++) {
            let v = data[i];
            data[i] = before;
            before = saturating(before, v);
        }
        carry = saturating(carry, scan_heads[16]);
        workgroupBarrier();
    }
    if lane == 0u {
        data[length] = carry;
    }
}
