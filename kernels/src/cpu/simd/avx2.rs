//! AVX2 and FMA: sixteen lanes in two registers.
//!
//! SAFETY of every block below: the intrinsics need x86-64-v3. A [`Token`] exists in
//! [`run`] only, whose caller checked the processor, and the vector types are reachable
//! through it only. Loads and stores go through references to whole arrays, or to places
//! that were checked before.
#![expect(clippy::undocumented_unsafe_blocks, reason = "one reason for all, stated above")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    rows,
};
use std::arch::x86_64::*;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// Proof that the processor has x86-64-v3.
#[derive(Clone, Copy)]
pub(super) struct Token(());

#[derive(Clone, Copy)]
pub(super) struct F(__m256, __m256);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub(super) struct M(__m256, __m256);

#[derive(Clone, Copy)]
pub(super) struct I(__m256i, __m256i);

/// Returns whether the processor has the features that [`run`] needs.
pub(super) fn detected() -> bool {
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("fma")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("lzcnt")
        && is_x86_feature_detected!("popcnt")
}

/// Runs `kernel` compiled for x86-64-v3.
///
/// # Safety
/// [`detected`] returned true.
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
pub(super) unsafe fn run<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Token(()))
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $intrinsic:ident;)*) => { $(
        impl $op for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                unsafe { Self($intrinsic(self.0, other.0), $intrinsic(self.1, other.1)) }
            }
        }
    )* };
}

operators! {
    F Add add _mm256_add_ps;
    F Sub sub _mm256_sub_ps;
    F Mul mul _mm256_mul_ps;
    F Div div _mm256_div_ps;
    I Add add _mm256_add_epi32;
    I Sub sub _mm256_sub_epi32;
    I BitAnd bitand _mm256_and_si256;
    I BitOr bitor _mm256_or_si256;
    I BitXor bitxor _mm256_xor_si256;
    M BitAnd bitand _mm256_and_ps;
    M BitOr bitor _mm256_or_ps;
}

impl Neg for F {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            F(_mm256_xor_ps(self.0, sign), _mm256_xor_ps(self.1, sign))
        }
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        unsafe {
            let all = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
            M(_mm256_xor_ps(self.0, all), _mm256_xor_ps(self.1, all))
        }
    }
}

/// Sum of eight lanes: i + (i + 4), then + 2, + 1.
#[inline(always)]
#[allow(dead_code, reason = "called by `sum`, which not every build uses")]
pub(super) unsafe fn sum8(v: __m256) -> f32 {
    unsafe {
        let v = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
        let v = _mm_add_ps(v, _mm_movehl_ps(v, v));
        _mm_cvtss_f32(_mm_add_ss(v, _mm_movehdup_ps(v)))
    }
}

