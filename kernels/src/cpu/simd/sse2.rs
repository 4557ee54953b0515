//! SSE2, which every x86-64 processor has: [`super::SimdLevel::Baseline`] of that target.
//! Written with intrinsics, it takes a third of the compiler's time for arrays of floats.

use super::quad::{InstructionSet, Token, instructions};
use std::arch::x86_64::*;

/// The target's baseline.
pub(super) const BASELINE: Token<Sse2> = Token::NEW;

#[derive(Clone, Copy)]
pub(super) struct Sse2;

impl InstructionSet for Sse2 {
    type Float = __m128;
    type Mask = __m128;
    type Int = __m128i;
    /// 16 registers.
    const VECTORS: usize = 4;

    #[inline(always)]
    unsafe fn load(from: *const f32) -> __m128 {
        // SAFETY: the caller guarantees four floats.
        unsafe { _mm_loadu_ps(from) }
    }
    #[inline(always)]
    unsafe fn store(v: __m128, to: *mut f32) {
        // SAFETY: the caller guarantees four places.
        unsafe { _mm_storeu_ps(to, v) }
    }
    #[inline(always)]
    unsafe fn int_store(v: __m128i, to: *mut i32) {
        // SAFETY: the caller guarantees four places.
        unsafe { _mm_storeu_si128(to.cast(), v) }
    }

    instructions! {
        splat(v: f32) -> __m128 = _mm_set1_ps(v);
        add(a: __m128, b: __m128) -> __m128 = _mm_add_ps(a, b);
        sub(a: __m128, b: __m128) -> __m128 = _mm_sub_ps(a, b);
        mul(a: __m128, b: __m128) -> __m128 = _mm_mul_ps(a, b);
        div(a: __m128, b: __m128) -> __m128 = _mm_div_ps(a, b);
        neg(v: __m128) -> __m128 = _mm_xor_ps(v, _mm_set1_ps(-0.0));
        abs(v: __m128) -> __m128 = _mm_andnot_ps(_mm_set1_ps(-0.0), v);
        neg_abs(v: __m128) -> __m128 = _mm_or_ps(v, _mm_set1_ps(-0.0));
        max(a: __m128, b: __m128) -> __m128 = _mm_max_ps(b, a);
        min(a: __m128, b: __m128) -> __m128 = _mm_min_ps(b, a);
        sqrt(v: __m128) -> __m128 = _mm_sqrt_ps(v);
        lt(a: __m128, b: __m128) -> __m128 = _mm_cmplt_ps(a, b);
        le(a: __m128, b: __m128) -> __m128 = _mm_cmple_ps(a, b);
        to_bits(v: __m128) -> __m128i = _mm_castps_si128(v);
        from_bits(v: __m128i) -> __m128 = _mm_castsi128_ps(v);
        to_int(v: __m128) -> __m128i = _mm_cvttps_epi32(v);
        from_int(v: __m128i) -> __m128 = _mm_cvtepi32_ps(v);

        mask_and(a: __m128, b: __m128) -> __m128 = _mm_and_ps(a, b);
        mask_or(a: __m128, b: __m128) -> __m128 = _mm_or_ps(a, b);
        mask_not(v: __m128) -> __m128 = _mm_xor_ps(v, _mm_castsi128_ps(_mm_set1_epi32(-1)));
        mask_any(v: __m128) -> bool = _mm_movemask_ps(v) != 0;
        mask_bits(v: [__m128; 4]) -> u32 = {
            let [a, b, c, d] = v;
            let low = _mm_movemask_ps(a) | _mm_movemask_ps(b) << 4;
            (low | _mm_movemask_ps(c) << 8 | _mm_movemask_ps(d) << 12) as u32
        };
        mask_from_bits<const FIRST>(bits: u32) -> __m128 = {
            let bit = _mm_setr_epi32(1 << FIRST, 2 << FIRST, 4 << FIRST, 8 << FIRST);
            let set = _mm_and_si128(_mm_set1_epi32(bits as i32), bit);
            _mm_castsi128_ps(_mm_cmpeq_epi32(set, bit))
        };
        select(mask: __m128, a: __m128, b: __m128) -> __m128 =
            _mm_or_ps(_mm_and_ps(mask, a), _mm_andnot_ps(mask, b));
        select_or_zero(mask: __m128, v: __m128) -> __m128 = _mm_and_ps(mask, v);

        int_splat(v: i32) -> __m128i = _mm_set1_epi32(v);
        int_add(a: __m128i, b: __m128i) -> __m128i = _mm_add_epi32(a, b);
        int_sub(a: __m128i, b: __m128i) -> __m128i = _mm_sub_epi32(a, b);
        int_and(a: __m128i, b: __m128i) -> __m128i = _mm_and_si128(a, b);
        int_or(a: __m128i, b: __m128i) -> __m128i = _mm_or_si128(a, b);
        int_xor(a: __m128i, b: __m128i) -> __m128i = _mm_xor_si128(a, b);
        // The constant of `_mm_slli_epi32` is an i32; Rust cannot convert the generic u32.
        int_shl<const N>(v: __m128i) -> __m128i = _mm_sll_epi32(v, _mm_cvtsi32_si128(N as i32));
        int_shr<const N>(v: __m128i) -> __m128i = _mm_sra_epi32(v, _mm_cvtsi32_si128(N as i32));

        sum(v: __m128) -> f32 = {
            let v = _mm_add_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_add_ss(v, _mm_shuffle_ps::<0x55>(v, v)))
        };
        rotate_left(v: __m128) -> __m128 = _mm_shuffle_ps::<0x39>(v, v);
        rotate_right(v: __m128) -> __m128 = _mm_shuffle_ps::<0x93>(v, v);
        interleave_low(a: __m128, b: __m128) -> __m128 = _mm_unpacklo_ps(a, b);
        interleave_high(a: __m128, b: __m128) -> __m128 = _mm_unpackhi_ps(a, b);
        even(a: __m128, b: __m128) -> __m128 = _mm_shuffle_ps::<0x88>(a, b);
        odd(a: __m128, b: __m128) -> __m128 = _mm_shuffle_ps::<0xdd>(a, b);
        low_halves(a: __m128, b: __m128) -> __m128 = _mm_movelh_ps(a, b);
        high_halves(a: __m128, b: __m128) -> __m128 = _mm_movehl_ps(b, a);
    }

    /// Floor without SSE4.1: the truncated number, less 1 where it is above.
    #[inline(always)]
    fn floor(v: __m128) -> __m128 {
        /// No fraction exists from 2²³ on.
        const WHOLE: f32 = 8_388_608.0;
        let whole = Self::from_int(Self::to_int(v));
        let above = Self::select_or_zero(Self::lt(v, whole), Self::splat(1.0));
        let below = Self::sub(whole, above);
        // The floor of −0 is −0.
        let sign = Self::splat(-0.0);
        let below = Self::select(sign, v, below);
        let small = Self::lt(Self::abs(v), Self::splat(WHOLE));
        Self::select(small, below, v)
    }
    #[inline(always)]
    fn ceil(v: __m128) -> __m128 {
        Self::neg(Self::floor(Self::neg(v)))
    }
    #[inline(always)]
    fn round(v: __m128) -> __m128 {
        // 1.5·2²³: a sum with it has no bits for a fraction.
        let shift = Self::splat(12_582_912.0);
        Self::sub(Self::add(v, shift), shift)
    }
}
