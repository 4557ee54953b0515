//! SSE2, which every x86-64 processor has: sixteen lanes in four registers, the scalar level
//! of that target. It does the operations of `array` in the same order; written with
//! intrinsics, it takes a third of the compiler's time for arrays of floats.
//!
//! SAFETY of every block below: the target's baseline contains SSE2. Loads and stores go
//! through references to whole arrays, or to places that were checked before.
#![expect(clippy::undocumented_unsafe_blocks, reason = "one reason for all, stated above")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    rows,
};
use std::arch::x86_64::*;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// The token. It proves nothing, since the level always exists.
#[derive(Clone, Copy)]
pub(super) struct Token;

#[derive(Clone, Copy)]
pub(super) struct F([__m128; 4]);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub(super) struct M([__m128; 4]);

#[derive(Clone, Copy)]
pub(super) struct I([__m128i; 4]);

/// `f` of each register. `array::map` makes the compiler work longer.
#[inline(always)]
fn map<T: Copy, R>(v: [T; 4], f: impl Fn(T) -> R) -> [R; 4] {
    [f(v[0]), f(v[1]), f(v[2]), f(v[3])]
}

/// `f` of each pair of registers.
#[inline(always)]
fn zip<T: Copy, R>(a: [T; 4], b: [T; 4], f: impl Fn(T, T) -> R) -> [R; 4] {
    [f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])]
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $intrinsic:ident;)*) => { $(
        impl $op for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(zip(self.0, other.0, |a, b| unsafe { $intrinsic(a, b) }))
            }
        }
    )* };
}

operators! {
    F Add add _mm_add_ps;
    F Sub sub _mm_sub_ps;
    F Mul mul _mm_mul_ps;
    F Div div _mm_div_ps;
    I Add add _mm_add_epi32;
    I Sub sub _mm_sub_epi32;
    I BitAnd bitand _mm_and_si128;
    I BitOr bitor _mm_or_si128;
    I BitXor bitxor _mm_xor_si128;
    M BitAnd bitand _mm_and_ps;
    M BitOr bitor _mm_or_ps;
}

impl Neg for F {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(map(self.0, |v| unsafe { _mm_xor_ps(v, _mm_set1_ps(-0.0)) }))
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(map(self.0, |v| unsafe { _mm_xor_ps(v, _mm_castsi128_ps(_mm_set1_epi32(-1))) }))
    }
}

/// Floor without SSE4.1: the truncated number, less 1 where it is above.
#[inline(always)]
fn floor(v: __m128) -> __m128 {
    /// No fraction exists from 2²³ on.
    const WHOLE: f32 = 8_388_608.0;
    unsafe {
        let sign = _mm_set1_ps(-0.0);
        let whole = _mm_cvtepi32_ps(_mm_cvttps_epi32(v));
        let above = _mm_and_ps(_mm_cmpgt_ps(whole, v), _mm_set1_ps(1.0));
        let below = _mm_sub_ps(whole, above);
        // The floor of −0 is −0.
        let below = _mm_or_ps(_mm_andnot_ps(sign, below), _mm_and_ps(sign, v));
        let small = _mm_cmplt_ps(_mm_andnot_ps(sign, v), _mm_set1_ps(WHOLE));
        select(small, below, v)
    }
}

/// `a` where `mask` has its bits set, `b` elsewhere.
#[inline(always)]
fn select(mask: __m128, a: __m128, b: __m128) -> __m128 {
    unsafe { _mm_or_ps(_mm_and_ps(mask, a), _mm_andnot_ps(mask, b)) }
}

/// 4×4 transpose.
#[inline(always)]
fn transpose4(v: [__m128; 4]) -> [__m128; 4] {
    unsafe {
        let (a, b) = (_mm_unpacklo_ps(v[0], v[1]), _mm_unpackhi_ps(v[0], v[1]));
        let (c, d) = (_mm_unpacklo_ps(v[2], v[3]), _mm_unpackhi_ps(v[2], v[3]));
        [_mm_movelh_ps(a, c), _mm_movehl_ps(c, a), _mm_movelh_ps(b, d), _mm_movehl_ps(d, b)]
    }
}

impl Vector for F {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    const REGISTERS: usize = 4;

