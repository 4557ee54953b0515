//! Orientation and footprint of one ellipsoid, with gradients.

use super::Rules;
use super::view::{M3, V3, add, axpy, cross, dot, indexed, product, scaled, times, transposed};
use crate::cpu::simd::{Mask, Vector};
use crate::layout::{AMinMode, AREA_SQ_EPS, GROWTH_MAX};

/// θ² below which the derivative of sin(θ/2)/θ comes from its series, radians².
const SERIES_BELOW: f64 = 1.0;

/// Hamilton product, wxyz.
#[inline(always)]
pub(super) fn multiply<V: Vector>(a: [V; 4], b: [V; 4]) -> [V; 4] {
    [
        (a[0] * b[0] - a[1] * b[1]) - (a[2] * b[2] + a[3] * b[3]),
        imaginary(a, b, [1, 2, 3]),
        imaginary(a, b, [2, 3, 1]),
        imaginary(a, b, [3, 1, 2]),
    ]
}

/// Returns the value of the axis with the shortest length, the first of several.
#[inline(always)]
fn of_shortest<V: Vector>([l0, l1, l2]: V3<V>, [a, b, c]: V3<V>) -> V {
    let not_first = l2.lt(l1).select(c, b);
    l1.min(l2).lt(l0).select(not_first, a)
}

/// Component i of the product of two quaternions; i, j, k follow one another cyclically.
#[inline(always)]
fn imaginary<V: Vector>(a: [V; 4], b: [V; 4], [i, j, k]: [usize; 3]) -> V {
    (a[0] * b[i] + a[i] * b[0]) + (a[j] * b[k] - a[k] * b[j])
}

#[inline(always)]
pub(super) fn conjugate<V: Vector>([w, x, y, z]: [V; 4]) -> [V; 4] {
    [w, -x, -y, -z]
}

/// A quaternion divided by its length; zero stays zero.
pub(super) struct Unit<V: Vector> {
    pub(super) q: [V; 4],
    inverse: V,
    free: V::Mask,
}

impl<V: Vector> Unit<V> {
    #[inline(always)]
    pub(super) fn new(q: [V; 4]) -> Self {
        let squared = (q[0] * q[0] + q[1] * q[1]) + (q[2] * q[2] + q[3] * q[3]);
        let least = V::constant(AREA_SQ_EPS);
        let inverse = V::constant(1.0) / squared.max(least).sqrt();
        Self {
            q: [q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse],
            inverse,
            free: least.lt(squared),
        }
    }

    #[inline(always)]
    pub(super) fn backward(&self, d: [V; 4]) -> [V; 4] {
        let q = self.q;
        let along = (q[0] * d[0] + q[1] * d[1]) + (q[2] * d[2] + q[3] * d[3]);
        let along = self.free.select_or_zero(along);
        let s = self.inverse;
        [
            (d[0] - q[0] * along) * s,
            (d[1] - q[1] * along) * s,
            (d[2] - q[2] * along) * s,
            (d[3] - q[3] * along) * s,
        ]
    }
}

/// Rotation matrix (rows) of a unit quaternion wxyz.
#[inline(always)]
pub(super) fn matrix<V: Vector>([w, x, y, z]: [V; 4]) -> M3<V> {
    let (one, two) = (V::constant(1.0), V::constant(2.0));
    let (x2, y2, z2) = (two * x, two * y, two * z);
    let on = |a: V, a2: V, b: V, b2: V| (-a).fma(a2, (-b).fma(b2, one));
    [
        [on(y, y2, z, z2), x * y2 - w * z2, x * z2 + w * y2],
        [x * y2 + w * z2, on(x, x2, z, z2), y * z2 - w * x2],
        [x * z2 - w * y2, y * z2 + w * x2, on(x, x2, y, y2)],
    ]
}

