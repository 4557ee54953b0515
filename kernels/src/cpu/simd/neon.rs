//! NEON, which every AArch64 processor has: sixteen lanes in four registers. Fused products
//! make the level `Neon`. Products that round separately make the scalar level of that target,
//! which does the operations of `array` in the same order.
//!
//! SAFETY of every block below: the target's baseline contains NEON. Loads and stores go
//! through references to whole arrays, or to places that were checked before.
#![expect(clippy::undocumented_unsafe_blocks, reason = "one reason for all, stated above")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    rows,
};
use std::arch::aarch64::*;
use std::arch::asm;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// The token. It proves nothing, since the level always exists. `FUSED`: products and sums
/// round once; else twice.
#[derive(Clone, Copy)]
pub(super) struct Token<const FUSED: bool>;

#[derive(Clone, Copy)]
pub(super) struct F<const FUSED: bool>([float32x4_t; 4]);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub(super) struct M([uint32x4_t; 4]);

#[derive(Clone, Copy)]
pub(super) struct I([int32x4_t; 4]);

/// `f` of each register.
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
    ($($op:ident $method:ident $intrinsic:ident;)*) => { $(
        impl<const FUSED: bool> $op for F<FUSED> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(zip(self.0, other.0, |a, b| unsafe { $intrinsic(a, b) }))
            }
        }
    )* };
}

macro_rules! bit_operators {
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
    Add add vaddq_f32;
    Sub sub vsubq_f32;
    Mul mul vmulq_f32;
    Div div vdivq_f32;
}

bit_operators! {
    I Add add vaddq_s32;
    I Sub sub vsubq_s32;
    I BitAnd bitand vandq_s32;
    I BitOr bitor vorrq_s32;
    I BitXor bitxor veorq_s32;
    M BitAnd bitand vandq_u32;
    M BitOr bitor vorrq_u32;
}

impl<const FUSED: bool> Neg for F<FUSED> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(map(self.0, |v| unsafe { vnegq_f32(v) }))
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(map(self.0, |v| unsafe { vmvnq_u32(v) }))
    }
}

/// The first halves of `a` and `b`, and the second halves.
#[inline(always)]
fn halves(a: float32x4_t, b: float32x4_t) -> [float32x4_t; 2] {
    unsafe {
        let (a, b) = (vreinterpretq_f64_f32(a), vreinterpretq_f64_f32(b));
        [vreinterpretq_f32_f64(vzip1q_f64(a, b)), vreinterpretq_f32_f64(vzip2q_f64(a, b))]
    }
}

/// 4×4 transpose.
#[inline(always)]
fn transpose4(v: [float32x4_t; 4]) -> [float32x4_t; 4] {
    unsafe {
        let [a, c] = halves(vtrn1q_f32(v[0], v[1]), vtrn1q_f32(v[2], v[3]));
        let [b, d] = halves(vtrn2q_f32(v[0], v[1]), vtrn2q_f32(v[2], v[3]));
        [a, b, c, d]
    }
}

/// Sum of the registers: lane i + (i + 8), then + 4.
#[inline(always)]
fn quarters_sum([a, b, c, d]: [float32x4_t; 4]) -> float32x4_t {
    unsafe { vaddq_f32(vaddq_f32(a, c), vaddq_f32(b, d)) }
}

impl<const FUSED: bool> Vector for F<FUSED> {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    /// 32 registers of four floats.
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(v: f32) -> Self {
        F([unsafe { vdupq_n_f32(v) }; 4])
    }
    #[inline(always)]
    fn constant(v: f64) -> Self {
        F::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> Self {
        F(map([0, 4, 8, 12], |at| unsafe { vld1q_f32(v.as_ptr().add(at)) }))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { vst1q_f32(to.as_mut_ptr().add(4 * i), v) };
        }
    }
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[f32], layout: RowLayout) -> [Self; L] {
        rows::load_transposed(Token::<FUSED>, rows, layout)
    }
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[Self; L], layout: RowLayout, rows: &mut [f32]) {
        rows::store_transposed(Token::<FUSED>, from, layout, rows);
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        if !FUSED {
            return self * b + c;
        }
        let mut out = c.0;
        for (i, out) in out.iter_mut().enumerate() {
            *out = unsafe { vfmaq_f32(*out, self.0[i], b.0[i]) };
        }
        F(out)
    }
    #[inline(always)]
    fn fnma(self, b: Self, c: Self) -> Self {
        if !FUSED {
            return c - self * b;
        }
        let mut out = c.0;
        for (i, out) in out.iter_mut().enumerate() {
            *out = unsafe { vfmsq_f32(*out, self.0[i], b.0[i]) };
        }
        F(out)
    }
    // The processor's own maximum and minimum treat NaN and −0 otherwise.
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        F(zip(self.0, other.0, |a, b| unsafe { vbslq_f32(vcgtq_f32(b, a), b, a) }))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        F(zip(self.0, other.0, |a, b| unsafe { vbslq_f32(vcltq_f32(b, a), b, a) }))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        F(map(self.0, |v| unsafe { vsqrtq_f32(v) }))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        F(map(self.0, |v| unsafe { vabsq_f32(v) }))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        F(map(self.0, |v| unsafe { vrndmq_f32(v) }))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M {
        M(zip(self.0, other.0, |a, b| unsafe { vcltq_f32(a, b) }))
    }
    #[inline(always)]
    fn le(self, other: Self) -> M {
        M(zip(self.0, other.0, |a, b| unsafe { vcleq_f32(a, b) }))
    }
    elementary::functions!();
}