    #[inline(always)]
    fn splat(v: f32) -> F {
        F([unsafe { _mm_set1_ps(v) }; 4])
    }
    #[inline(always)]
    fn constant(v: f64) -> F {
        F::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> F {
        F(map([0, 4, 8, 12], |at| unsafe { _mm_loadu_ps(v.as_ptr().add(at)) }))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { _mm_storeu_ps(to.as_mut_ptr().add(4 * i), v) };
        }
    }
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[f32], layout: RowLayout) -> [F; L] {
        rows::load_transposed(Token, rows, layout)
    }
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[F; L], layout: RowLayout, rows: &mut [f32]) {
        rows::store_transposed(Token, from, layout, rows);
    }
    #[inline(always)]
    fn fma(self, b: F, c: F) -> F {
        self * b + c
    }
    #[inline(always)]
    fn fnma(self, b: F, c: F) -> F {
        c - self * b
    }
    #[inline(always)]
    fn max(self, other: F) -> F {
        F(zip(self.0, other.0, |a, b| unsafe { _mm_max_ps(b, a) }))
    }
    #[inline(always)]
    fn min(self, other: F) -> F {
        F(zip(self.0, other.0, |a, b| unsafe { _mm_min_ps(b, a) }))
    }
    #[inline(always)]
    fn sqrt(self) -> F {
        F(map(self.0, |v| unsafe { _mm_sqrt_ps(v) }))
    }
    #[inline(always)]
    fn abs(self) -> F {
        F(map(self.0, |v| unsafe { _mm_andnot_ps(_mm_set1_ps(-0.0), v) }))
    }
    #[inline(always)]
    fn floor(self) -> F {
        F(map(self.0, floor))
    }
    #[inline(always)]
    fn lt(self, other: F) -> M {
        M(zip(self.0, other.0, |a, b| unsafe { _mm_cmplt_ps(a, b) }))
    }
    #[inline(always)]
    fn le(self, other: F) -> M {
        M(zip(self.0, other.0, |a, b| unsafe { _mm_cmple_ps(a, b) }))
    }
    elementary::functions!();
}

impl F32Vector for F {
    type Int = I;

    #[inline(always)]
    fn approx_sqrt(self) -> F {
        self.sqrt()
    }
    #[inline(always)]
    fn neg_abs(self) -> F {
        F(map(self.0, |v| unsafe { _mm_or_ps(v, _mm_set1_ps(-0.0)) }))
    }
    #[inline(always)]
    fn ceil(self) -> F {
        -(-self).floor()
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (F, F) {
        /// 1.5·2²³: a sum with it has no bits for a fraction.
        const ROUND: f32 = 12_582_912.0;
        let n = self + F::splat(ROUND) - F::splat(ROUND);
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: F) -> F {
        F::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(map(self.0, |v| unsafe { _mm_castps_si128(v) }))
    }
    #[inline(always)]
    fn from_bits(v: I) -> F {
        F(map(v.0, |v| unsafe { _mm_castsi128_ps(v) }))
    }
    #[inline(always)]
    fn to_int(self) -> I {
        I(map(self.0, |v| unsafe { _mm_cvttps_epi32(v) }))
    }
    #[inline(always)]
    fn from_int(v: I) -> F {
        F(map(v.0, |v| unsafe { _mm_cvtepi32_ps(v) }))
    }
}

impl Mask<F> for M {
    #[inline(always)]
    fn select(self, a: F, b: F) -> F {
        let mut out = b.0;
        for (i, out) in out.iter_mut().enumerate() {
            *out = select(self.0[i], a.0[i], *out);
        }
        F(out)
    }
    #[inline(always)]
    fn select_or_zero(self, v: F) -> F {
        F(zip(self.0, v.0, |mask, v| unsafe { _mm_and_ps(mask, v) }))
    }
    #[inline(always)]
    fn any(self) -> bool {
        let [a, b, c, d] = self.0;
        unsafe { _mm_movemask_ps(_mm_or_ps(_mm_or_ps(a, b), _mm_or_ps(c, d))) != 0 }
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        let [a, b, c, d] = map(self.0, |v| unsafe { _mm_movemask_ps(v) as u32 });
        a | b << 4 | c << 8 | d << 12
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        I([unsafe { _mm_set1_epi32(v) }; 4])
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { _mm_storeu_si128(to.as_mut_ptr().add(4 * i).cast(), v) };
        }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        // The intrinsic's constant is an i32; Rust cannot convert the generic u32.
        I(map(self.0, |v| unsafe { _mm_sll_epi32(v, _mm_cvtsi32_si128(N as i32)) }))
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        // SSE2 has one count for all lanes.
        let (mut v, mut counts) = ([0; LANES], [0; LANES]);
        self.store(&mut v);
        by.store(&mut counts);
        for (v, by) in v.iter_mut().zip(counts) {
            *v <<= by & 31;
        }
        I(map([0, 4, 8, 12], |at| unsafe { _mm_loadu_si128(v.as_ptr().add(at).cast()) }))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        I(map(self.0, |v| unsafe { _mm_sra_epi32(v, _mm_cvtsi32_si128(N as i32)) }))
    }
}

