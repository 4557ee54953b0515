//! WebAssembly's simd128: [`super::SimdLevel::Baseline`] of that target where the build enables it
//! (`.cargo/config.toml`). A module that contains these instructions does not load where they are
//! missing, so that a level chosen at run time would serve nobody. The compiler alone leaves many
//! loops over arrays of floats without vectors.

use super::quad::{InstructionSet, Token, instructions};
use std::arch::wasm32::*;

/// The target's baseline.
pub(super) const BASELINE: Token<Simd128> = Token::NEW;

#[derive(Clone, Copy)]
pub(super) struct Simd128;

impl InstructionSet for Simd128 {
    type Float = v128;
    type Mask = v128;
    type Int = v128;
    /// Engines map these registers to those of the machine, most of which have 16.
    const VECTORS: usize = 4;

    #[inline(always)]
    unsafe fn load(from: *const f32) -> v128 {
        // SAFETY: the caller guarantees four floats.
        unsafe { v128_load(from.cast()) }
    }
    #[inline(always)]
    unsafe fn store(v: v128, to: *mut f32) {
        // SAFETY: the caller guarantees four places.
        unsafe { v128_store(to.cast(), v) }
    }
    #[inline(always)]
    unsafe fn int_store(v: v128, to: *mut i32) {
        // SAFETY: the caller guarantees four places.
        unsafe { v128_store(to.cast(), v) }
    }

    instructions! {
        splat(v: f32) -> v128 = f32x4_splat(v);
        add(a: v128, b: v128) -> v128 = f32x4_add(a, b);
        sub(a: v128, b: v128) -> v128 = f32x4_sub(a, b);
        mul(a: v128, b: v128) -> v128 = f32x4_mul(a, b);
        div(a: v128, b: v128) -> v128 = f32x4_div(a, b);
        neg(v: v128) -> v128 = f32x4_neg(v);
        abs(v: v128) -> v128 = f32x4_abs(v);
        neg_abs(v: v128) -> v128 = v128_or(v, f32x4_splat(-0.0));
        max(a: v128, b: v128) -> v128 = f32x4_pmax(a, b);
        min(a: v128, b: v128) -> v128 = f32x4_pmin(a, b);
        sqrt(v: v128) -> v128 = f32x4_sqrt(v);
        floor(v: v128) -> v128 = f32x4_floor(v);
        ceil(v: v128) -> v128 = f32x4_ceil(v);
        round(v: v128) -> v128 = f32x4_nearest(v);
        lt(a: v128, b: v128) -> v128 = f32x4_lt(a, b);
        le(a: v128, b: v128) -> v128 = f32x4_le(a, b);
        to_bits(v: v128) -> v128 = v;
        from_bits(v: v128) -> v128 = v;
        to_int(v: v128) -> v128 = i32x4_trunc_sat_f32x4(v);
        from_int(v: v128) -> v128 = f32x4_convert_i32x4(v);

        mask_and(a: v128, b: v128) -> v128 = v128_and(a, b);
        mask_or(a: v128, b: v128) -> v128 = v128_or(a, b);
        mask_not(v: v128) -> v128 = v128_not(v);
        mask_any(v: v128) -> bool = v128_any_true(v);
        mask_bits(v: [v128; 4]) -> u32 = {
            let [a, b, c, d] = v;
            let low = i32x4_bitmask(a) | i32x4_bitmask(b) << 4;
            u32::from(low) | u32::from(i32x4_bitmask(c)) << 8 | u32::from(i32x4_bitmask(d)) << 12
        };
        mask_from_bits<const FIRST>(bits: u32) -> v128 = {
            let bit = i32x4(1 << FIRST, 2 << FIRST, 4 << FIRST, 8 << FIRST);
            i32x4_eq(v128_and(i32x4_splat(bits as i32), bit), bit)
        };
        select(mask: v128, a: v128, b: v128) -> v128 = v128_bitselect(a, b, mask);
        select_or_zero(mask: v128, v: v128) -> v128 = v128_and(mask, v);

        int_splat(v: i32) -> v128 = i32x4_splat(v);
        int_add(a: v128, b: v128) -> v128 = i32x4_add(a, b);
        int_sub(a: v128, b: v128) -> v128 = i32x4_sub(a, b);
        int_and(a: v128, b: v128) -> v128 = v128_and(a, b);
        int_or(a: v128, b: v128) -> v128 = v128_or(a, b);
        int_xor(a: v128, b: v128) -> v128 = v128_xor(a, b);
        int_shl<const N>(v: v128) -> v128 = i32x4_shl(v, N);
        int_shr<const N>(v: v128) -> v128 = i32x4_shr(v, N);

        sum(v: v128) -> f32 = {
            let v = f32x4_add(v, i32x4_shuffle::<2, 3, 2, 3>(v, v));
            f32x4_extract_lane::<0>(v) + f32x4_extract_lane::<1>(v)
        };
        rotate_left(v: v128) -> v128 = i32x4_shuffle::<1, 2, 3, 0>(v, v);
        rotate_right(v: v128) -> v128 = i32x4_shuffle::<3, 0, 1, 2>(v, v);
        interleave_low(a: v128, b: v128) -> v128 = i32x4_shuffle::<0, 4, 1, 5>(a, b);
        interleave_high(a: v128, b: v128) -> v128 = i32x4_shuffle::<2, 6, 3, 7>(a, b);
        even(a: v128, b: v128) -> v128 = i32x4_shuffle::<0, 2, 4, 6>(a, b);
        odd(a: v128, b: v128) -> v128 = i32x4_shuffle::<1, 3, 5, 7>(a, b);
        low_halves(a: v128, b: v128) -> v128 = i32x4_shuffle::<0, 1, 4, 5>(a, b);
        high_halves(a: v128, b: v128) -> v128 = i32x4_shuffle::<2, 3, 6, 7>(a, b);
    }
}
