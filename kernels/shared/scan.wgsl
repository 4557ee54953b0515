// Exclusive prefix sum over the 256 threads of a workgroup. Sums saturate: a total that no
// memory holds is to be seen as too large, not as small.

var<workgroup> scan_partial: array<u32, 256>;
var<workgroup> scan_heads: array<u32, 17>;

fn saturating(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// The sum of `mine` over the threads before; scan_heads[16] is the sum over all. A barrier
// belongs between two calls.
fn scan_threads(lane: u32, mine: u32) -> u32 {
    scan_partial[lane] = mine;
    workgroupBarrier();
    if lane < 16u {
        var sum = 0u;
        for (var i = 16u * lane; i < 16u * lane + 16u; i++) {
            let v = scan_partial[i];
            scan_partial[i] = sum;
            sum = saturating(sum, v);
        }
        scan_heads[lane] = sum;
    }
    workgroupBarrier();
    if lane == 0u {
        var sum = 0u;
        for (var i = 0u; i < 16u; i++) {
            let v = scan_heads[i];
            scan_heads[i] = sum;
            sum = saturating(sum, v);
        }
        scan_heads[16] = sum;
    }
    workgroupBarrier();
    return saturating(scan_partial[lane], scan_heads[lane / 16u]);
}
