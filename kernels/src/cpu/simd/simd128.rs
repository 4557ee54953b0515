//! WebAssembly's simd128: sixteen lanes in four registers, the scalar level of that target
//! where the build enables it (`.cargo/config.toml`; a module cannot detect instructions at run
//! time). It does the operations of `array` in the same order. The compiler alone leaves many of
//! those loops without vectors.
//!
//! SAFETY of every block below: loads and stores go through references to whole arrays, or to
//! places that were checked before.
#![expect(clippy::undocumented_unsafe_blocks, reason = "one reason for all, stated above")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    rows,
};
use std::arch::wasm32::*;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// The token. It proves nothing, since the module runs only where the level exists.
#[derive(Clone, Copy)]
pub(super) struct Token;

#[derive(Clone, Copy)]
pub(super) struct F([v128; 4]);

/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub(super) struct M([v128; 4]);

#[derive(Clone, Copy)]
pub(super) struct I([v128; 4]);

/// `f` of each register.
#[inline(always)]
fn map<T: Copy, R>(v: [T; 4], f: impl Fn(T) -> R) -> [R; 4] {
    [f(v[0]), f(v[1]), f(v[2]), f(v[3])]
}

/// `f` of each pair of registers.
#[inline(always)]
fn zip(a: [v128; 4], b: [v128; 4], f: impl Fn(v128, v128) -> v128) -> [v128; 4] {
    [f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])]
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $intrinsic:ident;)*) => { $(
        impl $op for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(zip(self.0, other.0, |a, b| $intrinsic(a, b)))
            }
        }
    )* };
}

operators! {
    F Add add f32x4_add;
    F Sub sub f32x4_sub;
    F Mul mul f32x4_mul;
    F Div div f32x4_div;
    I Add add i32x4_add;
    I Sub sub i32x4_sub;
    I BitAnd bitand v128_and;
    I BitOr bitor v128_or;
    I BitXor bitxor v128_xor;
    M BitAnd bitand v128_and;
    M BitOr bitor v128_or;
}

impl Neg for F {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(map(self.0, |v| f32x4_neg(v)))
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(map(self.0, |v| v128_not(v)))
    }
}

/// 4×4 transpose.
#[inline(always)]
fn transpose4(v: [v128; 4]) -> [v128; 4] {
    let a = i32x4_shuffle::<0, 4, 1, 5>(v[0], v[1]);
    let b = i32x4_shuffle::<2, 6, 3, 7>(v[0], v[1]);
    let c = i32x4_shuffle::<0, 4, 1, 5>(v[2], v[3]);
    let d = i32x4_shuffle::<2, 6, 3, 7>(v[2], v[3]);
    [
        i32x4_shuffle::<0, 1, 4, 5>(a, c),
        i32x4_shuffle::<2, 3, 6, 7>(a, c),
        i32x4_shuffle::<0, 1, 4, 5>(b, d),
        i32x4_shuffle::<2, 3, 6, 7>(b, d),
    ]
}

impl Vector for F {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    // Engines map four of these registers to each vector, on machines with 16.
    const REGISTERS: usize = 4;

