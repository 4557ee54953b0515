//! Vectors of `f32` and their elementary functions, each good to a few ulp.
//! Coefficients: Cephes (`expf`, `logf`, `sinf`, `cosf`).

use super::{Lanes, Machine, WIDTH_MAX, load_rows, store_rows};
use pulp::Simd;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A processor's vectors, at most 16 lanes of `f32`.
#[derive(Clone, Copy)]
pub(super) struct Vectors<S>(pub(super) S);

/// One vector.
#[derive(Clone, Copy)]
pub(super) struct Vector<S: Simd> {
    s: S,
    v: S::f32s,
}

impl<S: Simd> Machine for Vectors<S> {
    type Scalar = f32;
    type V = Vector<S>;
    const WIDTH: usize = S::F32_LANES;
    #[inline(always)]
    fn splat(self, v: f32) -> Vector<S> {
        Vector { s: self.0, v: self.0.splat_f32s(v) }
    }
    #[inline(always)]
    fn load(self, from: &[f32; WIDTH_MAX]) -> Vector<S> {
        Vector { s: self.0, v: S::as_simd_f32s(from).0[0] }
    }
    #[inline(always)]
    fn store(self, v: Vector<S>, to: &mut [f32; WIDTH_MAX]) {
        S::as_mut_simd_f32s(to).0[0] = v.v;
    }
    #[inline(always)]
    fn load_rows<const L: usize>(
        self,
        rows: &[f32],
        (stride, count): (usize, usize),
    ) -> [Vector<S>; L] {
        #[cfg(target_arch = "x86_64")]
        if is_avx512::<S>() {
            // SAFETY: a value of this `S` exists only where AVX-512 does.
            if let Some(columns) = unsafe { super::transpose::load(rows, L, (stride, count)) } {
                let mut out = [self.of(0.0); L];
                for (out, column) in out.iter_mut().zip(&columns) {
                    // SAFETY: both are 16 `f32` (`is_avx512`).
                    out.v = unsafe { std::mem::transmute_copy(column) };
                }
                return out;
            }
        }
        load_rows(self, rows, (stride, count))
    }
    #[inline(always)]
    fn store_rows<const L: usize>(
        self,
        from: &[Vector<S>; L],
        (stride, count): (usize, usize),
        rows: &mut [f32],
    ) {
        #[cfg(target_arch = "x86_64")]
        if is_avx512::<S>() {
            // SAFETY: all zeros is a vector of 16 `f32`.
            let mut columns: [std::arch::x86_64::__m512; 16] = unsafe { std::mem::zeroed() };
            for (column, v) in columns.iter_mut().zip(from) {
                // SAFETY: both are 16 `f32` (`is_avx512`).
                *column = unsafe { std::mem::transmute_copy(&v.v) };
            }
            // SAFETY: a value of this `S` exists only where AVX-512 does.
            if unsafe { super::transpose::store(columns, L, (stride, count), rows) } {
                return;
            }
        }
        store_rows(self, from, (stride, count), rows);
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn is_avx512<S: Simd>() -> bool {
    std::any::TypeId::of::<S>() == std::any::TypeId::of::<pulp::x86::V4>()
}

macro_rules! operator {
    ($op:ident, $name:ident, $call:ident) => {
        impl<S: Simd> $op for Vector<S> {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self { s: self.s, v: self.s.$call(self.v, other.v) }
            }
        }
    };
}
operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

impl<S: Simd> Neg for Vector<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { s: self.s, v: self.s.neg_f32s(self.v) }
    }
}

/// 1.5·2²³: adding it rounds to an integer that stands in the low mantissa bits.
const MAGIC: f32 = 12_582_912.0;
/// Arguments of sine and cosine above this go to the library, lane by lane.
const REDUCIBLE: f32 = 8192.0;

impl<S: Simd> Vector<S> {
    #[inline(always)]
    fn c(self, v: f32) -> Self {
        Self { s: self.s, v: self.s.splat_f32s(v) }
    }

    #[inline(always)]
    fn bits(self) -> S::u32s {
        self.s.transmute_u32s_f32s(self.v)
    }

    #[inline(always)]
    fn with_bits(self, bits: S::u32s) -> Self {
        Self { s: self.s, v: self.s.transmute_f32s_u32s(bits) }
    }

    /// Σ coefficients·xⁱ, highest first.
    #[inline(always)]
    fn polynomial<const N: usize>(self, coefficients: [f32; N]) -> Self {
        let mut p = self.c(coefficients[0]);
        for &c in &coefficients[1..] {
            p = p.fma(self, self.c(c));
        }
        p
    }

