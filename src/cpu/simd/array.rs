//! Lanes as an array of 16: the scalar tier, which compilers turn into the target's
//! least vectors, and NEON, where they turn into its registers with fused products.

use super::{Floats, Ints, LANES, Mask, Simd, all_inside, square};
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// Products and sums round separately: no fused instruction is assumed.
#[derive(Clone, Copy)]
pub(super) struct Separate;

/// Products and sums round once.
#[cfg(any(target_arch = "aarch64", test))]
#[derive(Clone, Copy)]
pub(super) struct Fused;

#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct F([f32; LANES]);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct M([u32; LANES]);

#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct I([i32; LANES]);

impl Floats for F {}
impl Mask for M {}
impl Ints for I {}

macro_rules! lanewise {
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

lanewise! {
    F Add add Add::add;
    F Sub sub Sub::sub;
    F Mul mul Mul::mul;
    F Div div Div::div;
    M BitAnd bitand BitAnd::bitand;
    M BitOr bitor BitOr::bitor;
    I Add add i32::wrapping_add;
    I Sub sub i32::wrapping_sub;
    I BitAnd bitand BitAnd::bitand;
    I BitOr bitor BitOr::bitor;
}

impl Neg for F {
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
fn truth(v: bool) -> u32 {
    0u32.wrapping_sub(u32::from(v))
}

/// `as i32` without its care for what does not fit: one instruction.
#[inline(always)]
fn truncate(v: f32) -> i32 {
    const LIMIT: f32 = 2_147_483_520.0;
    let v = if v > -LIMIT { v } else { -LIMIT };
    let v = if v < LIMIT { v } else { LIMIT };
    // SAFETY: between ±2 147 483 520, NaN having become the lower one.
    unsafe { v.to_int_unchecked() }
}

/// Floor of what fits an i32; larger numbers are whole already.
#[inline(always)]
fn floor(v: f32) -> f32 {
    let whole = truncate(v) as f32;
    let below = if whole > v { whole - 1.0 } else { whole };
    // Above 2²³ there is no fraction; NaN stays. The floor of −0 is −0.
    if v.abs() < 8_388_608.0 { below.copysign(v) } else { v }
}

macro_rules! tier {
    ($token:ident, $fma:path) => {
        impl Simd for $token {
            type F = F;
            type M = M;
            type I = I;

            const REGISTERS: usize = 8;

            #[inline(always)]
            fn splat(self, v: f32) -> F {
                F([v; LANES])
            }
            #[inline(always)]
            fn load(self, v: &[f32; LANES]) -> F {
                F(*v)
            }
            #[inline(always)]
            fn store(self, v: F, to: &mut [f32; LANES]) {
                *to = v.0;
            }
            #[inline(always)]
            fn store_fresh(self, v: F, to: &mut [MaybeUninit<f32>; LANES]) {
                *to = v.0.map(MaybeUninit::new);
            }
            #[inline(always)]
            fn fma(self, a: F, b: F, c: F) -> F {
                let mut out = c.0;
                for i in 0..LANES {
                    out[i] = $fma(a.0[i], b.0[i], c.0[i]);
                }
                F(out)
            }
            #[inline(always)]
            fn fnma(self, a: F, b: F, c: F) -> F {
                self.fma(-a, b, c)
            }
            #[inline(always)]
            fn min(self, a: F, b: F) -> F {
                F(zip(a.0, b.0, |a, b| if a < b { a } else { b }))
            }
            #[inline(always)]
            fn max(self, a: F, b: F) -> F {
                F(zip(a.0, b.0, |a, b| if a > b { a } else { b }))
            }
            #[inline(always)]
            fn sqrt(self, v: F) -> F {
                F(map(v.0, f32::sqrt))
            }
            #[inline(always)]
            fn rough_sqrt(self, v: F) -> F {
                self.sqrt(v)
            }
            #[inline(always)]
            fn abs(self, v: F) -> F {
                F(map(v.0, f32::abs))
            }
            #[inline(always)]
            fn negative(self, v: F) -> F {
                F(map(v.0, |v| -v.abs()))
            }
            #[inline(always)]
            fn floor(self, v: F) -> F {
                F(map(v.0, floor))
            }
            #[inline(always)]
            fn ceil(self, v: F) -> F {
                F(map(v.0, |v| -floor(-v)))
            }
            #[inline(always)]
            fn split(self, v: F) -> (F, F) {
                /// 1.5·2²³: adding it leaves no room for a fraction.
                const ROUND: f32 = 12_582_912.0;
                let n = F(map(v.0, |v| v + ROUND - ROUND));
                (n, v - n)
            }
            #[inline(always)]
            fn scale(self, v: F, e: F) -> F {
                F(zip(v.0, e.0, |v, e| {
                    f32::from_bits(v.to_bits().wrapping_add((truncate(e) as u32) << 23))
                }))
            }
            #[inline(always)]
            fn lt(self, a: F, b: F) -> M {
                M(zip(a.0, b.0, |a, b| truth(a < b)))
            }
            #[inline(always)]
            fn le(self, a: F, b: F) -> M {
                M(zip(a.0, b.0, |a, b| truth(a <= b)))
            }
            #[inline(always)]
            fn select(self, m: M, a: F, b: F) -> F {
                let mut out = b.0;
                for i in 0..LANES {
                    let bits = (a.0[i].to_bits() & m.0[i]) | (b.0[i].to_bits() & !m.0[i]);
                    out[i] = f32::from_bits(bits);
                }
                F(out)
            }
            #[inline(always)]
            fn keep(self, m: M, v: F) -> F {
                let mut out = v.0;
                for i in 0..LANES {
                    out[i] = f32::from_bits(v.0[i].to_bits() & m.0[i]);
                }
                F(out)
            }
            #[inline(always)]
            fn bits(self, m: M) -> u32 {
                (0..LANES).fold(0, |bits, i| bits | (m.0[i] & (1 << i)))
            }
            #[inline(always)]
            fn mask(self, bits: u32) -> M {
                let mut out = [0; LANES];
                for i in 0..LANES {
                    out[i] = truth(bits & (1 << i) != 0);
                }
                M(out)
            }
            #[inline(always)]
            fn any(self, m: M) -> bool {
                m.0.iter().fold(0, |any, v| any | v) != 0
            }
            #[inline(always)]
            fn splat_int(self, v: i32) -> I {
                I([v; LANES])
            }
            #[inline(always)]
            fn store_int(self, v: I, to: &mut [i32; LANES]) {
                *to = v.0;
            }
            #[inline(always)]
            fn to_bits(self, v: F) -> I {
                I(map(v.0, |v| v.to_bits() as i32))
            }
            #[inline(always)]
            fn of_bits(self, v: I) -> F {
                F(map(v.0, |v| f32::from_bits(v as u32)))
            }
            #[inline(always)]
            fn to_int(self, v: F) -> I {
                I(map(v.0, truncate))
            }
            #[inline(always)]
            fn of_int(self, v: I) -> F {
                F(map(v.0, |v| v as f32))
            }
            #[inline(always)]
            fn shl<const N: u32>(self, v: I) -> I {
                I(map(v.0, |v| v << N))
            }
            #[inline(always)]
            fn shift(self, v: I, by: I) -> I {
                I(zip(v.0, by.0, |v, by| v << (by & 31)))
            }
            #[inline(always)]
            fn shr<const N: u32>(self, v: I) -> I {
                I(map(v.0, |v| v >> N))
            }
            #[inline(always)]
            fn prefetch<T>(self, _: *const T) {}
            #[inline(always)]
            fn prefetch_early<T>(self, _: *const T) {}
            #[inline(always)]
            fn sum(self, v: F) -> f32 {
                let mut v = v.0;
                for half in [8, 4, 2, 1] {
                    for i in 0..half {
                        v[i] += v[i + half];
                    }
                }
                v[0]
            }
            #[inline(always)]
            fn load4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F; 4] {
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
            unsafe fn load_lanes(self, from: *const f32, bits: u16) -> F {
                if bits == u16::MAX {
                    // SAFETY: all sixteen are there, as the caller says.
                    return F(unsafe { *from.cast() });
                }
                let mut out = [0.0; LANES];
                for i in 0..LANES {
                    if bits & (1 << i) != 0 {
                        // SAFETY: there, as the caller says.
                        out[i] = unsafe { *from.wrapping_add(i) };
                    }
                }
                F(out)
            }
            #[inline(always)]
            unsafe fn store_lanes(self, v: F, to: *mut MaybeUninit<f32>, bits: u16) {
                for i in 0..LANES {
                    if bits & (1 << i) != 0 {
                        // SAFETY: there, and nobody else's, as the caller says.
                        unsafe { to.wrapping_add(i).write(MaybeUninit::new(v.0[i])) };
                    }
                }
            }
            #[inline(always)]
            fn after(self, v: F) -> F {
                let mut out = v;
                for i in 0..LANES {
                    out.0[square(i)] = v.0[square((i + 1) % LANES)];
                }
                out
            }
            #[inline(always)]
            fn before(self, v: F) -> F {
                let mut out = v;
                for i in 0..LANES {
                    out.0[square((i + 1) % LANES)] = v.0[square(i)];
                }
                out
            }
            #[inline(always)]
            fn transpose4(self, v: [F; 4]) -> [F; 4] {
                let mut out = v;
                for i in 0..4 {
                    for lane in 0..LANES {
                        out[lane % 4].0[lane / 4 * 4 + i] = v[i].0[lane];
                    }
                }
                out
            }
            #[inline(always)]
            fn split_quarters(self, a: F, b: F) -> [F; 2] {
                let mut out = [a, b];
                for i in 0..2 * LANES {
                    let (quarter, place) = (i / 4, i % 4);
                    let from = if i < LANES { a.0[i] } else { b.0[i - LANES] };
                    out[quarter % 2].0[quarter / 2 * 4 + place] = from;
                }
                out
            }
            #[inline(always)]
            fn join_quarters(self, even: F, odd: F) -> [F; 2] {
                let mut out = [even, odd];
                for i in 0..2 * LANES {
                    let (quarter, place) = (i / 4, i % 4);
                    let from = [even, odd][quarter % 2].0[quarter / 2 * 4 + place];
                    out[i / LANES].0[i % LANES] = from;
                }
                out
            }
            #[inline(always)]
            fn zip(self, a: F, b: F) -> [F; 2] {
                let mut out = [a, b];
                for i in 0..LANES {
                    let (vector, place) = (2 * i / LANES, 2 * i % LANES);
                    out[vector].0[place] = a.0[i];
                    out[vector].0[place + 1] = b.0[i];
                }
                out
            }
            #[inline(always)]
            fn unzip(self, a: F, b: F) -> [F; 2] {
                let mut out = [a, b];
                for i in 0..2 * LANES {
                    let from = if i < LANES { a.0[i] } else { b.0[i - LANES] };
                    out[i % 2].0[i / 2] = from;
                }
                out
            }
            #[inline(always)]
            fn transpose(self, v: [F; LANES]) -> [F; LANES] {
                let mut out = v;
                for i in 0..LANES {
                    for j in 0..LANES {
                        out[j].0[i] = v[i].0[j];
                    }
                }
                out
            }
        }
    };
}

/// a·b + c, rounded twice.
#[inline(always)]
fn multiply_then_add(a: f32, b: f32, c: f32) -> f32 {
    a * b + c
}

tier!(Separate, multiply_then_add);
#[cfg(any(target_arch = "aarch64", test))]
tier!(Fused, f32::mul_add);
