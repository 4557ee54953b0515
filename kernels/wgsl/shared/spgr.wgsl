// Sub-pixel Gaussian reparameterization of one parent and one child (SubSplat, section 3.2), for
// the forward and the backward kernel. The order of the formulas is that of cpu/spgr/mod.rs.
//
// Matrices store their rows as WGSL columns: m[i] is row i, v * m is M·v, m * v is Mᵀ·v.

@group(0) @binding(0) var<uniform> call: SpgrUniform;
// [N, K, 11].
@group(0) @binding(1) var<storage, read> head: array<f32>;
// [N, 11].
@group(0) @binding(2) var<storage, read> parents: array<f32>;
// [V, SPGR_CAMERA_STRIDE]: R world from camera (9), position (3), focal (2), centre (2), size (2),
// minimum z, lower and upper bounds of x/z and y/z (4).
@group(0) @binding(3) var<storage, read> cameras: array<f32>;

struct View {
    rotation: mat3x3<f32>,
    position: vec3<f32>,
    focal: vec2<f32>,
    centre: vec2<f32>,
    size: vec2<f32>,
    z_min: f32,
    low: vec2<f32>,
    high: vec2<f32>,
}

fn camera3(i: u32) -> vec3<f32> {
    return vec3<f32>(cameras[i], cameras[i + 1u], cameras[i + 2u]);
}

fn camera2(i: u32) -> vec2<f32> {
    return vec2<f32>(cameras[i], cameras[i + 1u]);
}

fn view_number(v: u32) -> View {
    let i = v * SPGR_CAMERA_STRIDE;
    return View(
        mat3x3<f32>(camera3(i), camera3(i + 3u), camera3(i + 6u)),
        camera3(i + 9u),
        camera2(i + 12u),
        camera2(i + 14u),
        camera2(i + 16u),
        cameras[i + 18u],
        camera2(i + 19u),
        camera2(i + 21u),
    );
}

fn in_camera_frame(view: View, p: vec3<f32>) -> vec3<f32> {
    return view.rotation * (p - view.position);
}

// Returns the primary view of parent n (SubSplat, supplement A.3).
fn primary_view(n: u32, mean: vec3<f32>) -> View {
    var chosen = min((call.first + n) / call.per_view, call.views - 1u);
    if call.nearest_visible != 0u && call.views > 1u {
        var nearest = 3.4e38;
        for (var v = 0u; v < call.views; v++) {
            let view = view_number(v);
            let p = in_camera_frame(view, mean);
            let u = view.focal * p.xy / p.z + view.centre;
            let inside = all(vec2<f32>() < u) && all(u < view.size);
            if p.z > VISIBLE_Z_MIN && p.z < nearest && inside {
                nearest = p.z;
                chosen = v;
            }
        }
    }
    return view_number(chosen);
}

// J·R_w2c with the guarded Jacobian J of the projection, px per world unit.
struct Jacobian {
    u: vec3<f32>,
    v: vec3<f32>,
    focal: vec2<f32>,
    raw: vec2<f32>,
    inverse_z: f32,
    axis: vec3<f32>,
    free_z: bool,
    free: vec2<bool>,
}

fn jacobian(view: View, p: vec3<f32>, zoom: f32) -> Jacobian {
    let r = transpose(view.rotation);
    let inverse_z = 1.0 / max(p.z, view.z_min);
    let raw = p.xy * inverse_z;
    let slope = min(max(raw, view.low), view.high);
    let focal = zoom * view.focal * inverse_z;
    return Jacobian(
        focal.x * (r[0] - slope.x * r[2]),
        focal.y * (r[1] - slope.y * r[2]),
        focal,
        raw,
        inverse_z,
        r[2],
        view.z_min < p.z,
        (view.low < raw) & (raw < view.high),
    );
}