impl Simd for Token {
    type F = F;
    type M = M;
    type I = I;

    #[inline(never)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }
    #[inline(always)]
    fn store_uninit(self, v: F, to: &mut [MaybeUninit<f32>; LANES]) {
        for (i, v) in v.0.into_iter().enumerate() {
            unsafe { _mm_storeu_ps(to.as_mut_ptr().add(4 * i).cast(), v) };
        }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        let lane = |i: i32| unsafe {
            let bit = _mm_setr_epi32(1 << i, 2 << i, 4 << i, 8 << i);
            let set = _mm_and_si128(_mm_set1_epi32(bits as i32), bit);
            _mm_castsi128_ps(_mm_cmpeq_epi32(set, bit))
        };
        M(map([0, 4, 8, 12], lane))
    }
    #[inline(always)]
    fn prefetch<T>(self, _: *const T) {}
    #[inline(always)]
    fn prefetch_l2<T>(self, _: *const T) {}
    #[inline(always)]
    fn sum(self, v: F) -> f32 {
        let [a, b, c, d] = v.0;
        unsafe {
            let v = _mm_add_ps(_mm_add_ps(a, c), _mm_add_ps(b, d));
            let v = _mm_add_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_add_ss(v, _mm_shuffle_ps::<0x55>(v, v)))
        }
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F; 4] {
        let mut out = [self.splat(0.0); 4];
        if all_inside(from.len(), at, offset) {
            for quarter in 0..4 {
                let rows = map([0, 1, 2, 3], |i| unsafe {
                    _mm_loadu_ps(from.as_ptr().add(offset + at[4 * quarter + i]))
                });
                let columns = transpose4(rows);
                for c in 0..4 {
                    out[c].0[quarter] = columns[c];
                }
            }
        }
        out
    }
    #[inline(always)]
    fn rotate_left(self, v: F) -> F {
        let [a, b, c, d] = v.0;
        F([b, c, d, unsafe { _mm_shuffle_ps::<0x39>(a, a) }])
    }
    #[inline(always)]
    fn rotate_right(self, v: F) -> F {
        let [a, b, c, d] = v.0;
        F([unsafe { _mm_shuffle_ps::<0x93>(d, d) }, a, b, c])
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F; 4]) -> [F; 4] {
        let mut out = v;
        for q in 0..4 {
            let columns = transpose4([v[0].0[q], v[1].0[q], v[2].0[q], v[3].0[q]]);
            for i in 0..4 {
                out[i].0[q] = columns[i];
            }
        }
        out
    }
    #[inline(always)]
    fn deinterleave_quarters(self, a: F, b: F) -> [F; 2] {
        let (a, b) = (a.0, b.0);
        [F([a[0], a[2], b[0], b[2]]), F([a[1], a[3], b[1], b[3]])]
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F, odd: F) -> [F; 2] {
        let (e, o) = (even.0, odd.0);
        [F([e[0], o[0], e[1], o[1]]), F([e[2], o[2], e[3], o[3]])]
    }
    #[inline(always)]
    fn interleave(self, a: F, b: F) -> [F; 2] {
        let low = zip(a.0, b.0, |a, b| unsafe { _mm_unpacklo_ps(a, b) });
        let high = zip(a.0, b.0, |a, b| unsafe { _mm_unpackhi_ps(a, b) });
        [F([low[0], high[0], low[1], high[1]]), F([low[2], high[2], low[3], high[3]])]
    }
    #[inline(always)]
    fn deinterleave(self, a: F, b: F) -> [F; 2] {
        let left = [a.0[0], a.0[2], b.0[0], b.0[2]];
        let right = [a.0[1], a.0[3], b.0[1], b.0[3]];
        let even = zip(left, right, |a, b| unsafe { _mm_shuffle_ps::<0x88>(a, b) });
        [F(even), F(zip(left, right, |a, b| unsafe { _mm_shuffle_ps::<0xdd>(a, b) }))]
    }
    #[inline(always)]
    fn transpose(self, v: [F; LANES]) -> [F; LANES] {
        let mut out = v;
        for rows in 0..4 {
            for q in 0..4 {
                let block = transpose4(map([0, 1, 2, 3], |i| v[4 * rows + i].0[q]));
                for i in 0..4 {
                    out[4 * q + i].0[rows] = block[i];
                }
            }
        }
        out
    }
}