    /// (p, 2ⁿ) with eˣ = 2ⁿ(1 + p), |p| < 0.42; x counts as at most 88 and at least
    /// −87.3.
    #[inline(always)]
    fn exp_parts(self) -> (Self, Self) {
        let x = self.max(self.c(-87.3)).min(self.c(88.0));
        let shifted = x.fma(self.c(std::f32::consts::LOG2_E), self.c(MAGIC));
        let n = shifted - self.c(MAGIC);
        let r = n.fma(self.c(-0.693_359_4), x);
        let r = n.fma(self.c(2.121_944_4e-4), r);
        let p = r.polynomial([
            1.987_569_1e-4,
            1.398_199_9e-3,
            8.333_452e-3,
            4.166_579_6e-2,
            1.666_666_5e-1,
            0.5,
        ]);
        let s = self.s;
        let biased = s.sub_u32s(shifted.bits(), s.splat_u32s(MAGIC.to_bits().wrapping_sub(127)));
        let scale = self.with_bits(s.wrapping_dyn_shl_u32s(biased, s.splat_u32s(23)));
        (p.fma(r * r, r), scale)
    }

    /// (e, f, p) with x = 2ᵉ(1 + f), f in [√½ − 1, √2 − 1], ln(1 + f) = f + p.
    #[inline(always)]
    fn log_parts(self) -> (Self, Self, Self) {
        // bits(√½), and what brings it to an exponent of exactly 128.
        const ROOT: u32 = 0x3f35_04f3;
        const SHIFT: u32 = 0x4000_0000 - ROOT;
        let s = self.s;
        let u = s.add_u32s(self.bits(), s.splat_u32s(SHIFT));
        let exponent = s.wrapping_dyn_shr_u32s(u, s.splat_u32s(23));
        let e = self.with_bits(s.or_u32s(exponent, s.splat_u32s(0x4b00_0000)))
            - self.c(8_388_608.0 + 128.0);
        let mantissa = s.and_u32s(u, s.splat_u32s(0x007f_ffff));
        let f = self.with_bits(s.add_u32s(mantissa, s.splat_u32s(ROOT))) - self.c(1.0);
        let p = f.polynomial([
            7.037_683_6e-2,
            -1.151_461e-1,
            1.167_699_9e-1,
            -1.242_014_1e-1,
            1.424_932_3e-1,
            -1.666_805_8e-1,
            2.000_071_5e-1,
            -2.499_999_4e-1,
            3.333_333e-1,
        ]);
        let z = f * f;
        (e, f, z.fma(p * f, z * self.c(-0.5)))
    }

    /// `self` where it is infinite or NaN, else `v`.
    #[inline(always)]
    fn finite_or_self(self, v: Self) -> Self {
        Self::select(self.lt(self.c(f32::INFINITY)), v, self)
    }

    #[cold]
    #[inline(never)]
    fn sin_cos_far(x: [f32; WIDTH_MAX]) -> [[f32; WIDTH_MAX]; 2] {
        [x.map(f32::sin), x.map(f32::cos)]
    }
}

impl<S: Simd> Lanes for Vector<S> {
    type Mask = S::m32s;

    #[inline(always)]
    fn of(self, v: f64) -> Self {
        self.c(v as f32)
    }

    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        Self { s: self.s, v: self.s.mul_add_e_f32s(self.v, b.v, c.v) }
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // x86 gives the second operand where either is NaN.
        Self { s: self.s, v: self.s.max_f32s(other.v, self.v) }
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self { s: self.s, v: self.s.min_f32s(other.v, self.v) }
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Self { s: self.s, v: self.s.sqrt_f32s(self.v) }
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Self { s: self.s, v: self.s.abs_f32s(self.v) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        let rounded = (self + self.c(MAGIC)) - self.c(MAGIC);
        rounded - Self::select(self.lt(rounded), self.c(1.0), self.c(0.0))
    }

    #[inline(always)]
    fn lt(self, other: Self) -> S::m32s {
        self.s.less_than_f32s(self.v, other.v)
    }

    #[inline(always)]
    fn select(mask: S::m32s, a: Self, b: Self) -> Self {
        Self { s: a.s, v: a.s.select_f32s(mask, a.v, b.v) }
    }

    #[inline(always)]
    fn exp(self) -> Self {
        let (p, scale) = self.exp_parts();
        p.fma(scale, scale)
    }

    #[inline(always)]
    fn exp_m1(self) -> Self {
        let (p, scale) = self.exp_parts();
        p.fma(scale, scale - self.c(1.0))
    }

    #[inline(always)]
    fn tanh(self) -> Self {
        let e = (self + self).min(self.c(30.0)).exp_m1();
        e / (e + self.c(2.0))
    }

    #[inline(always)]
    fn ln(self) -> Self {
        let (e, f, p) = self.log_parts();
        let low = e.fma(self.c(-2.121_944_4e-4), p);
        self.finite_or_self(e.fma(self.c(0.693_359_4), f + low))
    }

    #[inline(always)]
    fn log2(self) -> Self {
        let (e, f, p) = self.log_parts();
        self.finite_or_self((f + p).fma(self.c(std::f32::consts::LOG2_E), e))
    }

