//! Sixteen lanes as arrays: the baseline of targets without a module of their own, and, with
//! fused products too, what tests compare every level with.
//!
//! The tests need a definition of their own, so that this module shares no code with `quad`.
#![expect(clippy::needless_range_loop, reason = "counted loops over arrays become vectors")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, Simd, Vector, all_inside, elementary,
    transpose4x4_index,
};
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// The token. `FUSED`: products and sums round once; else twice, and no fused instruction is
/// needed.
#[derive(Clone, Copy)]
pub(super) struct Array<const FUSED: bool>;

#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct F<const FUSED: bool>([f32; LANES]);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct M([u32; LANES]);

#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct I([i32; LANES]);

macro_rules! float_operators {
    ($($op:ident $method:ident;)*) => { $(
        impl<const FUSED: bool> $op for F<FUSED> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(zip(self.0, other.0, $op::$method))
            }
        }
    )* };
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $f:path;)*) => { $(
        impl $op for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(zip(self.0, other.0, $f))
            }
        }
    )* };
}

float_operators! {
    Add add;
    Sub sub;
    Mul mul;
    Div div;
}

operators! {
    M BitAnd bitand BitAnd::bitand;
    M BitOr bitor BitOr::bitor;
    I Add add i32::wrapping_add;
    I Sub sub i32::wrapping_sub;
    I BitAnd bitand BitAnd::bitand;
    I BitOr bitor BitOr::bitor;
    I BitXor bitxor BitXor::bitxor;
}

impl<const FUSED: bool> Neg for F<FUSED> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(map(self.0, |v| -v))
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(map(self.0, |v| !v))
    }
}

#[inline(always)]
fn map<T: Copy, R: Copy + Default>(v: [T; LANES], f: impl Fn(T) -> R) -> [R; LANES] {
    let mut out = [R::default(); LANES];
    for i in 0..LANES {
        out[i] = f(v[i]);
    }
    out
}

#[inline(always)]
fn zip<T: Copy, R: Copy + Default>(
    a: [T; LANES],
    b: [T; LANES],
    f: impl Fn(T, T) -> R,
) -> [R; LANES] {
    let mut out = [R::default(); LANES];
    for i in 0..LANES {
        out[i] = f(a[i], b[i]);
    }
    out
}

#[inline(always)]
fn all_bits_if(v: bool) -> u32 {
    0u32.wrapping_sub(u32::from(v))
}

/// `as i32` without its saturation and its 0 for NaN: one instruction.
#[inline(always)]
fn truncate(v: f32) -> i32 {
    const LIMIT: f32 = 2_147_483_520.0;
    let v = if v > -LIMIT { v } else { -LIMIT };
    let v = if v < LIMIT { v } else { LIMIT };
    // SAFETY: `v` lies within ±2 147 483 520; NaN became the lower bound.
    unsafe { v.to_int_unchecked() }
}

/// Floor of numbers that fit an i32; larger numbers are whole.
#[inline(always)]
fn floor(v: f32) -> f32 {
    let whole = truncate(v) as f32;
    let below = if whole > v { whole - 1.0 } else { whole };
    // No fraction exists above 2²³; NaN stays. The floor of −0 is −0.
    if v.abs() < 8_388_608.0 { below.copysign(v) } else { v }
}

