//! 2-D covariances of sixteen splats at a time.
//!
//! For quaternion and σ, M = J·W·R·S (2×3) and det(MMᵀ) = ‖m₁ × m₂‖² (Cauchy-Binet), which
//! has no cancellation for needles.

use crate::cpu::simd::{LANES, Simd, Vector};

/// Sixteen splats' shapes.
pub(crate) enum Shape<'a, S: Simd> {
    /// Quaternion wxyz of any length, σ.
    Quat([S::F; 4], [S::F; 3]),
    /// World covariances 00, 01, 02, 11, 12, 22.
    Cov6(&'a [[f32; 6]; LANES]),
}

/// J·Σ·Jᵀ before the low-pass, px² (det: px⁴).
pub(crate) struct Covariance2d<S: Simd> {
    pub(crate) xx: S::F,
    pub(crate) xy: S::F,
    pub(crate) yy: S::F,
    pub(crate) det: S::F,
}

/// Computes M·Mᵀ with M = J·W·R·S, and the lanes whose quaternion has a direction.
#[inline(always)]
pub(crate) fn covariance_quat<S: Simd>(
    s: S,
    j: [[S::F; 3]; 2],
    [w, x, y, z]: [S::F; 4],
    scale: [S::F; 3],
) -> (Covariance2d<S>, S::M) {
    let norm2 = w.fma(w, x.fma(x, y.fma(y, z * z)));
    let whole = s.splat(f32::MIN_POSITIVE).le(norm2) & norm2.lt(s.splat(f32::INFINITY));
    let t = s.splat(2.0) / norm2;
    let one = s.splat(1.0);
    let wt = w * t;
    let xt = x * t;
    let yt = y * t;
    let xx = xt * x;
    let yy = yt * y;
    let zz = z * z * t;
    let (xy, xz, yz) = (xt * y, xt * z, yt * z);
    let (wx, wy, wz) = (wt * x, wt * y, wt * z);
    // Columns of R, each times its σ.
    let axes = [
        [one - (yy + zz), xy + wz, xz - wy],
        [xy - wz, one - (xx + zz), yz + wx],
        [xz + wy, yz - wx, one - (xx + yy)],
    ];
    let mut m = j;
    for i in 0..2 {
        for k in 0..3 {
            m[i][k] = dot(j[i], axes[k]) * scale[k];
        }
    }
    let [a, b] = m;
    let n =
        [a[2].fnma(b[1], a[1] * b[2]), a[0].fnma(b[2], a[2] * b[0]), a[1].fnma(b[0], a[0] * b[1])];
    let c = Covariance2d { xx: dot(a, a), xy: dot(a, b), yy: dot(b, b), det: dot(n, n) };
    (c, whole)
}

/// Computes J·Σ·Jᵀ of given covariances, in `f64`: its determinant cancels for needles.
#[inline(always)]
pub(crate) fn covariance_cov6<S: Simd>(
    s: S,
    j: [[S::F; 3]; 2],
    cov6: &[[f32; 6]; LANES],
) -> Covariance2d<S> {
    let mut rows = [[[0.0; LANES]; 3]; 2];
    for (to, from) in rows.iter_mut().zip(j) {
        for (to, from) in to.iter_mut().zip(from) {
            s.store(from, to);
        }
    }
    let mut out = [[0.0; LANES]; 4];
    for (l, cov6) in cov6.iter().enumerate() {
        let j = rows.map(|r| r.map(|lanes| f64::from(lanes[l])));
        let [a, b, c, d, e, f] = cov6.map(f64::from);
        let apply = |v: [f64; 3]| {
            [
                a * v[0] + b * v[1] + c * v[2],
                b * v[0] + d * v[1] + e * v[2],
                c * v[0] + e * v[1] + f * v[2],
            ]
        };
        let inner = |u: [f64; 3], v: [f64; 3]| u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
        let (sx, sy) = (apply(j[0]), apply(j[1]));
        let (xx, xy, yy) = (inner(j[0], sx), inner(j[0], sy), inner(j[1], sy));
        for (lanes, v) in out.iter_mut().zip([xx, xy, yy, xx * yy - xy * xy]) {
            lanes[l] = v as f32;
        }
    }
    Covariance2d {
        xx: s.load(&out[0]),
        xy: s.load(&out[1]),
        yy: s.load(&out[2]),
        det: s.load(&out[3]),
    }
}

#[inline(always)]
pub(crate) fn dot<V: Vector>(a: [V; 3], b: [V; 3]) -> V {
    a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]))
}
