// Children of parents from head records (SubSplat, section 3.2; supplement A.3). CPU version:
// cpu/spgr/mod.rs. Arguments except the last two: wgsl/shared/spgr.wgsl.
//
// Output: children [N·K, 11]; colour gains [N·K] or, in RGB, [N·K, 4]. One thread per parent. The
// opacity of a child holds its area until the areas of all children are known.

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

// Returns the softmax argument of child i, whose area is stored in its opacity.
fn argument(i: u32) -> f32 {
    return rule_logit(call.rule, head[i * HEAD_STRIDE + HEAD_LOGIT_OFFSET],
        children[i * SPLAT_STRIDE + OPACITY_OFFSET]);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = workgroup_number(workgroup, workgroups) * 64u + thread;
    if n >= call.parents {
        return;
    }
    let count = children_count();
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
    let total = rule_total(call.rule, p.alpha) / sum;
    let inverse_parent_area = 1.0 / own_of(p).value;
    for (var i = first; i < first + count; i++) {
        let at = i * SPLAT_STRIDE + OPACITY_OFFSET;
        let part = total * exp(argument(i) - top);
        children[at] = rule_opacity(call.rule, part, children[at], inverse_parent_area);
    }
}