    #[inline(always)]
    fn ln_1p(self) -> Self {
        let one = self.c(1.0);
        let u = one + self;
        u.ln() + (self - (u - one)) / u
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let s = self.s;
        let shifted = self.fma(self.c(std::f32::consts::FRAC_2_PI), self.c(MAGIC));
        let n = shifted - self.c(MAGIC);
        // π/2 in three parts of few bits (Cephes' π/4, doubled).
        let r = n.fma(self.c(-1.570_312_5), self);
        let r = n.fma(self.c(-4.837_513e-4), r);
        let r = n.fma(self.c(-7.549_79e-8), r);
        let z = r * r;
        let sin = z.polynomial([-1.951_529_6e-4, 8.332_161e-3, -1.666_665_5e-1]);
        let sin = sin.fma(z * r, r);
        let cos = z.polynomial([2.443_315_7e-5, -1.388_731_6e-3, 4.166_664_6e-2]);
        let cos = (z * z).fma(cos, z.fma(self.c(-0.5), self.c(1.0)));
        let quadrant = shifted.bits();
        let one = s.splat_u32s(1);
        let odd = s.equal_u32s(s.and_u32s(quadrant, one), one);
        let sign = |q: S::u32s| {
            let bit = s.and_u32s(q, s.splat_u32s(2));
            s.wrapping_dyn_shl_u32s(bit, s.splat_u32s(30))
        };
        let flip = |v: Self, q: S::u32s| v.with_bits(s.xor_u32s(v.bits(), sign(q)));
        let near = (
            flip(Self::select(odd, cos, sin), quadrant),
            flip(Self::select(odd, sin, cos), s.add_u32s(quadrant, one)),
        );
        let far = self.c(REDUCIBLE).lt(self.abs());
        if s.reduce_max_f32s(Self::select(far, self.c(1.0), self.c(0.0)).v) == 0.0 {
            return near;
        }
        let m = Vectors(s);
        let mut x = [0.0; WIDTH_MAX];
        m.store(self, &mut x);
        let [sin, cos] = Self::sin_cos_far(x);
        (Self::select(far, m.load(&sin), near.0), Self::select(far, m.load(&cos), near.1))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Kernel, LaneReal};
    use super::*;

    type Elementary = [fn(f64) -> f64; 8];

    struct All<'a>(&'a [f32]);

    impl Kernel<f32> for All<'_> {
        type Output = Vec<[f32; 8]>;
        #[inline(always)]
        fn run<M: Machine<Scalar = f32>>(self, m: M) -> Vec<[f32; 8]> {
            let mut out = Vec::new();
            for &x in self.0 {
                let v = m.splat(x);
                let (sin, cos) = v.sin_cos();
                let of = [
                    v.exp(),
                    v.exp_m1(),
                    v.tanh(),
                    sin,
                    cos,
                    v.abs().ln(),
                    v.abs().log2(),
                    // Opacities: −1 < x ≤ 0.
                    (-(v.abs() / (v.abs() + m.of(0.001))).min(m.of(0.9999))).ln_1p(),
                ];
                out.push(of.map(|v| {
                    let mut lanes = [0.0; WIDTH_MAX];
                    m.store(v, &mut lanes);
                    assert!(lanes[..M::WIDTH].iter().all(|l| l.to_bits() == lanes[0].to_bits()));
                    lanes[0]
                }));
            }
            out
        }
    }

    #[test]
    fn elementary_functions_are_good_to_a_few_ulp() {
        let names = ["exp", "expm1", "tanh", "sin", "cos", "ln", "log2", "ln1p"];
        let want: Elementary = [
            f64::exp,
            f64::exp_m1,
            f64::tanh,
            f64::sin,
            f64::cos,
            |x| x.abs().ln(),
            |x| x.abs().log2(),
            f64::ln_1p,
        ];
        let near = (-8700..=8700).filter(|&i| i != 0).map(|i| i as f32 * 0.01);
        let small = (0..400).map(|i| (i as f32 * -0.07).exp() * if i % 2 == 0 { 1. } else { -1. });
        let far = [1e4f32, -3e5, 1e9, -8191.7].into_iter();
        let x: Vec<f32> = near.chain(small).chain(far).collect();
        for (x, got) in x.iter().zip(f32::dispatch(All(&x))) {
            for (i, name) in names.iter().enumerate() {
                if x.abs() > 87.2 && i < 2 {
                    continue;
                }
                // ln(1 + x) down to the largest optical depth that occurs, x = -0.9999.
                let at = if i == 7 { -(x.abs() / (x.abs() + 0.001)).min(0.9999) } else { *x };
                let want = want[i](f64::from(at));
                // Next to a zero of sine, cosine or logarithm the error is absolute.
                let floor = if (3..7).contains(&i) { 0.3 } else { 1e-30 };
                let error = (f64::from(got[i]) - want).abs() / want.abs().max(floor);
                assert!(error < 5e-7, "{name}({at}): {} for {want}, {error:e}", got[i]);
            }
        }
    }

    #[test]
    fn not_a_number_stays_one() {
        let got = f32::dispatch(All(&[f32::NAN]));
        assert!(got[0].iter().all(|v| v.is_nan()), "{got:?}");
        let zero = f32::dispatch(All(&[0.0]))[0];
        assert_eq!(zero[..5], [1.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(f32::dispatch(All(&[-40.0]))[0][2], -1.0);
        assert_eq!(f32::dispatch(All(&[40.0]))[0][2], 1.0);
    }
}