    #[inline(always)]
    fn splat(v: f32) -> F {
        F([f32x4_splat(v); 4])
    }
    #[inline(always)]
    fn constant(v: f64) -> F {
        F::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> F {
        F(map([0, 4, 8, 12], |at| unsafe { v128_load(v.as_ptr().add(at).cast()) }))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { v128_store(to.as_mut_ptr().add(4 * i).cast(), v) };
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
        F(zip(self.0, other.0, |a, b| f32x4_pmax(a, b)))
    }
    #[inline(always)]
    fn min(self, other: F) -> F {
        F(zip(self.0, other.0, |a, b| f32x4_pmin(a, b)))
    }
    #[inline(always)]
    fn sqrt(self) -> F {
        F(map(self.0, |v| f32x4_sqrt(v)))
    }
    #[inline(always)]
    fn abs(self) -> F {
        F(map(self.0, |v| f32x4_abs(v)))
    }
    #[inline(always)]
    fn floor(self) -> F {
        F(map(self.0, |v| f32x4_floor(v)))
    }
    #[inline(always)]
    fn lt(self, other: F) -> M {
        M(zip(self.0, other.0, |a, b| f32x4_lt(a, b)))
    }
    #[inline(always)]
    fn le(self, other: F) -> M {
        M(zip(self.0, other.0, |a, b| f32x4_le(a, b)))
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
        F(map(self.0, |v| v128_or(v, f32x4_splat(-0.0))))
    }
    #[inline(always)]
    fn ceil(self) -> F {
        F(map(self.0, |v| f32x4_ceil(v)))
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (F, F) {
        let n = F(map(self.0, |v| f32x4_nearest(v)));
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: F) -> F {
        F::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(self.0)
    }
    #[inline(always)]
    fn from_bits(v: I) -> F {
        F(v.0)
    }
    #[inline(always)]
    fn to_int(self) -> I {
        I(map(self.0, |v| i32x4_trunc_sat_f32x4(v)))
    }
    #[inline(always)]
    fn from_int(v: I) -> F {
        F(map(v.0, |v| f32x4_convert_i32x4(v)))
    }
}

impl Mask<F> for M {
    #[inline(always)]
    fn select(self, a: F, b: F) -> F {
        let mut out = b.0;
        for (i, out) in out.iter_mut().enumerate() {
            *out = v128_bitselect(a.0[i], *out, self.0[i]);
        }
        F(out)
    }
    #[inline(always)]
    fn select_or_zero(self, v: F) -> F {
        F(zip(self.0, v.0, |mask, v| v128_and(mask, v)))
    }
    #[inline(always)]
    fn any(self) -> bool {
        let [a, b, c, d] = self.0;
        v128_any_true(v128_or(v128_or(a, b), v128_or(c, d)))
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        let [a, b, c, d] = map(self.0, |v| u32::from(i32x4_bitmask(v)));
        a | b << 4 | c << 8 | d << 12
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        I([i32x4_splat(v); 4])
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            unsafe { v128_store(to.as_mut_ptr().add(4 * i).cast(), v) };
        }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        I(map(self.0, |v| i32x4_shl(v, N)))
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        // simd128 has one count for all lanes.
        let (mut v, mut counts) = ([0; LANES], [0; LANES]);
        self.store(&mut v);
        by.store(&mut counts);
        for (v, by) in v.iter_mut().zip(counts) {
            *v <<= by & 31;
        }
        I(map([0, 4, 8, 12], |at| unsafe { v128_load(v.as_ptr().add(at).cast()) }))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        I(map(self.0, |v| i32x4_shr(v, N)))
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
            unsafe { v128_store(to.as_mut_ptr().add(4 * i).cast(), v) };
        }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        let lanes = |i: u32| {
            let bit = i32x4(1 << i, 2 << i, 4 << i, 8 << i);
            i32x4_eq(v128_and(i32x4_splat(bits as i32), bit), bit)
        };
        M(map([0, 4, 8, 12], lanes))
    }
    #[inline(always)]
    fn prefetch<T>(self, _: *const T) {}
    #[inline(always)]
    fn prefetch_l2<T>(self, _: *const T) {}
    #[inline(always)]
    fn sum(self, v: F) -> f32 {
        let [a, b, c, d] = v.0;
        let v = f32x4_add(f32x4_add(a, c), f32x4_add(b, d));
        let v = f32x4_add(v, i32x4_shuffle::<2, 3, 2, 3>(v, v));
        f32x4_extract_lane::<0>(v) + f32x4_extract_lane::<1>(v)
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F; 4] {
        let mut out = [self.splat(0.0); 4];
        if all_inside(from.len(), at, offset) {
            for quarter in 0..4 {
                let rows = map([0, 1, 2, 3], |i| unsafe {
                    v128_load(from.as_ptr().add(offset + at[4 * quarter + i]).cast())
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
        F([b, c, d, i32x4_shuffle::<1, 2, 3, 0>(a, a)])
    }
    #[inline(always)]
    fn rotate_right(self, v: F) -> F {
        let [a, b, c, d] = v.0;
        F([i32x4_shuffle::<3, 0, 1, 2>(d, d), a, b, c])
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
        let low = zip(a.0, b.0, |a, b| i32x4_shuffle::<0, 4, 1, 5>(a, b));
        let high = zip(a.0, b.0, |a, b| i32x4_shuffle::<2, 6, 3, 7>(a, b));
        [F([low[0], high[0], low[1], high[1]]), F([low[2], high[2], low[3], high[3]])]
    }
    #[inline(always)]
    fn deinterleave(self, a: F, b: F) -> [F; 2] {
        let left = [a.0[0], a.0[2], b.0[0], b.0[2]];
        let right = [a.0[1], a.0[3], b.0[1], b.0[3]];
        let even = zip(left, right, |a, b| i32x4_shuffle::<0, 2, 4, 6>(a, b));
        [F(even), F(zip(left, right, |a, b| i32x4_shuffle::<1, 3, 5, 7>(a, b)))]
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