impl Vector for F {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(v: f32) -> F {
        let v = unsafe { _mm256_set1_ps(v) };
        F(v, v)
    }
    #[inline(always)]
    fn constant(v: f64) -> F {
        F::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> F {
        unsafe { F(_mm256_loadu_ps(v.as_ptr()), _mm256_loadu_ps(v.as_ptr().add(8))) }
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        unsafe {
            _mm256_storeu_ps(to.as_mut_ptr(), self.0);
            _mm256_storeu_ps(to.as_mut_ptr().add(8), self.1);
        }
    }
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[f32], layout: RowLayout) -> [F; L] {
        rows::load_transposed(Token(()), rows, layout)
    }
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[F; L], layout: RowLayout, rows: &mut [f32]) {
        rows::store_transposed(Token(()), from, layout, rows);
    }
    #[inline(always)]
    fn fma(self, b: F, c: F) -> F {
        unsafe { F(_mm256_fmadd_ps(self.0, b.0, c.0), _mm256_fmadd_ps(self.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn fnma(self, b: F, c: F) -> F {
        unsafe { F(_mm256_fnmadd_ps(self.0, b.0, c.0), _mm256_fnmadd_ps(self.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn max(self, other: F) -> F {
        unsafe { F(_mm256_max_ps(other.0, self.0), _mm256_max_ps(other.1, self.1)) }
    }
    #[inline(always)]
    fn min(self, other: F) -> F {
        unsafe { F(_mm256_min_ps(other.0, self.0), _mm256_min_ps(other.1, self.1)) }
    }
    #[inline(always)]
    fn sqrt(self) -> F {
        unsafe { F(_mm256_sqrt_ps(self.0), _mm256_sqrt_ps(self.1)) }
    }
    #[inline(always)]
    fn abs(self) -> F {
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            F(_mm256_andnot_ps(sign, self.0), _mm256_andnot_ps(sign, self.1))
        }
    }
    #[inline(always)]
    fn floor(self) -> F {
        unsafe { F(_mm256_floor_ps(self.0), _mm256_floor_ps(self.1)) }
    }
    #[inline(always)]
    fn lt(self, other: F) -> M {
        unsafe {
            M(
                _mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0),
                _mm256_cmp_ps::<_CMP_LT_OQ>(self.1, other.1),
            )
        }
    }
    #[inline(always)]
    fn le(self, other: F) -> M {
        unsafe {
            M(
                _mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0),
                _mm256_cmp_ps::<_CMP_LE_OQ>(self.1, other.1),
            )
        }
    }
    elementary::functions!();
}

impl F32Vector for F {
    type Int = I;

    #[inline(always)]
    fn approx_sqrt(self) -> F {
        unsafe {
            F(
                _mm256_mul_ps(self.0, _mm256_rsqrt_ps(self.0)),
                _mm256_mul_ps(self.1, _mm256_rsqrt_ps(self.1)),
            )
        }
    }
    #[inline(always)]
    fn neg_abs(self) -> F {
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            F(_mm256_or_ps(self.0, sign), _mm256_or_ps(self.1, sign))
        }
    }
    #[inline(always)]
    fn ceil(self) -> F {
        unsafe { F(_mm256_ceil_ps(self.0), _mm256_ceil_ps(self.1)) }
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (F, F) {
        const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;
        let n =
            unsafe { F(_mm256_round_ps::<NEAREST>(self.0), _mm256_round_ps::<NEAREST>(self.1)) };
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: F) -> F {
        F::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        unsafe { I(_mm256_castps_si256(self.0), _mm256_castps_si256(self.1)) }
    }
    #[inline(always)]
    fn from_bits(v: I) -> F {
        unsafe { F(_mm256_castsi256_ps(v.0), _mm256_castsi256_ps(v.1)) }
    }
    #[inline(always)]
    fn to_int(self) -> I {
        unsafe { I(_mm256_cvttps_epi32(self.0), _mm256_cvttps_epi32(self.1)) }
    }
    #[inline(always)]
    fn from_int(v: I) -> F {
        unsafe { F(_mm256_cvtepi32_ps(v.0), _mm256_cvtepi32_ps(v.1)) }
    }
}

impl Mask<F> for M {
    #[inline(always)]
    fn select(self, a: F, b: F) -> F {
        unsafe { F(_mm256_blendv_ps(b.0, a.0, self.0), _mm256_blendv_ps(b.1, a.1, self.1)) }
    }
    #[inline(always)]
    fn select_or_zero(self, v: F) -> F {
        unsafe { F(_mm256_and_ps(self.0, v.0), _mm256_and_ps(self.1, v.1)) }
    }
    #[inline(always)]
    fn any(self) -> bool {
        unsafe { _mm256_movemask_ps(_mm256_or_ps(self.0, self.1)) != 0 }
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        unsafe { _mm256_movemask_ps(self.0) as u32 | (_mm256_movemask_ps(self.1) as u32) << 8 }
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        let v = unsafe { _mm256_set1_epi32(v) };
        I(v, v)
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        unsafe {
            _mm256_storeu_si256(to.as_mut_ptr().cast(), self.0);
            _mm256_storeu_si256(to.as_mut_ptr().add(8).cast(), self.1);
        }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        // The intrinsic's constant is an i32; Rust cannot convert the generic u32.
        let n = N as i32;
        unsafe {
            let n = _mm_cvtsi32_si128(n);
            I(_mm256_sll_epi32(self.0, n), _mm256_sll_epi32(self.1, n))
        }
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        unsafe { I(_mm256_sllv_epi32(self.0, by.0), _mm256_sllv_epi32(self.1, by.1)) }
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        let n = N as i32;
        unsafe {
            let n = _mm_cvtsi32_si128(n);
            I(_mm256_sra_epi32(self.0, n), _mm256_sra_epi32(self.1, n))
        }
    }
}

impl Simd for Token {
    type F = F;
    type M = M;
    type I = I;

    #[inline(always)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        unsafe { run(kernel) }
    }
    #[inline(always)]
    fn store_uninit(self, v: F, to: &mut [MaybeUninit<f32>; LANES]) {
        let to: *mut f32 = to.as_mut_ptr().cast();
        unsafe {
            _mm256_storeu_ps(to, v.0);
            _mm256_storeu_ps(to.add(8), v.1);
        }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        unsafe {
            let bits = _mm256_set1_epi32(bits as i32);
            let low = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let high = _mm256_slli_epi32::<8>(low);
            M(
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(bits, low), low)),
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(bits, high), high)),
            )
        }
    }
    #[inline(always)]
    fn prefetch<T>(self, v: *const T) {
        unsafe { _mm_prefetch::<_MM_HINT_T0>(v.cast()) }
    }
    #[inline(always)]
    fn prefetch_l2<T>(self, v: *const T) {
        unsafe { _mm_prefetch::<_MM_HINT_T1>(v.cast()) }
    }
    #[inline(always)]
    fn sum(self, v: F) -> f32 {
        unsafe { sum8(_mm256_add_ps(v.0, v.1)) }
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F; 4] {
        if !all_inside(from.len(), at, offset) {
            return [self.splat(0.0); 4];
        }
        unsafe {
            let p = from.as_ptr().add(offset);
            let mut halves = [[_mm256_setzero_ps(); 4]; 2];
            for (h, half) in halves.iter_mut().enumerate() {
                for i in 0..4 {
                    let low = _mm_loadu_ps(p.add(at[8 * h + i]));
                    let high = _mm_loadu_ps(p.add(at[8 * h + i + 4]));
                    half[i] = _mm256_set_m128(high, low);
                }
                *half = transpose4(*half);
            }
            let [low, high] = halves;
            [F(low[0], high[0]), F(low[1], high[1]), F(low[2], high[2]), F(low[3], high[3])]
        }
    }
    #[inline(always)]
    unsafe fn load_masked(self, from: *const f32, bits: u16) -> F {
        unsafe {
            if bits == u16::MAX {
                return self.load(&*from.cast());
            }
            let lanes = self.mask_from_bits(u32::from(bits));
            let low = _mm256_maskload_ps(from, _mm256_castps_si256(lanes.0));
            let high = _mm256_castps_si256(lanes.1);
            F(low, _mm256_maskload_ps(from.wrapping_add(8), high))
        }
    }
    #[inline(always)]
    unsafe fn store_masked(self, v: F, to: *mut MaybeUninit<f32>, bits: u16) {
        unsafe {
            let lanes = self.mask_from_bits(u32::from(bits));
            let to = to.cast::<f32>();
            _mm256_maskstore_ps(to, _mm256_castps_si256(lanes.0), v.0);
            _mm256_maskstore_ps(to.wrapping_add(8), _mm256_castps_si256(lanes.1), v.1);
        }
    }
    #[inline(always)]
    fn rotate_left(self, v: F) -> F {
        unsafe {
            // Quarters 1, 2, 3, and quarter 0 rotated by one lane.
            let low = _mm256_permute2f128_ps::<0x21>(v.0, v.1);
            let high = _mm256_permute2f128_ps::<0x03>(v.0, v.1);
            let rotated = _mm256_permute_ps::<0x39>(high);
            F(low, _mm256_blend_ps::<0xf0>(high, rotated))
        }
    }
    #[inline(always)]
    fn rotate_right(self, v: F) -> F {
        unsafe {
            let low = _mm256_permute2f128_ps::<0x03>(v.0, v.1);
            let high = _mm256_permute2f128_ps::<0x21>(v.0, v.1);
            let rotated = _mm256_permute_ps::<0x93>(low);
            F(_mm256_blend_ps::<0x0f>(low, rotated), high)
        }
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F; 4]) -> [F; 4] {
        unsafe {
            let low = transpose4([v[0].0, v[1].0, v[2].0, v[3].0]);
            let high = transpose4([v[0].1, v[1].1, v[2].1, v[3].1]);
            [F(low[0], high[0]), F(low[1], high[1]), F(low[2], high[2]), F(low[3], high[3])]
        }
    }
    #[inline(always)]
    fn deinterleave_quarters(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let [a, c] = halves(a.0, a.1);
            let [b, d] = halves(b.0, b.1);
            [F(a, b), F(c, d)]
        }
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F, odd: F) -> [F; 2] {
        unsafe {
            let [a, b] = halves(even.0, odd.0);
            let [c, d] = halves(even.1, odd.1);
            [F(a, b), F(c, d)]
        }
    }
    #[inline(always)]
    fn interleave(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let [p, q] = halves(_mm256_unpacklo_ps(a.0, b.0), _mm256_unpackhi_ps(a.0, b.0));
            let [r, t] = halves(_mm256_unpacklo_ps(a.1, b.1), _mm256_unpackhi_ps(a.1, b.1));
            [F(p, q), F(r, t)]
        }
    }
    #[inline(always)]
    fn deinterleave(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let [a, c] = halves(a.0, a.1);
            let [b, d] = halves(b.0, b.1);
            let even = F(_mm256_shuffle_ps::<0x88>(a, c), _mm256_shuffle_ps::<0x88>(b, d));
            [even, F(_mm256_shuffle_ps::<0xdd>(a, c), _mm256_shuffle_ps::<0xdd>(b, d))]
        }
    }
    #[inline(always)]
    fn transpose(self, v: [F; LANES]) -> [F; LANES] {
        unsafe {
            let mut out = v;
            for h in 0..2 {
                let mut left = [v[0].0; 8];
                let mut right = [v[0].0; 8];
                for i in 0..8 {
                    left[i] = v[8 * h + i].0;
                    right[i] = v[8 * h + i].1;
                }
                let left = transpose8(left);
                let right = transpose8(right);
                for i in 0..8 {
                    if h == 0 {
                        out[i].0 = left[i];
                        out[8 + i].0 = right[i];
                    } else {
                        out[i].1 = left[i];
                        out[8 + i].1 = right[i];
                    }
                }
            }
            out
        }
    }
}

