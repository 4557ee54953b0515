// Gradients of redistribute.wgsl. CPU version and formulas: cpu/redistribute.rs
// (share_backward).
//
// Input: the input of redistribute.wgsl, and the gradient [P,K] of its result. Output: gradients
// of logits and areas [P,K], and of opacity and own area [P,2]. One thread per parent.

@group(0) @binding(0) var<uniform> call: RedistributeUniform;
@group(0) @binding(1) var<storage, read> logits: array<f32>;
@group(0) @binding(2) var<storage, read> areas: array<f32>;
@group(0) @binding(3) var<storage, read> opacities: array<f32>;
@group(0) @binding(4) var<storage, read> own: array<f32>;
@group(0) @binding(5) var<storage, read> grad: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_logits: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_areas: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_parents: array<vec2<f32>>;

// RULE_NONE: every child has the opacity of the parent.
fn equal_opacities(p: u32, first: u32, past: u32) {
    var sum = 0.0;
    for (var i = first; i < past; i++) {
        sum += grad[i];
        d_logits[i] = 0.0;
        d_areas[i] = 0.0;
    }
    d_parents[p] = vec2<f32>(sum, 0.0);
}

// Writes the softmax weights to `d_logits`.
fn softmax_weights(first: u32, past: u32) {
    var top = rule_logit(call.rule, logits[first], areas[first]);
    for (var i = first + 1u; i < past; i++) {
        top = max(top, rule_logit(call.rule, logits[i], areas[i]));
    }
    var sum = 0.0;
    for (var i = first; i < past; i++) {
        let w = exp(rule_logit(call.rule, logits[i], areas[i]) - top);
        d_logits[i] = w;
        sum += w;
    }
    for (var i = first; i < past; i++) {
        d_logits[i] /= sum;
    }
}

fn linear_rule(p: u32, first: u32, past: u32) {
    var mean = 0.0;
    for (var i = first; i < past; i++) {
        mean += d_logits[i] * grad[i];
    }
    for (var i = first; i < past; i++) {
        let d = opacities[p] * d_logits[i] * (grad[i] - mean);
        d_logits[i] = d;
        d_areas[i] = -d / (areas[i] + AREA_EPS);
    }
    d_parents[p] = vec2<f32>(mean, 0.0);
}

// Rules of the form α_k = F(x_k), x_k = s w_k / B_k: ∂L/∂x_k times x_k is ∂L/∂ln w_k.
fn relative_rules(p: u32, first: u32, past: u32) {
    let alpha = opacities[p];
    let relative = rule_is_relative(call.rule);
    var inverse_parent_area = 1.0;
    if relative {
        inverse_parent_area = 1.0 / own[p];
    }
    let total = rule_total(call.rule, alpha);
    var d_total = 0.0;
    var mean = 0.0;
    var d_own = 0.0;
    for (var i = first; i < past; i++) {
        let inverse = 1.0 / rule_divisor(call.rule, areas[i], inverse_parent_area);
        let part = d_logits[i] * inverse;
        let x = total * part;
        var dx = grad[i] * exp(-x);
        if call.rule == RULE_AREA {
            dx = select(0.0, grad[i], x < AREA_RULE_OPACITY_MAX);
        }
        d_total += dx * part;
        mean += dx * x;
        let free = relative && areas[i] * inverse_parent_area > RELATIVE_AREA_MIN;
        let d_b = select(0.0, -dx * x * inverse, free);
        d_own += d_b * areas[i];
        d_areas[i] = d_b * inverse_parent_area;
    }
    for (var i = first; i < past; i++) {
        let w = d_logits[i];
        let x = total * w / rule_divisor(call.rule, areas[i], inverse_parent_area);
        var dx = grad[i] * exp(-x);
        if call.rule == RULE_AREA {
            dx = select(0.0, grad[i], x < AREA_RULE_OPACITY_MAX);
        }
        d_logits[i] = dx * x - w * mean;
    }
    var d_alpha = d_total;
    if call.rule != RULE_AREA {
        d_alpha = select(0.0, d_total / (1.0 - alpha), alpha < OPACITY_CEILING);
    }
    d_parents[p] = vec2<f32>(d_alpha, -d_own * inverse_parent_area * inverse_parent_area);
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
    if call.rule == RULE_NONE {
        equal_opacities(p, first, past);
        return;
    }
    softmax_weights(first, past);
    if call.rule == RULE_LINEAR {
        linear_rule(p, first, past);
    } else {
        relative_rules(p, first, past);
    }
}
