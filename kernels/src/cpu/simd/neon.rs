//! NEON, which every AArch64 processor has: [`super::SimdLevel::Neon`] where products and sums
//! round once, [`super::SimdLevel::Baseline`] of that target where they round twice.

use super::quad::{InstructionSet, Token, instructions};
use std::arch::aarch64::*;
use std::arch::asm;

/// The target's baseline: products round separately.
pub(super) const BASELINE: Token<Neon<false>> = Token::NEW;
/// Products and sums round once.
pub(super) const FUSED: Token<Neon<true>> = Token::NEW;

/// `FUSED`: products and sums round once; else twice.
#[derive(Clone, Copy)]
pub(super) struct Neon<const FUSED: bool>;

impl<const FUSED: bool> InstructionSet for Neon<FUSED> {
    type Float = float32x4_t;
    type Mask = uint32x4_t;
    type Int = int32x4_t;
    /// 32 registers.
    const VECTORS: usize = 8;

    #[inline(always)]
    unsafe fn load(from: *const f32) -> float32x4_t {
        // SAFETY: the caller guarantees four floats.
        unsafe { vld1q_f32(from) }
    }
    #[inline(always)]
    unsafe fn store(v: float32x4_t, to: *mut f32) {
        // SAFETY: the caller guarantees four places.
        unsafe { vst1q_f32(to, v) }
    }
    #[inline(always)]
    unsafe fn int_store(v: int32x4_t, to: *mut i32) {
        // SAFETY: the caller guarantees four places.
        unsafe { vst1q_s32(to, v) }
    }

