//! Elementary functions of `f32` lanes: one source for every level and for single numbers.
//!
//! Each function is good to a few ulp (bounds below, held by tests on every level). None
//! branches on a lane, so that loops over single numbers vectorize. Coefficients: Cephes
//! (`expf`, `logf`, `sinf`, `cosf`), Eigen (`erf`), Remez' algorithm (`exp2`, `log2`).
//!
//! `exp` returns 0 for arguments below −87.3, so softmax produces no denormals. The processor's
//! flush-to-zero bits stay unset, because Rust code may not run under another floating-point environment.

use super::{F32Vector, IntVector, LANES, Mask};
use std::f32::consts::{FRAC_1_SQRT_2, FRAC_2_PI, LOG2_E};

/// Implements the elementary functions of [`super::Vector`] by those of this module.
macro_rules! functions {
    () => {
        #[inline(always)]
        fn exp(self) -> Self {
            $crate::cpu::simd::elementary::exp(self)
        }
        #[inline(always)]
        fn exp_m1(self) -> Self {
            $crate::cpu::simd::elementary::exp_m1(self)
        }
        #[inline(always)]
        fn tanh(self) -> Self {
            $crate::cpu::simd::elementary::tanh(self)
        }
        #[inline(always)]
        fn ln(self) -> Self {
            $crate::cpu::simd::elementary::ln(self)
        }
        #[inline(always)]
        fn log2(self) -> Self {
            $crate::cpu::simd::elementary::log2(self)
        }
        #[inline(always)]
        fn ln_1p(self) -> Self {
            $crate::cpu::simd::elementary::ln_1p(self)
        }
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            $crate::cpu::simd::elementary::sin_cos(self)
        }
    };
}
pub(super) use functions;

/// 1.5·2²³: a sum with it is rounded to a whole number, which stands in the low bits of the
/// sum's mantissa.
const ROUND: f32 = 12_582_912.0;
/// Least argument of [`exp`] whose result is not 0: e^−87.3 is a normal number.
const EXP_MIN: f32 = -87.3;
/// Greatest argument of [`exp`]; greater ones give its result.
const EXP_MAX: f32 = 88.0;
/// ln 2 in two parts: products of the first with a whole exponent are exact.
const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
/// π/2 in three parts: products of the first two with a quadrant's number are exact.
const HALF_PI: [f32; 3] = [1.570_312_5, 4.837_513e-4, 7.549_79e-8];
/// [`sin_cos`] takes the standard library's functions for arguments above.
const SIN_COS_MAX: f32 = 8192.0;

/// Evaluates a polynomial whose coefficients are given from the highest power down.
#[inline(always)]
fn polynomial<V: F32Vector, const N: usize>(x: V, coefficients: [f32; N]) -> V {
    let mut sum = V::splat(coefficients[0]);
    for &c in &coefficients[1..] {
        sum = sum.fma(x, V::splat(c));
    }
    sum
}

/// (p, 2ⁿ) with eˣ = 2ⁿ(1 + p), |p| < 0.42, for x clamped to [`EXP_MIN`], [`EXP_MAX`].
#[inline(always)]
fn exp_parts<V: F32Vector>(x: V) -> (V, V) {
    exp_parts_in_range(x.max(V::splat(EXP_MIN)).min(V::splat(EXP_MAX)))
}

/// [`exp_parts`] of [`EXP_MIN`] ≤ x ≤ [`EXP_MAX`].
#[inline(always)]
fn exp_parts_in_range<V: F32Vector>(x: V) -> (V, V) {
    let shifted = x.fma(V::splat(LOG2_E), V::splat(ROUND));
    let n = shifted - V::splat(ROUND);
    let r = n.fma(V::splat(-LN_2[0]), x);
    let r = n.fma(V::splat(-LN_2[1]), r);
    let q = polynomial(
        r,
        [1.987_569_1e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5],
    );
    let biased = shifted.to_bits() - V::Int::splat(ROUND.to_bits() as i32 - 127);
    ((q * r).fma(r, r), V::from_bits(biased.shl::<23>()))
}