/// The first halves of `a` and `b`, and the second halves.
#[inline(always)]
unsafe fn halves(a: __m256, b: __m256) -> [__m256; 2] {
    unsafe { [_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b)] }
}

/// 4×4 transposes inside each 128-bit part.
#[inline(always)]
unsafe fn transpose4(v: [__m256; 4]) -> [__m256; 4] {
    unsafe {
        let a = _mm256_unpacklo_ps(v[0], v[1]);
        let b = _mm256_unpackhi_ps(v[0], v[1]);
        let c = _mm256_unpacklo_ps(v[2], v[3]);
        let d = _mm256_unpackhi_ps(v[2], v[3]);
        [
            _mm256_shuffle_ps::<0x44>(a, c),
            _mm256_shuffle_ps::<0xee>(a, c),
            _mm256_shuffle_ps::<0x44>(b, d),
            _mm256_shuffle_ps::<0xee>(b, d),
        ]
    }
}

#[inline(always)]
unsafe fn transpose8(v: [__m256; 8]) -> [__m256; 8] {
    unsafe {
        let low = transpose4([v[0], v[1], v[2], v[3]]);
        let high = transpose4([v[4], v[5], v[6], v[7]]);
        let mut out = low;
        let mut upper = high;
        for i in 0..4 {
            out[i] = _mm256_permute2f128_ps::<0x20>(low[i], high[i]);
            upper[i] = _mm256_permute2f128_ps::<0x31>(low[i], high[i]);
        }
        [out[0], out[1], out[2], out[3], upper[0], upper[1], upper[2], upper[3]]
    }
}
