// Redistribution of a parent's opacity among its children (SubSplat, "Opacity allocation";
// supplement A.3). Rules and formulas: cpu/redistribute.rs.

// Returns whether areas are relative to the area of the parent.
fn rule_is_relative(rule: u32) -> bool {
    return rule == RULE_OPTICAL_DEPTH || rule == RULE_AREA;
}

// Returns the argument of the softmax.
fn rule_logit(rule: u32, logit: f32, area: f32) -> f32 {
    if rule == RULE_LINEAR {
        return logit - log(area + AREA_EPS);
    }
    return logit;
}

// Returns the distributed quantity: the opacity, or its optical depth.
fn rule_total(rule: u32, alpha: f32) -> f32 {
    if rule == RULE_OPTICAL_DEPTH || rule == RULE_TRANSMITTANCE {
        return -ln_1p(-min(alpha, OPACITY_CEILING));
    }
    return alpha;
}

// Returns the divisor of a share.
fn rule_divisor(rule: u32, area: f32, inverse_parent_area: f32) -> f32 {
    if rule_is_relative(rule) {
        return max(area * inverse_parent_area, RELATIVE_AREA_MIN);
    }
    return 1.0;
}

// Returns the opacity of a child with the share `part`.
fn rule_opacity(rule: u32, part: f32, area: f32, inverse_parent_area: f32) -> f32 {
    let x = part / rule_divisor(rule, area, inverse_parent_area);
    if rule == RULE_LINEAR {
        return x;
    }
    if rule == RULE_AREA {
        return min(x, AREA_RULE_OPACITY_MAX);
    }
    return -exp_m1(-x);
}
