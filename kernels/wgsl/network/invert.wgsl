// Lists of the entries of each cell, in ascending order. A sum over entries can then be computed
// per cell, reproducibly and without float atomics. CPU version: the counting sort of
// cpu/plane_sweep/backward.rs.
//
// Input: cell of each entry, or NONE. Output: starts [cells + 1] and list; the entries of cell c
// are list[starts[c] .. starts[c + 1]]. Entry points in order: count, scan (one workgroup), fill,
// order (one workgroup per cell). `starts` is zero before `count`.

@group(0) @binding(0) var<uniform> call: InvertUniform;
@group(0) @binding(1) var<storage, read> cells_of: array<u32>;
@group(0) @binding(2) var<storage, read_write> starts: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read_write> cursors: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> list: array<u32>;

@compute @workgroup_size(64)
fn count(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let e = workgroup_number(workgroup, workgroups) * 64u + thread;
    if e < call.entries && cells_of[e] != NONE {
        atomicAdd(&starts[cells_of[e]], 1u);
    }
}

var<workgroup> sums: array<u32, 256>;

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) thread: u32) {
    let each = (call.cells + 255u) / 256u;
    let first = min(thread * each, call.cells);
    let past = min(first + each, call.cells);
    var sum = 0u;
    for (var c = first; c < past; c++) {
        sum += atomicLoad(&starts[c]);
    }
    sums[thread] = sum;
    workgroupBarrier();
    var before = 0u;
    for (var i = 0u; i < thread; i++) {
        before += sums[i];
    }
    for (var c = first; c < past; c++) {
        let own = atomicLoad(&starts[c]);
        atomicStore(&starts[c], before);
        atomicStore(&cursors[c], before);
        before += own;
    }
    if thread == 255u {
        atomicStore(&starts[call.cells], before);
    }
}

@compute @workgroup_size(64)
fn fill(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let e = workgroup_number(workgroup, workgroups) * 64u + thread;
    if e < call.entries && cells_of[e] != NONE {
        list[atomicAdd(&cursors[cells_of[e]], 1u)] = e;
    }
}

var<workgroup> span: vec2<u32>;

fn exchange(first: u32, count: u32, a: u32, b: u32) {
    if b < count && list[first + b] < list[first + a] {
        let v = list[first + a];
        list[first + a] = list[first + b];
        list[first + b] = v;
    }
}

// Bitonic sort whose comparators all have the same direction, so that comparators beyond the end
// of the list can be skipped.
@compute @workgroup_size(64)
fn order(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let c = workgroup_number(workgroup, workgroups);
    if c >= call.cells {
        return;
    }
    if thread == 0u {
        span = vec2<u32>(atomicLoad(&starts[c]), atomicLoad(&starts[c + 1u]));
    }
    let ends = workgroupUniformLoad(&span);
    let length = ends.y - ends.x;
    for (var size = 2u; size < 2u * length; size *= 2u) {
        let pairs = (length + size - 1u) / size * (size / 2u);
        for (var i = thread; i < pairs; i += 64u) {
            let at = i / (size / 2u) * size;
            let within = i % (size / 2u);
            exchange(ends.x, length, at + within, at + size - 1u - within);
        }
        storageBarrier();
        for (var stride = size / 4u; stride > 0u; stride /= 2u) {
            for (var i = thread; i < pairs; i += 64u) {
                let a = i / stride * 2u * stride + i % stride;
                exchange(ends.x, length, a, a + stride);
            }
            storageBarrier();
        }
    }
}