impl<const FUSED: bool> F32Vector for F<FUSED> {
    type Int = I;

    /// The estimate has 8 bits; one of Newton's steps doubles them.
    #[inline(always)]
    fn approx_sqrt(self) -> Self {
        F(map(self.0, |v| unsafe {
            let estimate = vrsqrteq_f32(v);
            let root = vmulq_f32(v, estimate);
            vmulq_f32(root, vrsqrtsq_f32(root, estimate))
        }))
    }
    #[inline(always)]
    fn neg_abs(self) -> Self {
        F(map(self.0, |v| unsafe { vnegq_f32(vabsq_f32(v)) }))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        F(map(self.0, |v| unsafe { vrndpq_f32(v) }))
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (Self, Self) {
        let n = F(map(self.0, |v| unsafe { vrndnq_f32(v) }));
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: Self) -> Self {
        F::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(map(self.0, |v| unsafe { vreinterpretq_s32_f32(v) }))
    }
    #[inline(always)]
    fn from_bits(v: I) -> Self {
        F(map(v.0, |v| unsafe { vreinterpretq_f32_s32(v) }))
    }
    #[inline(always)]
    fn to_int(self) -> I {
        I(map(self.0, |v| unsafe { vcvtq_s32_f32(v) }))
    }
    #[inline(always)]
    fn from_int(v: I) -> Self {
        F(map(v.0, |v| unsafe { vcvtq_f32_s32(v) }))
    }
}

impl<const FUSED: bool> Mask<F<FUSED>> for M {
    #[inline(always)]
    fn select(self, a: F<FUSED>, b: F<FUSED>) -> F<FUSED> {
        let mut out = b.0;
        for (i, out) in out.iter_mut().enumerate() {
            *out = unsafe { vbslq_f32(self.0[i], a.0[i], *out) };
        }
        F(out)
    }
    #[inline(always)]
    fn select_or_zero(self, v: F<FUSED>) -> F<FUSED> {
        let mut out = v.0;
        for (i, out) in out.iter_mut().enumerate() {
            let bits = unsafe { vandq_u32(self.0[i], vreinterpretq_u32_f32(*out)) };
            *out = unsafe { vreinterpretq_f32_u32(bits) };
        }
        F(out)
    }
    #[inline(always)]
    fn any(self) -> bool {
        let [a, b, c, d] = self.0;
        unsafe { vmaxvq_u32(vorrq_u32(vorrq_u32(a, b), vorrq_u32(c, d))) != 0 }
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        let [a, b, c, d] = self.0;
        unsafe {
            // Each lane keeps its own bit of a register, and each register its quarter.
            let lane = vld1q_u32([1, 2, 4, 8].as_ptr());
            let low = vorrq_u32(vandq_u32(a, lane), vandq_u32(b, vshlq_n_u32::<4>(lane)));
            let (c, d) =
                (vandq_u32(c, vshlq_n_u32::<8>(lane)), vandq_u32(d, vshlq_n_u32::<12>(lane)));
            vaddvq_u32(vorrq_u32(low, vorrq_u32(c, d)))
        }
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        I([unsafe { vdupq_n_s32(v) }; 4])
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { vst1q_s32(to.as_mut_ptr().add(4 * i), v) };
        }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        // The intrinsic's constant is an i32; Rust cannot convert the generic u32.
        I(map(self.0, |v| unsafe { vshlq_s32(v, vdupq_n_s32(N as i32)) }))
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        I(zip(self.0, by.0, |v, by| unsafe { vshlq_s32(v, by) }))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        // A negative count shifts to the right.
        I(map(self.0, |v| unsafe { vshlq_s32(v, vdupq_n_s32(-(N as i32))) }))
    }
}

impl<const FUSED: bool> Simd for Token<FUSED> {
    type F = F<FUSED>;
    type M = M;
    type I = I;