/// eˣ to 2 ulp for −87.3 ≤ x ≤ 88; 0 below, so that no denormal arises; e⁸⁸ above; NaN for
/// NaN.
#[inline(always)]
pub(crate) fn exp<V: F32Vector>(x: V) -> V {
    let (p, scale) = exp_parts(x);
    // A factor of 0, while the polynomial is computed: no selection follows the product.
    let scale = x.lt(V::splat(EXP_MIN)).select(V::splat(0.0), scale);
    // The sum first: p·2ⁿ alone may be denormal.
    (p + V::splat(1.0)) * scale
}

/// eˣ − 1 to 4 ulp; −1 below −87.3, e⁸⁸ above 88, NaN for NaN.
#[inline(always)]
pub(crate) fn exp_m1<V: F32Vector>(x: V) -> V {
    let (p, scale) = exp_parts(x);
    p.fma(scale, scale - V::splat(1.0))
}

/// tanh x to 4 ulp.
#[inline(always)]
pub(crate) fn tanh<V: F32Vector>(x: V) -> V {
    let (p, scale) = exp_parts_in_range((x + x).max(V::splat(EXP_MIN)).min(V::splat(30.0)));
    let e = p.fma(scale, scale - V::splat(1.0));
    e / (e + V::splat(2.0))
}

/// 2^p to 2 ulp for −125 ≤ p ≤ 126, any number elsewhere.
#[inline(always)]
pub(crate) fn exp2<V: F32Vector>(p: V) -> V {
    let (n, f) = p.round_and_fraction();
    exp2_fraction(f).scale_by_power_of_two(n)
}

/// 2^p as [`exp2`], and NaN for NaN, without the instructions that round and scale: they
/// take the ports of multiplications, which limit softmax and SiLU.
#[inline(always)]
pub(crate) fn exp2_by_sums<V: F32Vector>(p: V) -> V {
    // 127 is the exponent's bias.
    let round = V::splat(ROUND + 127.0);
    let shifted = p + round;
    let f = p - (shifted - round);
    exp2_fraction(f) * V::from_bits(shifted.to_bits().shl::<23>())
}

/// 2^f on [−½, ½]: a minimax polynomial (relative error 7.5e-8).
#[inline(always)]
fn exp2_fraction<V: F32Vector>(f: V) -> V {
    polynomial(
        f,
        [1.327_647_2e-3, 9.675_541e-3, 0.055_507_13, 0.240_221_2, 0.693_146_94, 1.000_000_1],
    )
}

/// (e, t) with x = 2ᵉ(1 + t), t in [√½ − 1, √2 − 1), for positive normal x.
#[inline(always)]
fn exponent_and_mantissa<V: F32Vector>(x: V) -> (V, V) {
    let bits = x.to_bits();
    let e = (bits - V::Int::splat(FRAC_1_SQRT_2.to_bits() as i32)).shr::<23>();
    (V::from_int(e), V::from_bits(bits - e.shl::<23>()) - V::splat(1.0))
}

/// `x` where it is infinite or NaN, else `v`.
#[inline(always)]
fn unless_finite<V: F32Vector>(x: V, v: V) -> V {
    x.lt(V::splat(f32::INFINITY)).select(v, x)
}

/// ln x of positive normal x to 2 ulp; ∞ and NaN stay.
#[inline(always)]
pub(crate) fn ln<V: F32Vector>(x: V) -> V {
    let (e, t) = exponent_and_mantissa(x);
    let p = polynomial(
        t,
        [
            7.037_683_6e-2,
            -1.151_461e-1,
            1.167_699_9e-1,
            -1.242_014_1e-1,
            1.424_932_3e-1,
            -1.666_805_8e-1,
            2.000_071_5e-1,
            -2.499_999_4e-1,
            3.333_333e-1,
        ],
    );
    let z = t * t;
    let p = z.fma(p * t, z * V::splat(-0.5));
    let low = e.fma(V::splat(LN_2[1]), p);
    unless_finite(x, e.fma(V::splat(LN_2[0]), t + low))
}

