//! Backward of [`crate::cpu::raster::ewa`]: from the pixels' moments of one footprint to
//! mean, shape and opacity (EWA splatting; 3DGS appendix A for the shape's part).
//!
//! The pixels' sums are [`Moments`] in the footprint's own whitened coordinates
//! (d, s) = W·δ, W = [[sx, sx·shear], [0, sy]], in which a needle is round: nothing
//! cancels on the way back. With Σ⁻¹ = 2 ln 2·WᵀW,
//! ∂L/∂Σ = 2 ln²2·Wᵀ [[dd, ds], [ds, ss]] W.
//!
//! Everything here is one straight expression per splat without a branch, so that a
//! loop over 16 of them becomes vectors.

use crate::cpu::raster::ewa::View;
use std::f32::consts::LN_2;

/// Sums over the pixels of one splat: of v = ∂L/∂ln α (zero where α is
/// capped, skipped or past the stop) and of the weights w = α·T.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Moments {
    /// Σ v.
    pub(crate) one: f32,
    /// Σ v·d.
    pub(crate) d: f32,
    /// Σ v·s.
    pub(crate) s: f32,
    /// Σ v·d².
    pub(crate) dd: f32,
    /// Σ v·d·s.
    pub(crate) ds: f32,
    /// Σ v·s².
    pub(crate) ss: f32,
    /// Σ w·∂L/∂(R, G, B).
    pub(crate) rgb: [f32; 3],
    /// Σ w·∂L/∂(depth sum).
    pub(crate) z: f32,
}

/// W of a footprint: its `sx`, `sx·shear`, `sy`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Whitening {
    pub(crate) a: f32,
    pub(crate) b: f32,
    pub(crate) c: f32,
}

/// ∂L/∂ of a symmetric 2 × 2 matrix as a matrix: both off-diagonal entries are `xy`.
#[derive(Clone, Copy, Debug)]
struct Gradient2d {
    xx: f32,
    xy: f32,
    yy: f32,
}

/// Jacobian of the projection at a mean, as the forward takes it.
struct Jacobian {
    /// Camera coordinates of the mean.
    p: [f32; 3],
    /// p / z clamped.
    slope: [f32; 2],
    /// True where the clamp does not limit the slope.
    free: [bool; 2],
    /// Rows of J·W, px per world unit.
    rows: [[f32; 3]; 2],
}

impl Jacobian {
    #[inline(always)]
    fn new(view: &View, mean: [f32; 3]) -> Self {
        let d = [mean[0] - view.eye[0], mean[1] - view.eye[1], mean[2] - view.eye[2]];
        let p = [dot(view.rows[0], d), dot(view.rows[1], d), dot(view.rows[2], d)];
        let at = |i: usize| {
            let (low, high) = view.limit[i];
            let ratio = p[i] / p[2];
            let above = if ratio < low { low } else { ratio };
            (if above > high { high } else { above }, (ratio >= low) & (ratio <= high))
        };
        let ((sx, fx), (sy, fy)) = (at(0), at(1));
        let [x, y, z] = view.rows;
        let row = |f: f32, axis: [f32; 3], slope: f32| {
            [
                f * (axis[0] - slope * z[0]),
                f * (axis[1] - slope * z[1]),
                f * (axis[2] - slope * z[2]),
            ]
        };
        let rows = [row(view.focal[0] / p[2], x, sx), row(view.focal[1] / p[2], y, sy)];
        Self { p, slope: [sx, sy], free: [fx, fy], rows }
    }