// Returns the product of two quaternions, wxyz: .x is w.
fn quat_product(a: vec4<f32>, b: vec4<f32>) -> vec4<f32> {
    let w = (a.x * b.x - a.y * b.y) - (a.z * b.z + a.w * b.w);
    return vec4<f32>(w, a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

// A normalised quaternion; zero kept_axis zero.
struct Unit {
    q: vec4<f32>,
    inverse: f32,
    free: bool,
}

fn unit_of(q: vec4<f32>) -> Unit {
    let squared = dot(q, q);
    let inverse = 1.0 / sqrt(max(squared, AREA_SQ_EPS));
    return Unit(q * inverse, inverse, AREA_SQ_EPS < squared);
}

fn rotation_of(q: vec4<f32>) -> mat3x3<f32> {
    let v = q.yzw;
    let d = 2.0 * v;
    return mat3x3<f32>(
        vec3<f32>(1.0 - (v.y * d.y + v.z * d.z), d.x * v.y - q.x * d.z, d.x * v.z + q.x * d.y),
        vec3<f32>(d.x * v.y + q.x * d.z, 1.0 - (v.x * d.x + v.z * d.z), d.y * v.z - q.x * d.x),
        vec3<f32>(d.x * v.z - q.x * d.y, d.y * v.z + q.x * d.x, 1.0 - (v.x * d.x + v.y * d.y)),
    );
}

// Quaternion of a rotation vector, radians.
struct DeltaRotation {
    e: vec4<f32>,
    r: vec3<f32>,
    squared: f32,
    // sin(t/2)/t.
    sinc: f32,
}

fn delta_rotation_of(r: vec3<f32>) -> DeltaRotation {
    let squared = dot(r, r);
    let small = squared < 1e-6;
    let theta = sqrt(max(squared, 1e-6));
    let sc = sin_cos(0.5 * theta);
    let sinc = select(sc.x / theta, 0.5 - squared * (0.5 / 24.0), small);
    let w = select(sc.y, 1.0 - 0.125 * squared, small);
    return DeltaRotation(vec4<f32>(w, sinc * r), r, squared, sinc);
}

// M = J·R_w2c·R(q)·diag(s), two rows a and b; M·Mᵀ is the projected covariance.
struct Footprint {
    // J·R_w2c·R(q).
    rotated_a: vec3<f32>,
    rotated_b: vec3<f32>,
    a: vec3<f32>,
    b: vec3<f32>,
    normal: vec3<f32>,
    // |a × b|, px².
    area: f32,
}

fn footprint(j: Jacobian, rotation: mat3x3<f32>, scale: vec3<f32>) -> Footprint {
    let ta = rotation * j.u;
    let tb = rotation * j.v;
    let a = ta * scale;
    let b = tb * scale;
    let normal = cross(a, b);
    return Footprint(ta, tb, a, b, normal, sqrt(dot(normal, normal) + AREA_SQ_EPS));
}

// Returns the area with the low-pass. The columns of M are multiplied by `growth`, and `area`
// includes the growth.
fn lowpassed_area(f: Footprint, growth: vec3<f32>, area: f32, lowpass: f32) -> f32 {
    let columns = growth * growth * (f.a * f.a + f.b * f.b);
    let trace = columns.x + columns.y + columns.z;
    return sqrt(area * area + (lowpass * trace + lowpass * lowpass));
}

// Returns the factors of the three sigmas that raise the area to A_min.
fn growth_of(f: Footprint) -> vec3<f32> {
    if call.a_min <= 0.0 || f.area >= call.a_min {
        return vec3<f32>(1.0);
    }
    if call.two_axis == 0u {
        return vec3<f32>(min(sqrt(call.a_min / f.area), GROWTH_MAX));
    }
    let l = f.a * f.a + f.b * f.b;
    // The first of the shortest columns keeps its length.
    var kept_axis = 0u;
    if min(l.y, l.z) < l.x {
        kept_axis = select(1u, 2u, l.z < l.y);
    }
    let s = f.normal * f.normal;
    // Root c² of c^4·p + c²·q = A_min², in the form without cancellation.
    let p = s[kept_axis];
    let q = s[(kept_axis + 1u) % 3u] + s[(kept_axis + 2u) % 3u];
    let target_sq = call.a_min * call.a_min;
    let root = sqrt(q * q + 4.0 * p * target_sq);
    let c = min(sqrt(2.0 * target_sq / (q + root)), GROWTH_MAX);
    var growth = vec3<f32>(c);
    growth[kept_axis] = 1.0;
    return growth;
}

// Steps along the parent's disc that project to one pixel, of minimum Mahalanobis length.
struct Disc {
    u: vec3<f32>,
    v: vec3<f32>,
    solid: bool,
    unit: Unit,
    // R_w2c·R(q), without and with the scales.
    rotation: mat3x3<f32>,
    g: mat3x3<f32>,
    ju: vec3<f32>,
    jv: vec3<f32>,
    a: vec3<f32>,
    b: vec3<f32>,
    normal: vec3<f32>,
    inverse_det: f32,
    weight_u: vec3<f32>,
    weight_v: vec3<f32>,
}

// Quantities that all children of a parent share.
struct Parent {
    view: View,
    mean: vec3<f32>,
    quat: vec4<f32>,
    scale: vec3<f32>,
    alpha: f32,
    in_camera: vec3<f32>,
    // Depth for the pixel pitch, at least the minimum z of the view.
    z: f32,
    disc: Disc,
    jacobian: Jacobian,
}

fn disc_of(p: Parent) -> Disc {
    let s = p.scale;
    let unit = unit_of(p.quat);
    let rotation = rotation_of(unit.q);
    let columns = transpose(p.view.rotation);
    let rotation_in_camera =
        mat3x3<f32>(rotation * columns[0], rotation * columns[1], rotation * columns[2]);
    let g = mat3x3<f32>(rotation_in_camera[0] * s, rotation_in_camera[1] * s, rotation_in_camera[2] * s);
    let f = p.view.focal / p.z;
    let ju = vec3<f32>(f.x, 0.0, -f.x * p.in_camera.x / p.z);
    let jv = vec3<f32>(0.0, f.y, -f.y * p.in_camera.y / p.z);
    let a = g * ju;
    let b = g * jv;
    let normal = cross(a, b);
    let det = dot(normal, normal) + AREA_SQ_EPS;
    let solid = DISC_AREA_SQ_MIN < det;
    let inverse_det = 1.0 / select(1.0, det, solid);
    let wu = cross(b, normal) * inverse_det;
    let wv = cross(normal, a) * inverse_det;
    return Disc(wu * g, wv * g, solid, unit, rotation_in_camera, g, ju, jv, a, b, normal, inverse_det, wu, wv);
}

fn load_parent(n: u32) -> Parent {
    let i = n * SPLAT_STRIDE;
    var p: Parent;
    let m = i + MEAN_OFFSET;
    let q = i + QUAT_OFFSET;
    let s = i + SCALE_OFFSET;
    p.mean = vec3<f32>(parents[m], parents[m + 1u], parents[m + 2u]);
    p.quat = vec4<f32>(parents[q], parents[q + 1u], parents[q + 2u], parents[q + 3u]);
    p.scale = vec3<f32>(parents[s], parents[s + 1u], parents[s + 2u]);
    p.alpha = parents[i + OPACITY_OFFSET];
    p.view = primary_view(n, p.mean);
    p.in_camera = in_camera_frame(p.view, p.mean);
    p.z = max(p.in_camera.z, p.view.z_min);
    if call.disc != 0u {
        p.disc = disc_of(p);
    }
    if call.area_at_parent != 0u {
        p.jacobian = jacobian(p.view, p.in_camera, call.zoom);
    }
    return p;
}

// The parent's own footprint in a native render.
struct Own {
    unit: Unit,
    rotation: mat3x3<f32>,
    jacobian: Jacobian,
    footprint: Footprint,
    lowpassed_area: f32,
    // Area in target px²; 1 for the rules that do not use it.
    value: f32,
}

fn own_of(p: Parent) -> Own {
    var o: Own;
    o.value = 1.0;
    if rule_is_relative(call.rule) {
        o.unit = unit_of(p.quat);
        o.rotation = rotation_of(o.unit.q);
        o.jacobian = jacobian(p.view, p.in_camera, 1.0);
        o.footprint = footprint(o.jacobian, o.rotation, p.scale);
        o.lowpassed_area = o.footprint.area;
        if call.rule == RULE_OPTICAL_DEPTH {
            o.lowpassed_area =
                lowpassed_area(o.footprint, vec3<f32>(1.0), o.footprint.area, call.lowpass_input);
        }
        o.value = f32(children_count()) * o.lowpassed_area;
    }
    return o;
}

// Step of a child in the camera frame, and intermediate values of its gradient.
struct Step {
    out: vec3<f32>,
    // tanh of the learned offset, or the offset itself where it is unbounded.
    bounded: vec2<f32>,
    // Input px.
    offset: vec2<f32>,
    along_disc: f32,
    tanh_z: f32,
    free_z: bool,
    // Before the residual along the ray.
    side: vec2<f32>,
    share: f32,
    inverse: f32,
    free_depth: bool,
}

fn children_count() -> u32 {
    return call.columns * select(1u, call.rows, call.step == 0u);
}

fn step_of(p: Parent, k: u32, record: u32) -> Step {
    var t: Step;
    let per_side = 1.0 / call.zoom;
    var cell = vec2<u32>(k % call.columns, k / call.columns);
    if call.step != 0u {
        cell.y = call.step * k % call.rows;
    }
    let per_cell = 1.0 / vec2<f32>(f32(call.columns), f32(call.rows));
    let learned = vec2<f32>(head[record + HEAD_UV_OFFSET], head[record + HEAD_UV_OFFSET + 1u]);
    t.bounded = learned;
    var per_px = per_side;
    if call.bounded != 0u {
        t.bounded = vec2<f32>(tanh_of(learned.x), tanh_of(learned.y));
        per_px = call.offset_bound * per_side;
    }
    t.offset = t.bounded * per_px + ((vec2<f32>(cell) + 0.5) * per_cell - 0.5);
    var s = vec3<f32>(p.z * t.offset / p.view.focal, 0.0);
    if call.disc != 0u {
        let d = t.offset.x * p.disc.u + t.offset.y * p.disc.v;
        // The step along an edge-on disc is limited to a slide_max of the depth.
        let slide_max = DEPTH_FRACTION_MIN * p.z;
        t.along_disc = select(0.0, slide_max / max(abs(d.z), slide_max), p.disc.solid);
        s += t.along_disc * (d - s);
    }
    t.tanh_z = tanh_of(head[record + HEAD_DEPTH_OFFSET]);
    var dz = call.beta_z * t.tanh_z;
    if call.relative_depth != 0u {
        dz *= p.z;
    }
    let dz_min = (DEPTH_FRACTION_MIN - 1.0) * p.z - s.z;
    t.free_z = dz_min < dz;
    dz = max(dz, dz_min);
    t.side = s.xy;
    if call.ray != 0u {
        let depth = p.in_camera.z + s.z;
        t.inverse = 1.0 / max(depth, p.view.z_min);
        t.share = dz * t.inverse;
        t.free_depth = p.view.z_min < depth;
        let moved = s.xy + t.share * (p.in_camera.xy + s.xy);
        s = vec3<f32>(moved, s.z);
    }
    t.out = vec3<f32>(s.xy, s.z + dz);
    return t;
}

struct Child {
    step: Step,
    delta_rotation: DeltaRotation,
    unit: Unit,
    rotation: mat3x3<f32>,
    jacobian: Jacobian,
    footprint: Footprint,
    // tanh(dlog s / c), and lambda_s·e^…
    soft: vec3<f32>,
    factor: vec3<f32>,
    // Scales before the growth to the minimum footprint.
    small: vec3<f32>,
    growth: vec3<f32>,
    clamped: f32,
    mean: vec3<f32>,
    scale: vec3<f32>,
    // Area for the opacity rule, target px².
    area: f32,
}

fn head3(i: u32) -> vec3<f32> {
    return vec3<f32>(head[i], head[i + 1u], head[i + 2u]);
}

// Returns child k of parent p; its head record begins at `record`.
fn child_of(p: Parent, k: u32, record: u32) -> Child {
    var c: Child;
    c.step = step_of(p, k, record);
    c.mean = p.mean + c.step.out * p.view.rotation;
    let x = head3(record + HEAD_LOG_SCALE_OFFSET) / call.dlog_clamp;
    c.soft = vec3<f32>(tanh_of(x.x), tanh_of(x.y), tanh_of(x.z));
    c.factor = call.lambda_s * exp(call.dlog_clamp * c.soft);
    c.small = c.factor * p.scale;
    c.delta_rotation = delta_rotation_of(head3(record + HEAD_ROTATION_OFFSET));
    c.unit = unit_of(quat_product(p.quat, c.delta_rotation.e));
    c.rotation = rotation_of(c.unit.q);
    if call.area_at_parent != 0u {
        c.jacobian = p.jacobian;
    } else {
        c.jacobian = jacobian(p.view, p.in_camera + c.step.out, call.zoom);
    }
    c.footprint = footprint(c.jacobian, c.rotation, c.small);
    c.growth = growth_of(c.footprint);
    c.clamped = max(c.footprint.area, call.a_min);
    c.area = c.clamped;
    if call.rule == RULE_OPTICAL_DEPTH {
        c.area = lowpassed_area(c.footprint, c.growth, c.clamped, call.lowpass_target);
    }
    c.scale = c.small * c.growth;
    return c;
}
