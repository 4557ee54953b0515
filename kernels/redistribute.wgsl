// How a parent's opacity is shared among its children (SubSplat, "Opacity allocation";
// supp. A.3): the rules and formulas of src/cpu/redistribute.rs, its twin.
//
// In: logits [P,K]; areas [P,K], px²; opacities [P]; own areas [P] (read by the rules
// whose areas are relative).   Out: [P,K].   One thread per parent.

struct RedistributeUniform {
    parents: u32,
    children: u32,
    rule: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> call: RedistributeUniform;
@group(0) @binding(1) var<storage, read> logits: array<f32>;
@group(0) @binding(2) var<storage, read> areas: array<f32>;
@group(0) @binding(3) var<storage, read> opacities: array<f32>;
@group(0) @binding(4) var<storage, read> own: array<f32>;
@group(0) @binding(5) var<storage, read_write> shared_out: array<f32>;

// Softmax argument of child i.
fn weight_log(i: u32) -> f32 {
    if call.rule == RULE_LINEAR {
        return logits[i] - log(areas[i] + AREA_EPS);
    }
    return logits[i];
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let p = workgroup_number(workgroup, workgroups) * 64u + lane;
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
    var top = weight_log(first);
    for (var i = first + 1u; i < past; i++) {
        top = max(top, weight_log(i));
    }
    var sum = 0.0;
    for (var i = first; i < past; i++) {
        let w = exp(weight_log(i) - top);
        shared_out[i] = w;
        sum += w;
    }
    let relative = call.rule == RULE_OPTICAL_DEPTH || call.rule == RULE_AREA;
    var per_own = 1.0;
    if relative {
        per_own = 1.0 / own[p];
    }
    var whole = alpha;
    if call.rule == RULE_OPTICAL_DEPTH || call.rule == RULE_TRANSMITTANCE {
        whole = -ln_1p(-min(alpha, OPACITY_CEILING));
    }
    let factor = whole / sum;
    for (var i = first; i < past; i++) {
        var x = factor * shared_out[i];
        if relative {
            x /= max(areas[i] * per_own, RELATIVE_AREA_MIN);
        }
        if call.rule == RULE_AREA {
            x = min(x, AREA_RULE_OPACITY_MAX);
        } else if call.rule != RULE_LINEAR {
            x = -exp_m1(-x);
        }
        shared_out[i] = x;
    }
}