    /// ∂L/∂mean, world, from ∂L/∂(rows of J·W), ∂L/∂(u, v) and ∂L/∂z.
    #[inline(always)]
    fn mean(&self, view: &View, h: [[f32; 3]; 2], uv: [f32; 2], depth: f32) -> [f32; 3] {
        let z = self.p[2];
        let shifted = 1.0 / (z + view.z_epsilon);
        let inverse = 1.0 / z;
        let mut g = [0.0, 0.0, depth];
        let mut axis = |i: usize| {
            let f = view.focal[i];
            let slope = -f * inverse * dot(h[i], view.rows[2]);
            let slope = if self.free[i] { slope } else { 0.0 };
            let pixel = uv[i] * f * shifted;
            g[i] += pixel + slope * inverse;
            g[2] -= pixel * self.p[i] * shifted
                + inverse * (dot(h[i], self.rows[i]) + slope * self.slope[i]);
        };
        axis(0);
        axis(1);
        let [x, y, z] = view.rows;
        std::array::from_fn(|c| x[c] * g[0] + y[c] * g[1] + z[c] * g[2])
    }
}

/// ∂L/∂(u, v), px⁻¹.
#[inline(always)]
fn pixel_gradient(m: &Moments, w: Whitening) -> [f32; 2] {
    [2.0 * LN_2 * w.a * m.d, 2.0 * LN_2 * (w.b * m.d + w.c * m.s)]
}

/// ∂L/∂Σ with the low-pass, px⁻².
#[inline(always)]
fn covariance_gradient(m: &Moments, Whitening { a, b, c }: Whitening) -> Gradient2d {
    let k = 2.0 * LN_2 * LN_2;
    let skew = b * m.dd + c * m.ds;
    Gradient2d {
        xx: k * a * a * m.dd,
        xy: k * a * skew,
        yy: k * (b * skew + c * (b * m.ds + c * m.ss)),
    }
}

/// The antialiased opacity is o·√(det Σ₀ / det Σ): its share of ∂L/∂Σ.
#[inline(always)]
fn antialiasing(g: &mut Gradient2d, m: &Moments, Whitening { a, b, c }: Whitening) {
    let k = LN_2 * m.one;
    g.xx -= k * a * a;
    g.xy -= k * a * b;
    g.yy -= k * (b * b + c * c);
}

/// Gradients of a splat given by quaternion and σ.
pub(crate) struct QuatGradient {
    pub(crate) mean: [f32; 3],
    pub(crate) quat: [f32; 4],
    pub(crate) scale: [f32; 3],
}

/// Backward of [`View::project`] from quaternions, the opacity's own share (Σ v / o) left out.
#[inline(always)]
pub(crate) fn quat_gradient(
    view: &View,
    mean: [f32; 3],
    quat: [f32; 4],
    scale: [f32; 3],
    w: Whitening,
    m: &Moments,
) -> QuatGradient {
    let j = Jacobian::new(view, mean);
    let [qw, qx, qy, qz] = quat;
    let norm2 = qw * qw + qx * qx + qy * qy + qz * qz;
    let s = 2.0 / norm2;
    // Columns of R.
    let axes = [
        [1.0 - s * (qy * qy + qz * qz), s * (qx * qy + qw * qz), s * (qx * qz - qw * qy)],
        [s * (qx * qy - qw * qz), 1.0 - s * (qx * qx + qz * qz), s * (qy * qz + qw * qx)],
        [s * (qx * qz + qw * qy), s * (qy * qz - qw * qx), 1.0 - s * (qx * qx + qy * qy)],
    ];
    let row = |r: [f32; 3]| [dot(r, axes[0]), dot(r, axes[1]), dot(r, axes[2])];
    let reach = [row(j.rows[0]), row(j.rows[1])];
    // M = J·W·R·S.
    let by_scale = |r: [f32; 3]| [r[0] * scale[0], r[1] * scale[1], r[2] * scale[2]];
    let [m0, m1] = [by_scale(reach[0]), by_scale(reach[1])];
    let mut g = covariance_gradient(m, w);
    let n = cross(m0, m1);
    let mut area = 0.0;
    if view.antialiased {
        antialiasing(&mut g, m, w);
        // ½ ln det Σ₀ = ln ‖m₀ × m₁‖.
        area = m.one / dot(n, n);
    }
    let (a0, a1) = (cross(m1, n), cross(n, m0));
    let mix = |p: f32, q: f32, a: [f32; 3]| {
        let at = |k: usize| 2.0 * (p * m0[k] + q * m1[k]) + area * a[k];
        [at(0), at(1), at(2)]
    };
    // ∂L/∂M.
    let [g0, g1] = [mix(g.xx, g.xy, a0), mix(g.xy, g.yy, a1)];
    let d_scale = |k: usize| g0[k] * reach[0][k] + g1[k] * reach[1][k];
    let row_gradient = |g: [f32; 3]| {
        let at = |c: usize| {
            g[0] * scale[0] * axes[0][c]
                + g[1] * scale[1] * axes[1][c]
                + g[2] * scale[2] * axes[2][c]
        };
        [at(0), at(1), at(2)]
    };
    let h = [row_gradient(g0), row_gradient(g1)];
    // A turn by ω adds ω × (R·S's columns): ∂L/∂ω = Σ h × j, and q moves by ½ (0, ω)·q.
    let (t0, t1) = (cross(h[0], j.rows[0]), cross(h[1], j.rows[1]));
    let t = [t0[0] + t1[0], t0[1] + t1[1], t0[2] + t1[2]];
    let turn = cross(t, [qx, qy, qz]);
    QuatGradient {
        mean: j.mean(view, h, pixel_gradient(m, w), m.z),
        quat: [
            -s * (t[0] * qx + t[1] * qy + t[2] * qz),
            s * (qw * t[0] + turn[0]),
            s * (qw * t[1] + turn[1]),
            s * (qw * t[2] + turn[2]),
        ],
        scale: [d_scale(0), d_scale(1), d_scale(2)],
    }
}