    #[inline(never)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }
    #[inline(always)]
    fn store_uninit(self, v: F<FUSED>, to: &mut [MaybeUninit<f32>; LANES]) {
        for (i, v) in v.0.into_iter().enumerate() {
            unsafe { vst1q_f32(to.as_mut_ptr().add(4 * i).cast(), v) };
        }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        unsafe {
            let (bits, lane) = (vdupq_n_u32(bits), vld1q_u32([1, 2, 4, 8].as_ptr()));
            M([
                vtstq_u32(bits, lane),
                vtstq_u32(bits, vshlq_n_u32::<4>(lane)),
                vtstq_u32(bits, vshlq_n_u32::<8>(lane)),
                vtstq_u32(bits, vshlq_n_u32::<12>(lane)),
            ])
        }
    }
    #[inline(always)]
    fn prefetch<T>(self, v: *const T) {
        // The intrinsic is unstable. The instruction reads no memory that a program sees.
        unsafe {
            asm!(
                "prfm pldl1keep, [{}]",
                in(reg) v.addr(),
                options(nomem, nostack, preserves_flags)
            );
        }
    }
    #[inline(always)]
    fn prefetch_l2<T>(self, v: *const T) {
        unsafe {
            asm!(
                "prfm pldl2keep, [{}]",
                in(reg) v.addr(),
                options(nomem, nostack, preserves_flags)
            );
        }
    }
    #[inline(always)]
    fn sum(self, v: F<FUSED>) -> f32 {
        unsafe {
            let v = quarters_sum(v.0);
            vpadds_f32(vadd_f32(vget_low_f32(v), vget_high_f32(v)))
        }
    }
    #[inline(always)]
    fn sums<const N: usize>(self, v: [F<FUSED>; N]) -> [f32; N] {
        const { assert!(N <= LANES) };
        let zero = unsafe { vdupq_n_f32(0.0) };
        let mut quarters = [zero; LANES];
        for (quarter, v) in quarters.iter_mut().zip(v) {
            *quarter = quarters_sum(v.0);
        }
        let mut out = [0.0; LANES];
        for (out, q) in out.as_chunks_mut::<4>().0.iter_mut().zip(quarters.as_chunks::<4>().0) {
            let ([a, b], [c, d]) = (halves(q[0], q[1]), halves(q[2], q[3]));
            // Lanes 0 + 2 and 1 + 3 of each of the four, then their sum.
            unsafe {
                let sums = vpaddq_f32(vaddq_f32(a, b), vaddq_f32(c, d));
                vst1q_f32(out.as_mut_ptr(), sums);
            }
        }
        let mut first = [0.0; N];
        first.copy_from_slice(&out[..N]);
        first
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F<FUSED>; 4] {
        let mut out = [self.splat(0.0); 4];
        if all_inside(from.len(), at, offset) {
            for quarter in 0..4 {
                let rows = map([0, 1, 2, 3], |i| unsafe {
                    vld1q_f32(from.as_ptr().add(offset + at[4 * quarter + i]))
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
    fn rotate_left(self, v: F<FUSED>) -> F<FUSED> {
        let [a, b, c, d] = v.0;
        F([b, c, d, unsafe { vextq_f32::<1>(a, a) }])
    }
    #[inline(always)]
    fn rotate_right(self, v: F<FUSED>) -> F<FUSED> {
        let [a, b, c, d] = v.0;
        F([unsafe { vextq_f32::<3>(d, d) }, a, b, c])
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F<FUSED>; 4]) -> [F<FUSED>; 4] {
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
    fn deinterleave_quarters(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let (a, b) = (a.0, b.0);
        [F([a[0], a[2], b[0], b[2]]), F([a[1], a[3], b[1], b[3]])]
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F<FUSED>, odd: F<FUSED>) -> [F<FUSED>; 2] {
        let (e, o) = (even.0, odd.0);
        [F([e[0], o[0], e[1], o[1]]), F([e[2], o[2], e[3], o[3]])]
    }
    #[inline(always)]
    fn interleave(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let low = zip(a.0, b.0, |a, b| unsafe { vzip1q_f32(a, b) });
        let high = zip(a.0, b.0, |a, b| unsafe { vzip2q_f32(a, b) });
        [F([low[0], high[0], low[1], high[1]]), F([low[2], high[2], low[3], high[3]])]
    }
    #[inline(always)]
    fn deinterleave(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let left = [a.0[0], a.0[2], b.0[0], b.0[2]];
        let right = [a.0[1], a.0[3], b.0[1], b.0[3]];
        let even = zip(left, right, |a, b| unsafe { vuzp1q_f32(a, b) });
        [F(even), F(zip(left, right, |a, b| unsafe { vuzp2q_f32(a, b) }))]
    }
    #[inline(always)]
    fn transpose(self, v: [F<FUSED>; LANES]) -> [F<FUSED>; LANES] {
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