/// Gradient of [`matrix`].
#[inline(always)]
pub(super) fn matrix_backward<V: Vector>([w, x, y, z]: [V; 4], g: &M3<V>) -> [V; 4] {
    let two = V::constant(2.0);
    let sum = |i: usize, j: usize| g[i][j] + g[j][i];
    let turn = [g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]];
    let diagonal = |i: usize, j: usize| two * (g[i][i] + g[j][j]);
    let (xy, xz, yz) = (sum(0, 1), sum(0, 2), sum(1, 2));
    [
        two * dot(turn, [x, y, z]),
        two * (dot([y, z, w], [xy, xz, turn[0]]) - x * diagonal(1, 2)),
        two * (dot([x, z, w], [xy, yz, turn[1]]) - y * diagonal(0, 2)),
        two * (dot([x, y, w], [xz, yz, turn[2]]) - z * diagonal(0, 1)),
    ]
}

/// Quaternion of a rotation vector r, radians.
pub(super) struct Turn<V> {
    pub(super) e: [V; 4],
    r: V3<V>,
    squared: V,
    /// sin(θ/2)/θ.
    sinc: V,
}

impl<V: Vector> Turn<V> {
    #[inline(always)]
    pub(super) fn new(r: V3<V>) -> Self {
        let squared = dot(r, r);
        let small = squared.lt(V::constant(1e-6));
        let theta = squared.max(V::constant(1e-6)).sqrt();
        let half = V::constant(0.5);
        let (sin, cos) = (half * theta).sin_cos();
        let sinc = small.select(squared.fma(V::constant(-0.5 / 24.0), half), sin / theta);
        let w = small.select(squared.fma(V::constant(-0.125), V::constant(1.0)), cos);
        Self { e: [w, sinc * r[0], sinc * r[1], sinc * r[2]], r, squared, sinc }
    }

    #[inline(always)]
    pub(super) fn backward(&self, d: [V; 4]) -> V3<V> {
        let t = self.squared;
        let d_v = [d[1], d[2], d[3]];
        // (½ cos(θ/2) − sinc)/θ², and its series Σ (−1)ⁿ 2n θ²ⁿ⁻² / (2²ⁿ⁺¹ (2n + 1)!).
        let mut series = V::constant(-10.0 / 81_749_606_400.0);
        for c in [8.0 / 185_794_560.0, -6.0 / 645_120.0, 4.0 / 3840.0, -2.0 / 48.0] {
            series = t.fma(series, V::constant(c));
        }
        let direct = (V::constant(0.5) * self.e[0] - self.sinc) / t.max(V::constant(SERIES_BELOW));
        let slope = t.lt(V::constant(SERIES_BELOW)).select(series, direct);
        let along = slope * dot(self.r, d_v) - V::constant(0.5) * self.sinc * d[0];
        axpy(self.sinc, d_v, scaled(self.r, along))
    }
}

/// M = J·R_w2c·R(q)·diag(s), whose M·Mᵀ is the projected covariance.
pub(super) struct Footprint<V> {
    /// J·R_w2c·R(q), two rows.
    turned: [V3<V>; 2],
    pub(super) m: [V3<V>; 2],
    normal: V3<V>,
    /// σ₁σ₂ = √det(M Mᵀ) as the length of m₁ × m₂ (Cauchy-Binet): never negative, exact
    /// for discs seen edge-on.
    pub(super) area: V,
}

/// ∂/∂(J·R_w2c), ∂/∂R(q), ∂/∂s.
pub(super) type FootprintGradient<V> = ([V3<V>; 2], M3<V>, V3<V>);

impl<V: Vector> Footprint<V> {
    #[inline(always)]
    pub(super) fn new(jw: &[V3<V>; 2], rotation: &M3<V>, scale: V3<V>) -> Self {
        let turned = [transposed(rotation, jw[0]), transposed(rotation, jw[1])];
        let m = [product(turned[0], scale), product(turned[1], scale)];
        let normal = cross(m[0], m[1]);
        let area = (dot(normal, normal) + V::constant(AREA_SQ_EPS)).sqrt();
        Self { turned, m, normal, area }
    }

