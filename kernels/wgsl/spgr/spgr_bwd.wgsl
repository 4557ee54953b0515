// Gradients of the children with respect to head records and parents (SubSplat, section 3.2). CPU
// version: cpu/spgr/backward.rs. Arguments except the last three: wgsl/shared/spgr.wgsl.
//
// Input: gradient of the children [N·K, 11]. Output: gradients of the head records [N, K, 11] (0
// for HEAD_GAIN_OFFSET, which spgr_gains_bwd.wgsl computes) and of the parents [N, 11]. One thread per
// parent. The first pass over the children computes their areas, which the opacity rule couples;
// the second pass computes the gradients. Between the passes, two elements of a child's head
// gradient hold its area and its softmax weight, and HEAD_LOGIT_OFFSET holds the opacity's part.

@group(0) @binding(4) var<storage, read> grad: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_head: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_parents: array<f32>;

const AREA: u32 = 0u;
const WEIGHT: u32 = 1u;

// Gradients of a parent, summed over its children.
struct ParentGradient {
    mean: vec3<f32>,
    quat: vec4<f32>,
    scale: vec3<f32>,
    alpha: f32,
    in_camera: vec3<f32>,
    z: f32,
    disc_u: vec3<f32>,
    disc_v: vec3<f32>,
    ju: vec3<f32>,
    jv: vec3<f32>,
    own: f32,
}

fn masked(mask: bool, v: f32) -> f32 {
    return select(0.0, v, mask);
}

fn conjugate(q: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(q.x, -q.yzw);
}

fn unit_bwd(u: Unit, d: vec4<f32>) -> vec4<f32> {
    return (d - u.q * masked(u.free, dot(u.q, d))) * u.inverse;
}

fn rotation_bwd(q: vec4<f32>, g: mat3x3<f32>) -> vec4<f32> {
    let skew = vec3<f32>(g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]);
    let xy = g[0][1] + g[1][0];
    let xz = g[0][2] + g[2][0];
    let yz = g[1][2] + g[2][1];
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return 2.0 * vec4<f32>(
        dot(skew, q.yzw),
        dot(vec3<f32>(y, z, q.x), vec3<f32>(xy, xz, skew.x)) - x * 2.0 * (g[1][1] + g[2][2]),
        dot(vec3<f32>(x, z, q.x), vec3<f32>(xy, yz, skew.y)) - y * 2.0 * (g[0][0] + g[2][2]),
        dot(vec3<f32>(x, y, q.x), vec3<f32>(xz, yz, skew.z)) - z * 2.0 * (g[0][0] + g[1][1]),
    );
}

fn delta_rotation_bwd(t: DeltaRotation, d: vec4<f32>) -> vec3<f32> {
    // (cos(t/2)/2 - sinc)/t², below 1 radian by its Taylor series.
    let s = t.squared;
    let series = -2.0 / 48.0 + s * (4.0 / 3840.0 + s * (-6.0 / 645120.0
        + s * (8.0 / 185794560.0 - s * (10.0 / 81749606400.0))));
    let slope = select((0.5 * t.e.x - t.sinc) / max(s, 1.0), series, s < 1.0);
    let along = slope * dot(t.r, d.yzw) - 0.5 * t.sinc * d.x;
    return t.sinc * d.yzw + along * t.r;
}

fn jacobian_bwd(j: Jacobian, du: vec3<f32>, dv: vec3<f32>) -> vec3<f32> {
    let along = -j.focal * vec2<f32>(dot(du, j.axis), dot(dv, j.axis));
    let slope = select(vec2<f32>(), along, j.free);
    let z = -dot(du, j.u) - dot(dv, j.v) - dot(slope, j.raw);
    return vec3<f32>(slope * j.inverse_z, masked(j.free_z, z * j.inverse_z));
}

// Gradients of J·R_w2c, R(q) and the sigmas.
struct FootprintGradient {
    ju: vec3<f32>,
    jv: vec3<f32>,
    rotation: mat3x3<f32>,
    scale: vec3<f32>,
}