    instructions! {
        splat(v: f32) -> float32x4_t = vdupq_n_f32(v);
        add(a: float32x4_t, b: float32x4_t) -> float32x4_t = vaddq_f32(a, b);
        sub(a: float32x4_t, b: float32x4_t) -> float32x4_t = vsubq_f32(a, b);
        mul(a: float32x4_t, b: float32x4_t) -> float32x4_t = vmulq_f32(a, b);
        div(a: float32x4_t, b: float32x4_t) -> float32x4_t = vdivq_f32(a, b);
        fma(a: float32x4_t, b: float32x4_t, c: float32x4_t) -> float32x4_t =
            if FUSED { vfmaq_f32(c, a, b) } else { vaddq_f32(vmulq_f32(a, b), c) };
        fnma(a: float32x4_t, b: float32x4_t, c: float32x4_t) -> float32x4_t =
            if FUSED { vfmsq_f32(c, a, b) } else { vsubq_f32(c, vmulq_f32(a, b)) };
        neg(v: float32x4_t) -> float32x4_t = vnegq_f32(v);
        abs(v: float32x4_t) -> float32x4_t = vabsq_f32(v);
        neg_abs(v: float32x4_t) -> float32x4_t = vnegq_f32(vabsq_f32(v));
        // The processor's own maximum and minimum treat NaN and −0 otherwise.
        max(a: float32x4_t, b: float32x4_t) -> float32x4_t = vbslq_f32(vcgtq_f32(b, a), b, a);
        min(a: float32x4_t, b: float32x4_t) -> float32x4_t = vbslq_f32(vcltq_f32(b, a), b, a);
        sqrt(v: float32x4_t) -> float32x4_t = vsqrtq_f32(v);
        // The estimate has 8 bits; one of Newton's steps doubles them.
        approx_sqrt(v: float32x4_t) -> float32x4_t = {
            let estimate = vrsqrteq_f32(v);
            let root = vmulq_f32(v, estimate);
            vmulq_f32(root, vrsqrtsq_f32(root, estimate))
        };
        floor(v: float32x4_t) -> float32x4_t = vrndmq_f32(v);
        ceil(v: float32x4_t) -> float32x4_t = vrndpq_f32(v);
        round(v: float32x4_t) -> float32x4_t = vrndnq_f32(v);
        lt(a: float32x4_t, b: float32x4_t) -> uint32x4_t = vcltq_f32(a, b);
        le(a: float32x4_t, b: float32x4_t) -> uint32x4_t = vcleq_f32(a, b);
        to_bits(v: float32x4_t) -> int32x4_t = vreinterpretq_s32_f32(v);
        from_bits(v: int32x4_t) -> float32x4_t = vreinterpretq_f32_s32(v);
        to_int(v: float32x4_t) -> int32x4_t = vcvtq_s32_f32(v);
        from_int(v: int32x4_t) -> float32x4_t = vcvtq_f32_s32(v);

        mask_and(a: uint32x4_t, b: uint32x4_t) -> uint32x4_t = vandq_u32(a, b);
        mask_or(a: uint32x4_t, b: uint32x4_t) -> uint32x4_t = vorrq_u32(a, b);
        mask_not(v: uint32x4_t) -> uint32x4_t = vmvnq_u32(v);
        mask_any(v: uint32x4_t) -> bool = vmaxvq_u32(v) != 0;
        // Each lane keeps its own bit of a register, and each register its quarter.
        mask_bits(v: [uint32x4_t; 4]) -> u32 = {
            let a = vandq_u32(v[0], lane_bits::<0>());
            let b = vandq_u32(v[1], lane_bits::<4>());
            let c = vandq_u32(v[2], lane_bits::<8>());
            let d = vandq_u32(v[3], lane_bits::<12>());
            vaddvq_u32(vorrq_u32(vorrq_u32(a, b), vorrq_u32(c, d)))
        };
        mask_from_bits<const FIRST>(bits: u32) -> uint32x4_t =
            vtstq_u32(vdupq_n_u32(bits), lane_bits::<FIRST>());
        select(mask: uint32x4_t, a: float32x4_t, b: float32x4_t) -> float32x4_t =
            vbslq_f32(mask, a, b);
        select_or_zero(mask: uint32x4_t, v: float32x4_t) -> float32x4_t =
            vreinterpretq_f32_u32(vandq_u32(mask, vreinterpretq_u32_f32(v)));

        int_splat(v: i32) -> int32x4_t = vdupq_n_s32(v);
        int_add(a: int32x4_t, b: int32x4_t) -> int32x4_t = vaddq_s32(a, b);
        int_sub(a: int32x4_t, b: int32x4_t) -> int32x4_t = vsubq_s32(a, b);
        int_and(a: int32x4_t, b: int32x4_t) -> int32x4_t = vandq_s32(a, b);
        int_or(a: int32x4_t, b: int32x4_t) -> int32x4_t = vorrq_s32(a, b);
        int_xor(a: int32x4_t, b: int32x4_t) -> int32x4_t = veorq_s32(a, b);
        // The constant of `vshlq_n_s32` is an i32; Rust cannot convert the generic u32.
        int_shl<const N>(v: int32x4_t) -> int32x4_t = vshlq_s32(v, vdupq_n_s32(N as i32));
        int_shl_each(v: int32x4_t, by: int32x4_t) -> int32x4_t = vshlq_s32(v, by);
        // A negative count shifts to the right.
        int_shr<const N>(v: int32x4_t) -> int32x4_t = vshlq_s32(v, vdupq_n_s32(-(N as i32)));

        sum(v: float32x4_t) -> f32 = vpadds_f32(vadd_f32(vget_low_f32(v), vget_high_f32(v)));
        add_pairs(a: float32x4_t, b: float32x4_t) -> float32x4_t = vpaddq_f32(a, b);
        rotate_left(v: float32x4_t) -> float32x4_t = vextq_f32::<1>(v, v);
        rotate_right(v: float32x4_t) -> float32x4_t = vextq_f32::<3>(v, v);
        interleave_low(a: float32x4_t, b: float32x4_t) -> float32x4_t = vzip1q_f32(a, b);
        interleave_high(a: float32x4_t, b: float32x4_t) -> float32x4_t = vzip2q_f32(a, b);
        even(a: float32x4_t, b: float32x4_t) -> float32x4_t = vuzp1q_f32(a, b);
        odd(a: float32x4_t, b: float32x4_t) -> float32x4_t = vuzp2q_f32(a, b);
        low_halves(a: float32x4_t, b: float32x4_t) -> float32x4_t = vreinterpretq_f32_f64(
            vzip1q_f64(vreinterpretq_f64_f32(a), vreinterpretq_f64_f32(b))
        );
        high_halves(a: float32x4_t, b: float32x4_t) -> float32x4_t = vreinterpretq_f32_f64(
            vzip2q_f64(vreinterpretq_f64_f32(a), vreinterpretq_f64_f32(b))
        );
    }

    // The intrinsics of prefetches are unstable. The instructions read no memory that a program
    // sees.
    #[inline(always)]
    fn prefetch(v: *const u8) {
        // SAFETY: any address is allowed.
        unsafe {
            asm!(
                "prfm pldl1keep, [{}]",
                in(reg) v.addr(),
                options(nomem, nostack, preserves_flags)
            );
        }
    }
    #[inline(always)]
    fn prefetch_l2(v: *const u8) {
        // SAFETY: any address is allowed.
        unsafe {
            asm!(
                "prfm pldl2keep, [{}]",
                in(reg) v.addr(),
                options(nomem, nostack, preserves_flags)
            );
        }
    }
}

/// Bits `FIRST` to `FIRST` + 3, one in each lane.
#[inline(always)]
fn lane_bits<const FIRST: u32>() -> uint32x4_t {
    // SAFETY: the array has four integers; every processor of the target has NEON.
    unsafe { vld1q_u32([1 << FIRST, 2 << FIRST, 4 << FIRST, 8 << FIRST].as_ptr()) }
}