    /// Returns the squared length of each column of M.
    #[inline(always)]
    fn squared_lengths(&self) -> V3<V> {
        let [a, b] = &self.m;
        [a[0].fma(a[0], b[0] * b[0]), a[1].fma(a[1], b[1] * b[1]), a[2].fma(a[2], b[2] * b[2])]
    }

    /// √det(M Mᵀ + low-pass·I) for M's columns times `growth` and the area with it.
    #[inline(always)]
    pub(super) fn blurred(&self, growth: V3<V>, area: V, lowpass: f64) -> V {
        let l = self.squared_lengths();
        let trace = growth[0] * growth[0] * l[0]
            + growth[1] * growth[1] * l[1]
            + growth[2] * growth[2] * l[2];
        let lowpass = V::constant(lowpass);
        area.fma(area, lowpass.fma(trace, lowpass * lowpass)).sqrt()
    }

    /// ∂/∂(area), ∂/∂M of `blurred`, times `d`, for its result `value`.
    #[inline(always)]
    pub(super) fn blurred_backward(
        &self,
        (growth, area, value): (V3<V>, V, V),
        lowpass: f64,
        d: V,
    ) -> (V, [V3<V>; 2]) {
        let each = d / value;
        let by = each * V::constant(lowpass);
        let by = scaled(product(growth, growth), by);
        (each * area, [product(by, self.m[0]), product(by, self.m[1])])
    }

    /// Computes gradients from those of the area and of M (the latter without the area's
    /// part).
    #[inline(always)]
    pub(super) fn backward(
        &self,
        (jw, rotation, scale): (&[V3<V>; 2], &M3<V>, V3<V>),
        d_area: V,
        d_m: [V3<V>; 2],
    ) -> FootprintGradient<V> {
        let n = scaled(self.normal, d_area / self.area);
        let d_m = [add(d_m[0], cross(self.m[1], n)), add(d_m[1], cross(n, self.m[0]))];
        let t = &self.turned;
        let d_scale = add(product(d_m[0], t[0]), product(d_m[1], t[1]));
        let d_turned = [product(d_m[0], scale), product(d_m[1], scale)];
        let d_rotation = indexed(
            d_scale,
            #[inline(always)]
            |c| axpy(jw[1][c], d_turned[1], scaled(d_turned[0], jw[0][c])),
        );
        let d_jw = [times(rotation, d_turned[0]), times(rotation, d_turned[1])];
        (d_jw, d_rotation, d_scale)
    }

    /// Computes factors of the three σ that raise a smaller area to `a_min`.
    #[inline(always)]
    pub(super) fn growth(&self, rules: &Rules) -> V3<V> {
        let area = self.area;
        let (one, most) = (V::constant(1.0), V::constant(GROWTH_MAX));
        if rules.a_min <= 0.0 {
            return [one; 3];
        }
        let a_min = V::constant(rules.a_min);
        let small = area.lt(a_min);
        if rules.a_min_mode == AMinMode::Iso {
            let c = small.select((a_min / area).sqrt().min(most), one);
            return [c; 3];
        }
        let lengths = self.squared_lengths();
        let n = self.normal;
        let s = [n[0] * n[0], n[1] * n[1], n[2] * n[2]];
        // c⁴·p + c²·q = A_min², the root without cancellation.
        let p = of_shortest(lengths, [s[0], s[1], s[2]]);
        let q = of_shortest(lengths, [s[1] + s[2], s[0] + s[2], s[0] + s[1]]);
        let target = a_min * a_min;
        let root = q.fma(q, V::constant(4.0) * p * target).sqrt();
        let c2 = V::constant(2.0) * target / (q + root);
        let c = small.select(c2.sqrt().min(most), one);
        [
            of_shortest(lengths, [one, c, c]),
            of_shortest(lengths, [c, one, c]),
            of_shortest(lengths, [c, c, one]),
        ]
    }
}