impl<const FUSED: bool> Vector for F<FUSED> {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(v: f32) -> Self {
        F([v; LANES])
    }
    #[inline(always)]
    fn constant(v: f64) -> Self {
        Self::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> Self {
        F(*v)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        *to = self.0;
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        let mut out = c.0;
        for i in 0..LANES {
            out[i] =
                if FUSED { self.0[i].mul_add(b.0[i], c.0[i]) } else { self.0[i] * b.0[i] + c.0[i] };
        }
        F(out)
    }
    #[inline(always)]
    fn fnma(self, b: Self, c: Self) -> Self {
        (-self).fma(b, c)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        F(zip(self.0, other.0, |a, b| if b > a { b } else { a }))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        F(zip(self.0, other.0, |a, b| if b < a { b } else { a }))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        F(map(self.0, f32::sqrt))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        F(map(self.0, f32::abs))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        F(map(self.0, floor))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M {
        M(zip(self.0, other.0, |a, b| all_bits_if(a < b)))
    }
    #[inline(always)]
    fn le(self, other: Self) -> M {
        M(zip(self.0, other.0, |a, b| all_bits_if(a <= b)))
    }
    elementary::functions!();
}

impl<const FUSED: bool> F32Vector for F<FUSED> {
    type Int = I;

    #[inline(always)]
    fn approx_sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn neg_abs(self) -> Self {
        F(map(self.0, |v| -v.abs()))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        F(map(self.0, |v| -floor(-v)))
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (Self, Self) {
        /// 1.5·2²³: a sum with it has no bits for a fraction.
        const ROUND: f32 = 12_582_912.0;
        let n = F(map(self.0, |v| v + ROUND - ROUND));
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: Self) -> Self {
        Self::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(map(self.0, |v| v.to_bits() as i32))
    }
    #[inline(always)]
    fn from_bits(v: I) -> Self {
        F(map(v.0, |v| f32::from_bits(v as u32)))
    }
    #[inline(always)]
    fn to_int(self) -> I {
        I(map(self.0, truncate))
    }
    #[inline(always)]
    fn from_int(v: I) -> Self {
        F(map(v.0, |v| v as f32))
    }
}

impl<const FUSED: bool> Mask<F<FUSED>> for M {
    #[inline(always)]
    fn select(self, a: F<FUSED>, b: F<FUSED>) -> F<FUSED> {
        let mut out = b.0;
        for i in 0..LANES {
            let bits = (a.0[i].to_bits() & self.0[i]) | (b.0[i].to_bits() & !self.0[i]);
            out[i] = f32::from_bits(bits);
        }
        F(out)
    }
    #[inline(always)]
    fn select_or_zero(self, v: F<FUSED>) -> F<FUSED> {
        let mut out = v.0;
        for i in 0..LANES {
            out[i] = f32::from_bits(v.0[i].to_bits() & self.0[i]);
        }
        F(out)
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.0.iter().fold(0, |any, v| any | v) != 0
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        (0..LANES).fold(0, |bits, i| bits | (self.0[i] & (1 << i)))
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        I([v; LANES])
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        *to = self.0;
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        I(map(self.0, |v| v << N))
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        I(zip(self.0, by.0, |v, by| v << (by & 31)))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        I(map(self.0, |v| v >> N))
    }
}

impl<const FUSED: bool> Simd for Array<FUSED> {
    type F = F<FUSED>;
    type M = M;
    type I = I;

    #[inline(never)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }
    #[inline(always)]
    fn store_uninit(self, v: F<FUSED>, to: &mut [MaybeUninit<f32>; LANES]) {
        *to = v.0.map(MaybeUninit::new);
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        let mut out = [0; LANES];
        for i in 0..LANES {
            out[i] = all_bits_if(bits & (1 << i) != 0);
        }
        M(out)
    }
    #[inline(always)]
    fn prefetch<T>(self, _: *const T) {}
    #[inline(always)]
    fn prefetch_l2<T>(self, _: *const T) {}
    #[inline(always)]
    fn sum(self, v: F<FUSED>) -> f32 {
        let mut v = v.0;
        for half in [8, 4, 2, 1] {
            for i in 0..half {
                v[i] += v[i + half];
            }
        }
        v[0]
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F<FUSED>; 4] {
        let mut out = [[0.0; LANES]; 4];
        if all_inside(from.len(), at, offset) {
            for i in 0..LANES {
                for (c, v) in from[at[i] + offset..at[i] + offset + 4].iter().enumerate() {
                    out[c][i] = *v;
                }
            }
        }
        out.map(F)
    }
    #[inline(always)]
    unsafe fn load_masked(self, from: *const f32, bits: u16) -> F<FUSED> {
        if bits == u16::MAX {
            // SAFETY: the caller guarantees all sixteen.
            return F(unsafe { *from.cast() });
        }
        let mut out = [0.0; LANES];
        for i in 0..LANES {
            if bits & (1 << i) != 0 {
                // SAFETY: the caller guarantees this float.
                out[i] = unsafe { *from.wrapping_add(i) };
            }
        }
        F(out)
    }
    #[inline(always)]
    unsafe fn store_masked(self, v: F<FUSED>, to: *mut MaybeUninit<f32>, bits: u16) {
        for i in 0..LANES {
            if bits & (1 << i) != 0 {
                // SAFETY: the caller guarantees this place, for this thread alone.
                unsafe { to.wrapping_add(i).write(MaybeUninit::new(v.0[i])) };
            }
        }
    }
    #[inline(always)]
    fn rotate_left(self, v: F<FUSED>) -> F<FUSED> {
        let mut out = v;
        for i in 0..LANES {
            out.0[transpose4x4_index(i)] = v.0[transpose4x4_index((i + 1) % LANES)];
        }
        out
    }
    #[inline(always)]
    fn rotate_right(self, v: F<FUSED>) -> F<FUSED> {
        let mut out = v;
        for i in 0..LANES {
            out.0[transpose4x4_index((i + 1) % LANES)] = v.0[transpose4x4_index(i)];
        }
        out
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F<FUSED>; 4]) -> [F<FUSED>; 4] {
        let mut out = v;
        for i in 0..4 {
            for lane in 0..LANES {
                out[lane % 4].0[lane / 4 * 4 + i] = v[i].0[lane];
            }
        }
        out
    }
    #[inline(always)]
    fn deinterleave_quarters(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let mut out = [a, b];
        for i in 0..2 * LANES {
            let (quarter, place) = (i / 4, i % 4);
            let from = if i < LANES { a.0[i] } else { b.0[i - LANES] };
            out[quarter % 2].0[quarter / 2 * 4 + place] = from;
        }
        out
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F<FUSED>, odd: F<FUSED>) -> [F<FUSED>; 2] {
        let mut out = [even, odd];
        for i in 0..2 * LANES {
            let (quarter, place) = (i / 4, i % 4);
            let from = [even, odd][quarter % 2].0[quarter / 2 * 4 + place];
            out[i / LANES].0[i % LANES] = from;
        }
        out
    }
    #[inline(always)]
    fn interleave(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let mut out = [a, b];
        for i in 0..LANES {
            let (vector, place) = (2 * i / LANES, 2 * i % LANES);
            out[vector].0[place] = a.0[i];
            out[vector].0[place + 1] = b.0[i];
        }
        out
    }
    #[inline(always)]
    fn deinterleave(self, a: F<FUSED>, b: F<FUSED>) -> [F<FUSED>; 2] {
        let mut out = [a, b];
        for i in 0..2 * LANES {
            let from = if i < LANES { a.0[i] } else { b.0[i - LANES] };
            out[i % 2].0[i / 2] = from;
        }
        out
    }
    #[inline(always)]
    fn transpose(self, v: [F<FUSED>; LANES]) -> [F<FUSED>; LANES] {
        let mut out = v;
        for i in 0..LANES {
            for j in 0..LANES {
                out[j].0[i] = v[i].0[j];
            }
        }
        out
    }
}
