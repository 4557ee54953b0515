// Children of parents with head records (SubSplat 3.2, supp. A.3): twin of src/cpu/spgr.
// Arguments but the last two: kernels/shared/spgr.wgsl.
//
// Out: children [N·K, 11]; colour gains [N·K] or, in RGB, [N·K, 4].   One thread per
// parent. The opacity lane holds the child's area until all of them are known.

@group(0) @binding(4) var<storage, read_write> children: array<f32>;
@group(0) @binding(5) var<storage, read_write> gains: array<f32>;

fn store_child(i: u32, c: Child) {
    let at = i * SPLAT_STRIDE;
    for (var k = 0u; k < 3u; k++) {
        children[at + MEAN_OFFSET + k] = c.mean[k];
        children[at + SCALE_OFFSET + k] = c.scale[k];
    }
    for (var k = 0u; k < 4u; k++) {
        children[at + QUAT_OFFSET + k] = c.unit.q[k];
    }
    children[at + OPACITY_OFFSET] = c.area;
}

// Gain and residual: gain·(½ + S) = ½ + gain·S + (gain − 1)/2.
fn store_gain(i: u32) {
    let extra = call.delta * tanh_of(head[i * HEAD_STRIDE + HEAD_GAIN_OFFSET]);
    if call.rgb_gain == 0u {
        gains[i] = 1.0 + extra;
        return;
    }
    gains[4u * i] = 1.0 + extra;
    for (var k = 1u; k < 4u; k++) {
        gains[4u * i + k] = 0.5 * extra;
    }
}

// Softmax argument of child i, from the area in its opacity lane.
fn argument(i: u32) -> f32 {
    return share_log(call.rule, head[i * HEAD_STRIDE + HEAD_LOGIT_OFFSET],
        children[i * SPLAT_STRIDE + OPACITY_OFFSET]);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let n = workgroup_number(workgroup, workgroups) * 64u + lane;
    if n >= call.parents {
        return;
    }
    let count = call.side * call.side;
    let first = n * count;
    let p = load_parent(n);
    for (var k = 0u; k < count; k++) {
        store_child(first + k, child_of(p, k, (first + k) * HEAD_STRIDE));
        store_gain(first + k);
    }
    if call.rule == RULE_NONE {
        for (var i = first; i < first + count; i++) {
            children[i * SPLAT_STRIDE + OPACITY_OFFSET] = p.alpha;
        }
        return;
    }
    var top = argument(first);
    for (var i = first + 1u; i < first + count; i++) {
        top = max(top, argument(i));
    }
    var sum = 0.0;
    for (var i = first; i < first + count; i++) {
        sum += exp(argument(i) - top);
    }
    let whole = share_whole(call.rule, p.alpha) / sum;
    let per_own = 1.0 / own_of(p).value;
    for (var i = first; i < first + count; i++) {
        let at = i * SPLAT_STRIDE + OPACITY_OFFSET;
        let part = whole * exp(argument(i) - top);
        children[at] = share_one(call.rule, part, children[at], per_own);
    }
}