/// log₂ x of positive normal x to 3 ulp or 1e-7, whichever is more; ∞ and NaN stay. The
/// polynomial is a minimax approximation of log₂(1 + t) / t (relative error 2.6e-8).
#[inline(always)]
pub(crate) fn log2<V: F32Vector>(x: V) -> V {
    let (e, t) = exponent_and_mantissa(x);
    let p = polynomial(
        t,
        [
            0.125_837_06,
            -0.207_269_76,
            0.215_715_6,
            -0.238_944_82,
            0.287_916_25,
            -0.360_703_68,
            0.480_910_64,
            -0.721_347_35,
            LOG2_E,
        ],
    );
    unless_finite(x, p.fma(t, e))
}

/// ln(1 + x) to 4 ulp for x > −1.
#[inline(always)]
pub(crate) fn ln_1p<V: F32Vector>(x: V) -> V {
    let one = V::splat(1.0);
    let u = one + x;
    ln(u) + (x - (u - one)) / u
}

/// Sine and cosine to 4 ulp, or to 1.5e-7 near their zeros; radians.
#[inline(always)]
pub(crate) fn sin_cos<V: F32Vector>(x: V) -> (V, V) {
    let shifted = x.fma(V::splat(FRAC_2_PI), V::splat(ROUND));
    let n = shifted - V::splat(ROUND);
    let r = n.fma(V::splat(-HALF_PI[0]), x);
    let r = n.fma(V::splat(-HALF_PI[1]), r);
    let r = n.fma(V::splat(-HALF_PI[2]), r);
    let z = r * r;
    let sin = polynomial(z, [-1.951_529_6e-4, 8.332_161e-3, -1.666_665_5e-1]);
    let sin = sin.fma(z * r, r);
    let cos = polynomial(z, [2.443_315_7e-5, -1.388_731_6e-3, 4.166_664_6e-2]);
    let cos = (z * z).fma(cos, z.fma(V::splat(-0.5), V::splat(1.0)));
    let quadrant = shifted.to_bits();
    let one = V::Int::splat(1);
    let odd = V::splat(0.5).lt(V::from_int(quadrant & one));
    let near_sin = with_sign_of_quadrant(odd.select(cos, sin), quadrant);
    let near_cos = with_sign_of_quadrant(odd.select(sin, cos), quadrant + one);
    let far = V::splat(SIN_COS_MAX).lt(x.abs());
    if !far.any() {
        return (near_sin, near_cos);
    }
    let mut lanes = [0.0; LANES];
    x.store(&mut lanes);
    let [far_sin, far_cos] = sin_cos_far(lanes);
    (far.select(V::load(&far_sin), near_sin), far.select(V::load(&far_cos), near_cos))
}

/// `v`, negated in quadrants 2 and 3.
#[inline(always)]
fn with_sign_of_quadrant<V: F32Vector>(v: V, quadrant: V::Int) -> V {
    V::from_bits(v.to_bits() ^ (quadrant & V::Int::splat(2)).shl::<30>())
}

#[cold]
#[inline(never)]
fn sin_cos_far(x: [f32; LANES]) -> [[f32; LANES]; 2] {
    [x.map(f32::sin), x.map(f32::cos)]
}

/// Error function to 4 ulp: an odd rational approximation on |x| ≤ 4, ±1 beyond.
#[inline(always)]
pub(crate) fn erf<V: F32Vector>(x: V) -> V {
    let x = x.max(V::splat(-4.0)).min(V::splat(4.0));
    let z = x * x;
    let p = polynomial(
        z,
        [
            -2.726_142_3e-10,
            2.770_681_4e-8,
            -2.101_024e-6,
            -5.692_506_4e-5,
            -7.349_906_3e-4,
            -2.954_6e-3,
            -1.609_603_4e-2,
        ],
    );
    let q = polynomial(
        z,
        [-1.456_607_2e-5, -2.133_740_6e-4, -1.682_827e-3, -7.373_329e-3, -1.426_473_9e-2],
    );
    x * p / q
}
