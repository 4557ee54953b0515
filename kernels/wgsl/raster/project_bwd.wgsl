// Gradients of mean, shape and opacity from the sums over the pixels. CPU version:
// cpu/raster/project_bwd.rs; formulas of cpu/raster/ewa_bwd.rs (EWA splatting; 3DGS, appendix A).
// colour_bwd.wgsl adds the part of the mean's gradient through the view direction.
//
// Input: rows as in project.wgsl; footprints [N, 12] and sums [N, 10] from splat `own` on.
// Output: gradients of the rows; zeros for splats without a visible pixel, even for rows that are
// not finite. One thread per splat.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> sums: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_rows: array<f32>;

// ln 2.
const LN_2: f32 = 0.69314718;

fn load3(at: u32) -> vec3<f32> {
    return vec3<f32>(rows[at], rows[at + 1u], rows[at + 2u]);
}

fn store3(at: u32, v: vec3<f32>) {
    d_rows[at] = v.x;
    d_rows[at + 1u] = v.y;
    d_rows[at + 2u] = v.z;
}

// Returns ∂L/∂Σ with the low-pass, px⁻²: xx, xy, yy. `w` is (sx, sx·shear, sy).
fn covariance_gradient(m: Moments, w: vec3<f32>) -> vec3<f32> {
    let k = 2.0 * LN_2 * LN_2;
    let skew = w.y * m.second.x + w.z * m.second.y;
    return k * vec3<f32>(
        w.x * w.x * m.second.x,
        w.x * skew,
        w.y * skew + w.z * (w.y * m.second.y + w.z * m.second.z),
    );
}

// Returns the contribution of an antialiased opacity, o·√(det Σ₀ / det Σ), to ∂L/∂Σ through det
// Σ.
fn antialiasing(m: Moments, w: vec3<f32>) -> vec3<f32> {
    return -LN_2 * m.one * vec3<f32>(w.x * w.x, w.x * w.y, w.y * w.y + w.z * w.z);
}

// Returns the gradient of the mean in camera coordinates along one picture axis, from `h` =
// ∂L/∂(row of J W) and ∂L/∂pixel.
fn axis(h: vec3<f32>, row: vec3<f32>, p: vec2<f32>, limits: vec2<f32>, f: f32, pixel: f32) -> vec2<f32> {
    let z = p.y;
    let ratio = p.x / z;
    let slope = clamp(ratio, limits.x, limits.y);
    let free = ratio >= limits.x && ratio <= limits.y;
    let d_slope = select(0.0, -f / z * dot(h, call.ahead.xyz), free);
    let shifted = 1.0 / (z + call.z_epsilon);
    let d_position = pixel * f * shifted;
    return vec2<f32>(
        d_position + d_slope / z,
        -d_position * p.x * shifted - (dot(h, row) + d_slope * slope) / z,
    );
}