// Returns the gradients of a footprint, from those of its area and of the rows of M. `da` and
// `db` exclude the contribution of the area.
fn footprint_bwd(
    f: Footprint,
    j: Jacobian,
    rotation: mat3x3<f32>,
    scale: vec3<f32>,
    d_area: f32,
    da: vec3<f32>,
    db: vec3<f32>,
) -> FootprintGradient {
    let n = f.normal * (d_area / f.area);
    let a = da + cross(f.b, n);
    let b = db + cross(n, f.a);
    let ta = a * scale;
    let tb = b * scale;
    return FootprintGradient(
        ta * rotation,
        tb * rotation,
        mat3x3<f32>(j.u.x * ta + j.v.x * tb, j.u.y * ta + j.v.y * tb, j.u.z * ta + j.v.z * tb),
        a * f.rotated_a + b * f.rotated_b,
    );
}

// Adds the gradient through the step of a child; `d` is the gradient of the step.
fn step_bwd(
    p: Parent,
    t: Step,
    d: vec3<f32>,
    record: u32,
    g: ptr<function, ParentGradient>,
) {
    var s = d;
    var d_dz = d.z;
    if call.ray != 0u {
        let d_share = dot(s.xy, p.in_camera.xy + t.side);
        (*g).in_camera += vec3<f32>(t.share * s.xy, 0.0);
        s = vec3<f32>(s.xy + t.share * s.xy, s.z);
        let each = d_share * t.inverse;
        d_dz += each;
        let d_ahead = masked(t.free_depth, -each * t.share);
        (*g).in_camera.z += d_ahead;
        s.z += d_ahead;
    }
    let free_dz = masked(t.free_z, d_dz);
    let bound_dz = d_dz - free_dz;
    (*g).z += bound_dz * (DEPTH_FRACTION_MIN - 1.0);
    s.z -= bound_dz;
    var d_tanh = free_dz * call.beta_z;
    if call.relative_depth != 0u {
        (*g).z += d_tanh * t.tanh_z;
        d_tanh *= p.z;
    }
    d_head[record + HEAD_DEPTH_OFFSET] = d_tanh * (1.0 - t.tanh_z * t.tanh_z);
    var d_offset = vec2<f32>();
    var flat = s.xy;
    if call.disc != 0u {
        let slid = s * t.along_disc;
        (*g).disc_u += t.offset.x * slid;
        (*g).disc_v += t.offset.y * slid;
        d_offset = vec2<f32>(dot(p.disc.u, slid), dot(p.disc.v, slid));
        flat -= slid.xy;
    }
    let per = flat / p.view.focal;
    d_offset += per * p.z;
    (*g).z += dot(per, t.offset);
    d_offset /= call.zoom;
    if call.bounded != 0u {
        d_offset *= call.offset_bound * (1.0 - t.bounded * t.bounded);
    }
    d_head[record + HEAD_UV_OFFSET] = d_offset.x;
    d_head[record + HEAD_UV_OFFSET + 1u] = d_offset.y;
}

fn grad3(i: u32) -> vec3<f32> {
    return vec3<f32>(grad[i], grad[i + 1u], grad[i + 2u]);
}

// Adds the gradient of child i to that of its parent, and writes the geometry part of its head
// gradient.
fn child_bwd(p: Parent, k: u32, i: u32, d_of_area: f32, g: ptr<function, ParentGradient>) {
    let record = i * HEAD_STRIDE;
    let from_row = i * SPLAT_STRIDE;
    let c = child_of(p, k, record);
    let f = c.footprint;
    var d_clamped = d_of_area;
    var da = vec3<f32>();
    var db = vec3<f32>();
    if call.rule == RULE_OPTICAL_DEPTH {
        let each = d_of_area / c.area;
        d_clamped = each * c.clamped;
        let by = c.growth * c.growth * (each * call.lowpass_target);
        da = by * f.a;
        db = by * f.b;
    }
    let d_area = masked(call.a_min < f.area, d_clamped);
    let by = footprint_bwd(f, c.jacobian, c.rotation, c.small, d_area, da, db);
    let d_small = grad3(from_row + SCALE_OFFSET) * c.growth + by.scale;
    (*g).scale += d_small * c.factor;
    let log_scale = d_small * c.small * (1.0 - c.soft * c.soft);
    let q = from_row + QUAT_OFFSET;
    let d_quat = vec4<f32>(grad[q], grad[q + 1u], grad[q + 2u], grad[q + 3u]);
    let d_unit = unit_bwd(c.unit, d_quat + rotation_bwd(c.unit.q, by.rotation));
    let d_delta = delta_rotation_bwd(c.delta_rotation, quat_product(conjugate(p.quat), d_unit));
    for (var j = 0u; j < 3u; j++) {
        d_head[record + HEAD_LOG_SCALE_OFFSET + j] = log_scale[j];
        d_head[record + HEAD_ROTATION_OFFSET + j] = d_delta[j];
    }
    (*g).quat += quat_product(d_unit, conjugate(c.delta_rotation.e));
    let d_mean = grad3(from_row + MEAN_OFFSET);
    (*g).mean += d_mean;
    var d_step = p.view.rotation * d_mean;
    if call.area_at_parent != 0u {
        (*g).ju += by.ju;
        (*g).jv += by.jv;
    } else {
        let at = jacobian_bwd(c.jacobian, by.ju, by.jv);
        (*g).in_camera += at;
        d_step += at;
    }
    step_bwd(p, c.step, d_step, record, g);
}

