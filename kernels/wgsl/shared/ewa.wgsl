// Elliptical weighted average of one splat (EWA splatting; 3DGS, section 4). Formulas and
// conditions for dropped splats: cpu/raster/ewa.rs and cpu/raster/covariance.rs.

// cov2d before the low-pass: xx, xy, yy, determinant.
struct Covariance {
    xx: f32,
    xy: f32,
    yy: f32,
    det: f32,
}

// Returns M Mᵗ for M = J W R S. The determinant is |m1 x m2|², without cancellation for needles.
fn covariance_quat(j0: vec3<f32>, j1: vec3<f32>, q: vec4<f32>, scale: vec3<f32>) -> Covariance {
    let w = q.x;
    let t = 2.0 / dot(q, q);
    let xx = q.y * q.y * t;
    let yy = q.z * q.z * t;
    let zz = q.w * q.w * t;
    let xy = q.y * q.z * t;
    let xz = q.y * q.w * t;
    let yz = q.z * q.w * t;
    let wx = w * q.y * t;
    let wy = w * q.z * t;
    let wz = w * q.w * t;
    let r0 = vec3<f32>(1.0 - (yy + zz), xy + wz, xz - wy);
    let r1 = vec3<f32>(xy - wz, 1.0 - (xx + zz), yz + wx);
    let r2 = vec3<f32>(xz + wy, yz - wx, 1.0 - (xx + yy));
    let a = vec3<f32>(dot(j0, r0), dot(j0, r1), dot(j0, r2)) * scale;
    let b = vec3<f32>(dot(j1, r0), dot(j1, r1), dot(j1, r2)) * scale;
    let n = cross(a, b);
    return Covariance(dot(a, a), dot(a, b), dot(b, b), dot(n, n));
}

// Returns J Σ Jᵗ for a world covariance 00, 01, 02, 11, 12, 22.
fn covariance_cov6(j0: vec3<f32>, j1: vec3<f32>, a: vec3<f32>, b: vec3<f32>) -> Covariance {
    let sigma = mat3x3<f32>(a.x, a.y, a.z, a.y, b.x, b.y, a.z, b.y, b.z);
    let s0 = sigma * j0;
    let s1 = sigma * j1;
    let xx = dot(j0, s0);
    let xy = dot(j0, s1);
    let yy = dot(j1, s1);
    return Covariance(xx, xy, yy, xx * yy - xy * xy);
}

// Returns one row of J W, px per world unit.
fn jacobian(slope: f32, limits: vec2<f32>, f: f32, row: vec3<f32>) -> vec3<f32> {
    return f * (row - clamp(slope, limits.x, limits.y) * call.ahead.xyz);
}

// Returns the pixels [x, y) along one axis inside the support and inside the tile cut.
fn extent(mean: f32, half: f32, side: u32, cut: bool, radius: f32) -> vec2<f32> {
    let reach = half + SPAN_SLACK_PX;
    let size = f32(side);
    var first = max(ceil(mean - reach), 0.0);
    var past = min(floor(mean + reach) + 1.0, size);
    if cut {
        let tile = f32(TILE_GPU);
        first = max(floor((mean - radius) / tile) * tile, first);
        past = min(floor((mean + radius + tile - 1.0) / tile) * tile, past);
    }
    return vec2<f32>(min(first, size), max(past, 0.0));
}