fn geometry(i: u32, m: Moments) {
    let row = i * call.stride;
    let a = footprints[3u * (call.own + i)];
    let b = footprints[3u * (call.own + i) + 1u];
    let w = vec3<f32>(a.z, a.z * a.w, b.x);
    let d = load3(row) - vec3<f32>(call.right.w, call.down.w, call.ahead.w);
    let p = vec3<f32>(dot(call.right.xyz, d), dot(call.down.xyz, d), dot(call.ahead.xyz, d));
    let slopes = p.xy / p.z;
    let f = call.focal_centre.xy / p.z;
    let j0 = jacobian(slopes.x, call.limits.xy, f.x, call.right.xyz);
    let j1 = jacobian(slopes.y, call.limits.zw, f.y, call.down.xyz);
    var g = covariance_gradient(m, w);
    let smoothed = call.antialiased != 0u;
    if smoothed {
        g += antialiasing(m, w);
    }
    var h0: vec3<f32>;
    var h1: vec3<f32>;
    if call.stride == SPLAT_STRIDE {
        let q = vec4<f32>(rows[row + QUAT_OFFSET], load3(row + QUAT_OFFSET + 1u));
        let scale = load3(row + SCALE_OFFSET);
        let s = 2.0 / dot(q, q);
        // Columns of R.
        let r0 = vec3<f32>(1.0 - s * (q.z * q.z + q.w * q.w), s * (q.y * q.z + q.x * q.w), s * (q.y * q.w - q.x * q.z));
        let r1 = vec3<f32>(s * (q.y * q.z - q.x * q.w), 1.0 - s * (q.y * q.y + q.w * q.w), s * (q.z * q.w + q.x * q.y));
        let r2 = vec3<f32>(s * (q.y * q.w + q.x * q.z), s * (q.z * q.w - q.x * q.y), 1.0 - s * (q.y * q.y + q.z * q.z));
        let reach0 = vec3<f32>(dot(j0, r0), dot(j0, r1), dot(j0, r2));
        let reach1 = vec3<f32>(dot(j1, r0), dot(j1, r1), dot(j1, r2));
        let m0 = reach0 * scale;
        let m1 = reach1 * scale;
        // ∂L/∂M, M = J W R S.
        var g0 = 2.0 * (g.x * m0 + g.y * m1);
        var g1 = 2.0 * (g.y * m0 + g.z * m1);
        if smoothed {
            // ½ ln det Σ₀ = ln |m0 x m1|.
            let n = cross(m0, m1);
            let area = m.one / dot(n, n);
            g0 += area * cross(m1, n);
            g1 += area * cross(n, m0);
        }
        store3(row + SCALE_OFFSET, g0 * reach0 + g1 * reach1);
        let s0 = g0 * scale;
        let s1 = g1 * scale;
        h0 = s0.x * r0 + s0.y * r1 + s0.z * r2;
        h1 = s1.x * r0 + s1.y * r1 + s1.z * r2;
        // A rotation by ω adds ω x (columns of R S), and q changes by ½ (0, ω) q.
        let t = cross(h0, j0) + cross(h1, j1);
        d_rows[row + QUAT_OFFSET] = -s * dot(t, q.yzw);
        store3(row + QUAT_OFFSET + 1u, s * (q.x * t + cross(t, q.yzw)));
    } else {
        let c0 = load3(row + 3u);
        let c1 = load3(row + 6u);
        let sigma = mat3x3<f32>(c0.x, c0.y, c0.z, c0.y, c1.x, c1.y, c0.z, c1.y, c1.z);
        let s0 = sigma * j0;
        let s1 = sigma * j1;
        if smoothed {
            let xx = dot(j0, s0);
            let xy = dot(j0, s1);
            let yy = dot(j1, s1);
            g += 0.5 * m.one / (xx * yy - xy * xy) * vec3<f32>(yy, -xy, xx);
        }
        h0 = 2.0 * (g.x * s0 + g.y * s1);
        h1 = 2.0 * (g.y * s0 + g.z * s1);
        // An off-diagonal number represents two entries.
        let own = g.x * j0 * j0 + 2.0 * g.y * j0 * j1 + g.z * j1 * j1;
        let k0 = g.x * j0 + g.y * j1;
        let k1 = g.y * j0 + g.z * j1;
        let xy = 2.0 * (j0.x * k0.y + j1.x * k1.y);
        let xz = 2.0 * (j0.x * k0.z + j1.x * k1.z);
        let yz = 2.0 * (j0.y * k0.z + j1.y * k1.z);
        store3(row + 3u, vec3<f32>(own.x, xy, xz));
        store3(row + 6u, vec3<f32>(own.y, yz, own.z));
    }
    let pixel = 2.0 * LN_2 * vec2<f32>(w.x * m.first.x, w.y * m.first.x + w.z * m.first.y);
    let x = axis(h0, j0, p.xz, call.limits.xy, call.focal_centre.x, pixel.x);
    let y = axis(h1, j1, p.yz, call.limits.zw, call.focal_centre.y, pixel.y);
    let z = m.z + x.y + y.y;
    store3(row, x.x * call.right.xyz + y.x * call.down.xyz + z * call.ahead.xyz);
    let opacity = row + call.stride - 1u;
    d_rows[opacity] = m.one / rows[opacity];
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.count {
        return;
    }
    let m = moments(call.own + i);
    if has_gradient(m) {
        geometry(i, m);
        return;
    }
    for (var k = i * call.stride; k < (i + 1u) * call.stride; k++) {
        d_rows[k] = 0.0;
    }
}
