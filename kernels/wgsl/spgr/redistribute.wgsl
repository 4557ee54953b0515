// Opacity redistribution (SubSplat, "Opacity allocation"; supplement A.3). CPU version and
// formulas: cpu/redistribute.rs.
//
// Input: logits [P,K]; areas [P,K], px²; opacities [P] in [0,1]; areas of the parents [P], px²
// (read by the rules whose areas are relative). Output: [P,K]. One thread per parent.

@group(0) @binding(0) var<uniform> call: RedistributeUniform;
@group(0) @binding(1) var<storage, read> logits: array<f32>;
@group(0) @binding(2) var<storage, read> areas: array<f32>;
@group(0) @binding(3) var<storage, read> opacities: array<f32>;
@group(0) @binding(4) var<storage, read> own: array<f32>;
@group(0) @binding(5) var<storage, read_write> shared_out: array<f32>;

// Returns the softmax argument of child i.
fn softmax_argument(i: u32) -> f32 {
    return rule_logit(call.rule, logits[i], areas[i]);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let p = workgroup_number(workgroup, workgroups) * 64u + thread;
    if p >= call.parents {
        return;
    }
    let first = p * call.children;
    let past = first + call.children;
    let alpha = opacities[p];
    if call.rule == RULE_NONE {
        for (var i = first; i < past; i++) {
            shared_out[i] = alpha;
        }
        return;
    }
    var top = softmax_argument(first);
    for (var i = first + 1u; i < past; i++) {
        top = max(top, softmax_argument(i));
    }
    var sum = 0.0;
    for (var i = first; i < past; i++) {
        let w = exp(softmax_argument(i) - top);
        shared_out[i] = w;
        sum += w;
    }
    var inverse_parent_area = 1.0;
    if rule_is_relative(call.rule) {
        inverse_parent_area = 1.0 / own[p];
    }
    let factor = rule_total(call.rule, alpha) / sum;
    for (var i = first; i < past; i++) {
        shared_out[i] = rule_opacity(call.rule, factor * shared_out[i], areas[i], inverse_parent_area);
    }
}