/// Gradients of a splat given by its world covariance.
pub(crate) struct Cov6Gradient {
    pub(crate) mean: [f32; 3],
    pub(crate) cov6: [f32; 6],
}

/// Backward of [`View::project`] from covariances; each off-diagonal number stands for two entries.
#[inline(always)]
pub(crate) fn cov6_gradient(
    view: &View,
    mean: [f32; 3],
    cov6: [f32; 6],
    w: Whitening,
    m: &Moments,
) -> Cov6Gradient {
    let j = Jacobian::new(view, mean);
    let [a, b, c, d, e, f] = cov6.map(f64::from);
    let apply = |v: [f32; 3]| {
        let [x, y, z] = v.map(f64::from);
        [a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z]
    };
    let [j0, j1] = j.rows;
    let (c0, c1) = (apply(j0), apply(j1));
    let mut g = covariance_gradient(m, w);
    if view.antialiased {
        antialiasing(&mut g, m, w);
        let inner = |u: [f32; 3], v: [f64; 3]| {
            f64::from(u[0]) * v[0] + f64::from(u[1]) * v[1] + f64::from(u[2]) * v[2]
        };
        let (xx, xy, yy) = (inner(j0, c0), inner(j0, c1), inner(j1, c1));
        let k = f64::from(0.5 * m.one) / (xx * yy - xy * xy);
        g.xx += (k * yy) as f32;
        g.xy -= (k * xy) as f32;
        g.yy += (k * xx) as f32;
    }
    let rows = |p: f32, q: f32| {
        let at = |k: usize| 2.0 * (p * c0[k] as f32 + q * c1[k] as f32);
        [at(0), at(1), at(2)]
    };
    let h = [rows(g.xx, g.xy), rows(g.xy, g.yy)];
    let entry = |i: usize, k: usize| {
        let cross = j0[i] * j1[k] + j1[i] * j0[k];
        g.xx * j0[i] * j0[k] + g.xy * cross + g.yy * j1[i] * j1[k]
    };
    Cov6Gradient {
        mean: j.mean(view, h, pixel_gradient(m, w), m.z),
        cov6: [
            entry(0, 0),
            2.0 * entry(0, 1),
            2.0 * entry(0, 2),
            entry(1, 1),
            2.0 * entry(1, 2),
            entry(2, 2),
        ],
    }
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
