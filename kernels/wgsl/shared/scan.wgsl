// Exclusive prefix sum over the 256 threads of a workgroup. Sums saturate, so that an overflow is
// detected as too large.

var<workgroup> scan_partial: array<u32, 256>;
var<workgroup> scan_totals: array<u32, 17>;

fn saturating_add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Returns the sum of `value` over the preceding threads; scan_totals[16] is the sum over all
// threads. A barrier must separate two calls.
fn scan_threads(thread: u32, value: u32) -> u32 {
    scan_partial[thread] = value;
    workgroupBarrier();
    if thread < 16u {
        var sum = 0u;
        for (var i = 16u * thread; i < 16u * thread + 16u; i++) {
            let v = scan_partial[i];
            scan_partial[i] = sum;
            sum = saturating_add(sum, v);
        }
        scan_totals[thread] = sum;
    }
    workgroupBarrier();
    if thread == 0u {
        var sum = 0u;
        for (var i = 0u; i < 16u; i++) {
            let v = scan_totals[i];
            scan_totals[i] = sum;
            sum = saturating_add(sum, v);
        }
        scan_totals[16] = sum;
    }
    workgroupBarrier();
    return saturating_add(scan_partial[thread], scan_totals[thread / 16u]);
}