fn own_bwd(p: Parent, g: ptr<function, ParentGradient>) {
    let o = own_of(p);
    let f = o.footprint;
    let each = (*g).own * f32(children_count());
    var d_area = each;
    var da = vec3<f32>();
    var db = vec3<f32>();
    if call.rule == RULE_OPTICAL_DEPTH {
        let per = each / o.lowpassed_area;
        d_area = per * f.area;
        da = per * call.lowpass_input * f.a;
        db = per * call.lowpass_input * f.b;
    }
    let by = footprint_bwd(f, o.jacobian, o.rotation, p.scale, d_area, da, db);
    (*g).in_camera += jacobian_bwd(o.jacobian, by.ju, by.jv);
    (*g).scale += by.scale;
    (*g).quat += unit_bwd(o.unit, rotation_bwd(o.unit.q, by.rotation));
}

fn disc_bwd(p: Parent, g: ptr<function, ParentGradient>) {
    let c = p.disc;
    if !c.solid {
        return;
    }
    let du = (*g).disc_u;
    let dv = (*g).disc_v;
    let eu = (c.g * du) * c.inverse_det;
    let ev = (c.g * dv) * c.inverse_det;
    // t_u = b×n/det, t_v = n×a/det, det = n·n, n = a×b.
    let n = c.normal;
    let d_det = -(dot(eu, c.weight_u) + dot(ev, c.weight_v));
    let dn = 2.0 * d_det * n + (cross(eu, c.b) + cross(c.a, ev));
    let da = cross(ev, n) + cross(c.b, dn);
    let db = cross(n, eu) + cross(dn, c.a);
    // steps = G·t and m = J·G.
    var dg: mat3x3<f32>;
    for (var i = 0u; i < 3u; i++) {
        dg[i] = du[i] * c.weight_u + dv[i] * c.weight_v + c.ju[i] * da + c.jv[i] * db;
    }
    // J's row is f/z at column i and -f·x/z² at column 2.
    let per = p.view.focal / (p.z * p.z);
    let d_f = vec2<f32>(dot(da, c.g[0]), dot(db, c.g[1]));
    let d_x = vec2<f32>(dot(da, c.g[2]), dot(db, c.g[2]));
    (*g).in_camera -= vec3<f32>(d_x * per, 0.0);
    (*g).z -= dot(d_f, per) + 2.0 * (d_x.x * c.ju.z + d_x.y * c.jv.z) / p.z;
    // G = R_w2c·R·S.
    var d_rotation: mat3x3<f32>;
    for (var i = 0u; i < 3u; i++) {
        (*g).scale += dg[i] * c.rotation[i];
        d_rotation[i] = dg[i] * p.scale;
    }
    let r = p.view.rotation;
    let rotation = mat3x3<f32>(d_rotation * r[0], d_rotation * r[1], d_rotation * r[2]);
    (*g).quat += unit_bwd(c.unit, rotation_bwd(c.unit.q, rotation));
}

