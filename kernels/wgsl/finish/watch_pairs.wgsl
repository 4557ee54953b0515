// Notes a frame with more (splat, tile) pairs than its buffers hold: the steps from it on change nothing,
// until the CPU has read the number and repeats them. No CPU version: the CPU knows the number.

@group(0) @binding(0) var<storage, read> plan: array<u32>;
// The largest number of pairs of a frame that had too many; 0 where none had.
@group(0) @binding(1) var<storage, read_write> status: array<u32>;

@compute @workgroup_size(1)
fn main() {
    if plan[PLAN_REQUESTED] > plan[PLAN_COUNT] {
        status[0] = max(status[0], plan[PLAN_REQUESTED]);
    }
}