// Computes the gradients of the opacity rule for children first .. past of parent p. Areas and
// logits of the children receive their gradients in the head gradient.
fn share_bwd(p: Parent, first: u32, past: u32, g: ptr<function, ParentGradient>) {
    if call.rule == RULE_NONE {
        for (var i = first; i < past; i++) {
            (*g).alpha += grad[i * SPLAT_STRIDE + OPACITY_OFFSET];
            d_head[i * HEAD_STRIDE + AREA] = 0.0;
            d_head[i * HEAD_STRIDE + HEAD_LOGIT_OFFSET] = 0.0;
        }
        return;
    }
    var top = argument(first);
    for (var i = first + 1u; i < past; i++) {
        top = max(top, argument(i));
    }
    var sum = 0.0;
    for (var i = first; i < past; i++) {
        let w = exp(argument(i) - top);
        d_head[i * HEAD_STRIDE + WEIGHT] = w;
        sum += w;
    }
    let inverse_parent_area = 1.0 / own_of(p).value;
    let total = rule_total(call.rule, p.alpha);
    var mean = 0.0;
    var d_total = 0.0;
    var d_own = 0.0;
    for (var i = first; i < past; i++) {
        let at = i * HEAD_STRIDE;
        let area = d_head[at + AREA];
        let w = d_head[at + WEIGHT] / sum;
        let inverse_b = 1.0 / rule_divisor(call.rule, area, inverse_parent_area);
        let part = w * inverse_b;
        let x = total * part;
        var dx = grad[i * SPLAT_STRIDE + OPACITY_OFFSET];
        if call.rule == RULE_AREA {
            dx = masked(x < AREA_RULE_OPACITY_MAX, dx);
        } else if call.rule != RULE_LINEAR {
            dx *= exp(-x);
        }
        d_total += dx * part;
        mean += dx * x;
        var d_area = 0.0;
        if rule_is_relative(call.rule) && RELATIVE_AREA_MIN < area * inverse_parent_area {
            let d_b = -dx * x * inverse_b;
            d_own += d_b * area;
            d_area = d_b * inverse_parent_area;
        }
        d_head[at + WEIGHT] = w;
        d_head[at + HEAD_LOGIT_OFFSET] = dx * x;
        if call.rule != RULE_LINEAR {
            d_head[at + AREA] = d_area;
        }
    }
    for (var i = first; i < past; i++) {
        let at = i * HEAD_STRIDE;
        let d_logit = d_head[at + HEAD_LOGIT_OFFSET] - d_head[at + WEIGHT] * mean;
        d_head[at + HEAD_LOGIT_OFFSET] = d_logit;
        if call.rule == RULE_LINEAR {
            d_head[at + AREA] = -d_logit / (d_head[at + AREA] + AREA_EPS);
        }
    }
    (*g).alpha = d_total;
    if call.rule == RULE_OPTICAL_DEPTH || call.rule == RULE_TRANSMITTANCE {
        (*g).alpha = masked(p.alpha < OPACITY_CEILING, d_total / (1.0 - p.alpha));
    }
    (*g).own = -d_own * inverse_parent_area * inverse_parent_area;
}

// Returns the softmax argument of child i, whose area is stored in its head gradient.
fn argument(i: u32) -> f32 {
    let at = i * HEAD_STRIDE;
    return rule_logit(call.rule, head[at + HEAD_LOGIT_OFFSET], d_head[at + AREA]);
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
        let record = (first + k) * HEAD_STRIDE;
        d_head[record + AREA] = child_of(p, k, record).area;
    }
    var g: ParentGradient;
    share_bwd(p, first, first + count, &g);
    for (var k = 0u; k < count; k++) {
        let record = (first + k) * HEAD_STRIDE;
        child_bwd(p, k, first + k, d_head[record + AREA], &g);
        d_head[record + HEAD_GAIN_OFFSET] = 0.0;
    }
    if rule_is_relative(call.rule) {
        own_bwd(p, &g);
    }
    if call.area_at_parent != 0u {
        g.in_camera += jacobian_bwd(p.jacobian, g.ju, g.jv);
    }
    if call.disc != 0u {
        disc_bwd(p, &g);
    }
    g.in_camera.z += masked(p.view.z_min < p.in_camera.z, g.z);
    let mean = g.mean + g.in_camera * p.view.rotation;
    let to = n * SPLAT_STRIDE;
    for (var i = 0u; i < 3u; i++) {
        d_parents[to + MEAN_OFFSET + i] = mean[i];
        d_parents[to + SCALE_OFFSET + i] = g.scale[i];
    }
    for (var i = 0u; i < 4u; i++) {
        d_parents[to + QUAT_OFFSET + i] = g.quat[i];
    }
    d_parents[to + OPACITY_OFFSET] = g.alpha;
}
