//! Sixteen lanes in four 128-bit registers: the vectors of SSE2, NEON and WebAssembly's simd128.
//!
//! An [`InstructionSet`] has one function per operation on a register, most of them one
//! instruction. This module builds the operations on sixteen lanes from them, once for all sets.
//!
//! `array` defines the same operations lane by lane, in the same order. It shares no code with
//! this module, so that tests compare independent definitions.

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    rows,
};
use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// An instruction set with 128-bit registers, which every processor of the target has: its
/// functions need no proof.
pub(super) trait InstructionSet: Copy + Send + Sync + 'static {
    /// Four `f32` lanes.
    type Float: Copy;
    /// Four lanes, each with all of its bits set or none.
    type Mask: Copy;
    /// Four `i32` lanes.
    type Int: Copy;
    /// Number of vectors of four registers that the processor's registers hold at once.
    const VECTORS: usize;

    fn splat(v: f32) -> Self::Float;
    /// # Safety
    /// `from` points to four floats, of any alignment.
    unsafe fn load(from: *const f32) -> Self::Float;
    /// # Safety
    /// `to` points to places for four floats, of any alignment, for this thread alone.
    unsafe fn store(v: Self::Float, to: *mut f32);

    fn add(a: Self::Float, b: Self::Float) -> Self::Float;
    fn sub(a: Self::Float, b: Self::Float) -> Self::Float;
    fn mul(a: Self::Float, b: Self::Float) -> Self::Float;
    fn div(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a·b + c.
    #[inline(always)]
    fn fma(a: Self::Float, b: Self::Float, c: Self::Float) -> Self::Float {
        Self::add(Self::mul(a, b), c)
    }
    /// c − a·b.
    #[inline(always)]
    fn fnma(a: Self::Float, b: Self::Float, c: Self::Float) -> Self::Float {
        Self::sub(c, Self::mul(a, b))
    }
    fn neg(v: Self::Float) -> Self::Float;
    fn abs(v: Self::Float) -> Self::Float;
    fn neg_abs(v: Self::Float) -> Self::Float;
    /// As [`Vector::max`], with its rule for NaN.
    fn max(a: Self::Float, b: Self::Float) -> Self::Float;
    /// As [`Vector::min`], with its rule for NaN.
    fn min(a: Self::Float, b: Self::Float) -> Self::Float;
    fn sqrt(v: Self::Float) -> Self::Float;
    /// As [`F32Vector::approx_sqrt`].
    #[inline(always)]
    fn approx_sqrt(v: Self::Float) -> Self::Float {
        Self::sqrt(v)
    }
    fn floor(v: Self::Float) -> Self::Float;
    fn ceil(v: Self::Float) -> Self::Float;
    /// Nearest whole number, ties to even, of numbers as in [`F32Vector::round_and_fraction`].
    fn round(v: Self::Float) -> Self::Float;
    fn lt(a: Self::Float, b: Self::Float) -> Self::Mask;
    fn le(a: Self::Float, b: Self::Float) -> Self::Mask;
    /// Reinterprets the lanes' bits.
    fn to_bits(v: Self::Float) -> Self::Int;
    /// Reinterprets bits as floats.
    fn from_bits(v: Self::Int) -> Self::Float;
    /// As [`F32Vector::to_int`].
    fn to_int(v: Self::Float) -> Self::Int;
    /// Converts whole numbers.
    fn from_int(v: Self::Int) -> Self::Float;

    fn mask_and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn mask_or(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn mask_not(v: Self::Mask) -> Self::Mask;
    fn mask_any(v: Self::Mask) -> bool;
    /// Lane i of register r as bit 4r + i.
    fn mask_bits(v: [Self::Mask; 4]) -> u32;
    /// Lane i holds where bit `FIRST` + i is set.
    fn mask_from_bits<const FIRST: u32>(bits: u32) -> Self::Mask;
    /// Takes `a` where the mask holds, `b` elsewhere.
    fn select(mask: Self::Mask, a: Self::Float, b: Self::Float) -> Self::Float;
    /// Takes `v` where the mask holds, 0 elsewhere.
    fn select_or_zero(mask: Self::Mask, v: Self::Float) -> Self::Float;

    fn int_splat(v: i32) -> Self::Int;
    /// # Safety
    /// `to` points to places for four integers, of any alignment, for this thread alone.
    unsafe fn int_store(v: Self::Int, to: *mut i32);
    fn int_add(a: Self::Int, b: Self::Int) -> Self::Int;
    fn int_sub(a: Self::Int, b: Self::Int) -> Self::Int;
    fn int_and(a: Self::Int, b: Self::Int) -> Self::Int;
    fn int_or(a: Self::Int, b: Self::Int) -> Self::Int;
    fn int_xor(a: Self::Int, b: Self::Int) -> Self::Int;
    /// v << N.
    fn int_shl<const N: u32>(v: Self::Int) -> Self::Int;
    /// v << by, lane by lane, 0 ≤ by < 32. By arrays, since most sets shift all lanes of a
    /// register by one count.
    #[inline(always)]
    fn int_shl_each(v: Self::Int, by: Self::Int) -> Self::Int {
        let mut lanes = [0i32; 4];
        let mut counts = [0i32; 4];
        // SAFETY: the arrays have four places.
        unsafe {
            Self::int_store(v, lanes.as_mut_ptr());
            Self::int_store(by, counts.as_mut_ptr());
        }
        for (lane, count) in lanes.iter_mut().zip(counts) {
            *lane <<= count & 31;
        }
        // SAFETY: the array has four numbers of an f32's size; a register keeps their bits.
        Self::to_bits(unsafe { Self::load(lanes.as_ptr().cast()) })
    }
    /// v >> N, the sign kept.
    fn int_shr<const N: u32>(v: Self::Int) -> Self::Int;

    /// (v₀ + v₂) + (v₁ + v₃).
    fn sum(v: Self::Float) -> f32;
    /// a₀ + a₁, a₂ + a₃, b₀ + b₁, b₂ + b₃.
    #[inline(always)]
    fn add_pairs(a: Self::Float, b: Self::Float) -> Self::Float {
        Self::add(Self::even(a, b), Self::odd(a, b))
    }
    /// v₁ v₂ v₃ v₀.
    fn rotate_left(v: Self::Float) -> Self::Float;
    /// v₃ v₀ v₁ v₂.
    fn rotate_right(v: Self::Float) -> Self::Float;
    /// a₀ b₀ a₁ b₁.
    fn interleave_low(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a₂ b₂ a₃ b₃.
    fn interleave_high(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a₀ a₂ b₀ b₂.
    fn even(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a₁ a₃ b₁ b₃.
    fn odd(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a₀ a₁ b₀ b₁.
    fn low_halves(a: Self::Float, b: Self::Float) -> Self::Float;
    /// a₂ a₃ b₂ b₃.
    fn high_halves(a: Self::Float, b: Self::Float) -> Self::Float;

    /// As [`Simd::prefetch`]; does nothing where the set has no such instruction.
    #[inline(always)]
    fn prefetch(_: *const u8) {}
    /// As [`Simd::prefetch_l2`]; does nothing where the set has no such instruction.
    #[inline(always)]
    fn prefetch_l2(_: *const u8) {}
}

/// Writes functions of [`InstructionSet`] that are expressions of intrinsics on registers.
macro_rules! instructions {
    ($($name:ident $(<const $n:ident>)? ($($v:ident: $t:ty),*) -> $r:ty = $e:expr;)*) => { $(
        #[inline(always)]
        #[allow(unused_unsafe, reason = "most intrinsics of WebAssembly are safe")]
        fn $name $(<const $n: u32>)? ($($v: $t),*) -> $r {
            // SAFETY: every processor of the target has the set; no operand is a pointer.
            unsafe { $e }
        }
    )* };
}
pub(super) use instructions;

/// The token of a level with four registers to a vector. It proves nothing, since every
/// processor of the target has the instruction set.
#[derive(Clone, Copy)]
pub(super) struct Token<S>(PhantomData<S>);

impl<S: InstructionSet> Token<S> {
    /// The only value.
    pub(super) const NEW: Self = Token(PhantomData);
}

#[derive(Clone, Copy)]
pub(super) struct F<S: InstructionSet>([S::Float; 4]);

#[derive(Clone, Copy)]
pub(super) struct M<S: InstructionSet>([S::Mask; 4]);

#[derive(Clone, Copy)]
pub(super) struct I<S: InstructionSet>([S::Int; 4]);

/// Returns a function of each register, or of the registers at each place of several vectors.
/// A macro, because `array::map` and closures give the compiler more code to inline.
macro_rules! each {
    ($f:expr, $($v:expr),*) => {
        [$f($($v[0]),*), $f($($v[1]),*), $f($($v[2]),*), $f($($v[3]),*)]
    };
}

/// 4×4 transpose.
#[inline(always)]
fn transpose4<S: InstructionSet>(v: [S::Float; 4]) -> [S::Float; 4] {
    let low01 = S::interleave_low(v[0], v[1]);
    let low23 = S::interleave_low(v[2], v[3]);
    let high01 = S::interleave_high(v[0], v[1]);
    let high23 = S::interleave_high(v[2], v[3]);
    [
        S::low_halves(low01, low23),
        S::high_halves(low01, low23),
        S::low_halves(high01, high23),
        S::high_halves(high01, high23),
    ]
}

/// Sum of the registers: lane i + (i + 8), then + 4.
#[inline(always)]
fn sum_of_registers<S: InstructionSet>([a, b, c, d]: [S::Float; 4]) -> S::Float {
    S::add(S::add(a, c), S::add(b, d))
}

/// Sums of four registers, each as [`InstructionSet::sum`].
#[inline(always)]
fn sums_of_four<S: InstructionSet>(v: [S::Float; 4]) -> S::Float {
    let first = S::add(S::low_halves(v[0], v[1]), S::high_halves(v[0], v[1]));
    let second = S::add(S::low_halves(v[2], v[3]), S::high_halves(v[2], v[3]));
    S::add_pairs(first, second)
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $instruction:ident;)*) => { $(
        impl<S: InstructionSet> $op for $vector<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(each!(S::$instruction, self.0, other.0))
            }
        }
    )* };
}

operators! {
    F Add add add;
    F Sub sub sub;
    F Mul mul mul;
    F Div div div;
    I Add add int_add;
    I Sub sub int_sub;
    I BitAnd bitand int_and;
    I BitOr bitor int_or;
    I BitXor bitxor int_xor;
    M BitAnd bitand mask_and;
    M BitOr bitor mask_or;
}

impl<S: InstructionSet> Neg for F<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(each!(S::neg, self.0))
    }
}

impl<S: InstructionSet> Not for M<S> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(each!(S::mask_not, self.0))
    }
}

impl<S: InstructionSet> Vector for F<S> {
    type Element = f32;
    type Mask = M<S>;
    const LANES: usize = LANES;
    const REGISTERS: usize = S::VECTORS;

    #[inline(always)]
    fn splat(v: f32) -> Self {
        F([S::splat(v); 4])
    }
    #[inline(always)]
    fn constant(v: f64) -> Self {
        Self::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> Self {
        let at = v.as_ptr();
        // SAFETY: four floats from each of these places lie in the array.
        F(unsafe { [S::load(at), S::load(at.add(4)), S::load(at.add(8)), S::load(at.add(12))] })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            // SAFETY: four floats from each of these places lie in the array.
            unsafe { S::store(v, to.as_mut_ptr().add(4 * i)) };
        }
    }
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[f32], layout: RowLayout) -> [Self; L] {
        rows::load_transposed(Token::<S>::NEW, rows, layout)
    }
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[Self; L], layout: RowLayout, rows: &mut [f32]) {
        rows::store_transposed(Token::<S>::NEW, from, layout, rows);
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        F(each!(S::fma, self.0, b.0, c.0))
    }
    #[inline(always)]
    fn fnma(self, b: Self, c: Self) -> Self {
        F(each!(S::fnma, self.0, b.0, c.0))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        F(each!(S::max, self.0, other.0))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        F(each!(S::min, self.0, other.0))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        F(each!(S::sqrt, self.0))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        F(each!(S::abs, self.0))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        F(each!(S::floor, self.0))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M<S> {
        M(each!(S::lt, self.0, other.0))
    }
    #[inline(always)]
    fn le(self, other: Self) -> M<S> {
        M(each!(S::le, self.0, other.0))
    }
    elementary::functions!();
}

impl<S: InstructionSet> F32Vector for F<S> {
    type Int = I<S>;

    #[inline(always)]
    fn approx_sqrt(self) -> Self {
        F(each!(S::approx_sqrt, self.0))
    }
    #[inline(always)]
    fn neg_abs(self) -> Self {
        F(each!(S::neg_abs, self.0))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        F(each!(S::ceil, self.0))
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (Self, Self) {
        let n = F(each!(S::round, self.0));
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: Self) -> Self {
        Self::from_bits(self.to_bits() + e.to_int().shl::<23>())
    }
    #[inline(always)]
    fn to_bits(self) -> I<S> {
        I(each!(S::to_bits, self.0))
    }
    #[inline(always)]
    fn from_bits(v: I<S>) -> Self {
        F(each!(S::from_bits, v.0))
    }
    #[inline(always)]
    fn to_int(self) -> I<S> {
        I(each!(S::to_int, self.0))
    }
    #[inline(always)]
    fn from_int(v: I<S>) -> Self {
        F(each!(S::from_int, v.0))
    }
}

impl<S: InstructionSet> Mask<F<S>> for M<S> {
    #[inline(always)]
    fn select(self, a: F<S>, b: F<S>) -> F<S> {
        F(each!(S::select, self.0, a.0, b.0))
    }
    #[inline(always)]
    fn select_or_zero(self, v: F<S>) -> F<S> {
        F(each!(S::select_or_zero, self.0, v.0))
    }
    #[inline(always)]
    fn any(self) -> bool {
        let [a, b, c, d] = self.0;
        S::mask_any(S::mask_or(S::mask_or(a, b), S::mask_or(c, d)))
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        S::mask_bits(self.0)
    }
}

impl<S: InstructionSet> IntVector for I<S> {
    #[inline(always)]
    fn splat(v: i32) -> Self {
        I([S::int_splat(v); 4])
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        for (i, v) in self.0.into_iter().enumerate() {
            // SAFETY: four integers from each of these places lie in the array.
            unsafe { S::int_store(v, to.as_mut_ptr().add(4 * i)) };
        }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> Self {
        I(each!(S::int_shl::<N>, self.0))
    }
    #[inline(always)]
    fn shl_each(self, by: Self) -> Self {
        I(each!(S::int_shl_each, self.0, by.0))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> Self {
        I(each!(S::int_shr::<N>, self.0))
    }
}

impl<S: InstructionSet> Simd for Token<S> {
    type F = F<S>;
    type M = M<S>;
    type I = I<S>;

    #[inline(never)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }
    #[inline(always)]
    fn store_uninit(self, v: F<S>, to: &mut [MaybeUninit<f32>; LANES]) {
        for (i, v) in v.0.into_iter().enumerate() {
            // SAFETY: places for four floats from each of these lie in the array.
            unsafe { S::store(v, to.as_mut_ptr().add(4 * i).cast()) };
        }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M<S> {
        M([
            S::mask_from_bits::<0>(bits),
            S::mask_from_bits::<4>(bits),
            S::mask_from_bits::<8>(bits),
            S::mask_from_bits::<12>(bits),
        ])
    }
    #[inline(always)]
    fn prefetch<T>(self, v: *const T) {
        S::prefetch(v.cast());
    }
    #[inline(always)]
    fn prefetch_l2<T>(self, v: *const T) {
        S::prefetch_l2(v.cast());
    }
    #[inline(always)]
    fn sum(self, v: F<S>) -> f32 {
        S::sum(sum_of_registers::<S>(v.0))
    }
    #[inline(always)]
    fn sums<const N: usize>(self, v: [F<S>; N]) -> [f32; N] {
        const { assert!(N <= LANES) };
        let mut quarters = [S::splat(0.0); LANES];
        for (quarter, v) in quarters.iter_mut().zip(v) {
            *quarter = sum_of_registers::<S>(v.0);
        }
        let mut out = [0.0; LANES];
        for (out, quarters) in out.as_chunks_mut::<4>().0.iter_mut().zip(quarters.as_chunks().0) {
            // SAFETY: `out` has four floats.
            unsafe { S::store(sums_of_four::<S>(*quarters), out.as_mut_ptr()) };
        }
        let mut first = [0.0; N];
        first.copy_from_slice(&out[..N]);
        first
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F<S>; 4] {
        let mut out = [self.splat(0.0); 4];
        if all_inside(from.len(), at, offset) {
            for quarter in 0..4 {
                let row = |i: usize| {
                    let first = offset + at[4 * quarter + i];
                    // SAFETY: the check above covers four floats from here.
                    unsafe { S::load(from.as_ptr().add(first)) }
                };
                let rows = [row(0), row(1), row(2), row(3)];
                let columns = transpose4::<S>(rows);
                for c in 0..4 {
                    out[c].0[quarter] = columns[c];
                }
            }
        }
        out
    }
    // The lanes that follow one another in the order of `transpose4x4_index` lie in adjacent
    // registers.
    #[inline(always)]
    fn rotate_left(self, v: F<S>) -> F<S> {
        let [a, b, c, d] = v.0;
        F([b, c, d, S::rotate_left(a)])
    }
    #[inline(always)]
    fn rotate_right(self, v: F<S>) -> F<S> {
        let [a, b, c, d] = v.0;
        F([S::rotate_right(d), a, b, c])
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F<S>; 4]) -> [F<S>; 4] {
        let mut out = v;
        for q in 0..4 {
            let columns = transpose4::<S>([v[0].0[q], v[1].0[q], v[2].0[q], v[3].0[q]]);
            for i in 0..4 {
                out[i].0[q] = columns[i];
            }
        }
        out
    }
    #[inline(always)]
    fn deinterleave_quarters(self, a: F<S>, b: F<S>) -> [F<S>; 2] {
        let [a0, a1, a2, a3] = a.0;
        let [b0, b1, b2, b3] = b.0;
        [F([a0, a2, b0, b2]), F([a1, a3, b1, b3])]
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F<S>, odd: F<S>) -> [F<S>; 2] {
        let [e0, e1, e2, e3] = even.0;
        let [o0, o1, o2, o3] = odd.0;
        [F([e0, o0, e1, o1]), F([e2, o2, e3, o3])]
    }
    #[inline(always)]
    fn interleave(self, a: F<S>, b: F<S>) -> [F<S>; 2] {
        let low = each!(S::interleave_low, a.0, b.0);
        let high = each!(S::interleave_high, a.0, b.0);
        [F([low[0], high[0], low[1], high[1]]), F([low[2], high[2], low[3], high[3]])]
    }
    #[inline(always)]
    fn deinterleave(self, a: F<S>, b: F<S>) -> [F<S>; 2] {
        let left = [a.0[0], a.0[2], b.0[0], b.0[2]];
        let right = [a.0[1], a.0[3], b.0[1], b.0[3]];
        [F(each!(S::even, left, right)), F(each!(S::odd, left, right))]
    }
    #[inline(always)]
    fn transpose(self, v: [F<S>; LANES]) -> [F<S>; LANES] {
        let mut out = v;
        for rows in 0..4 {
            for q in 0..4 {
                let row = |i: usize| v[4 * rows + i].0[q];
                let block = transpose4::<S>([row(0), row(1), row(2), row(3)]);
                for i in 0..4 {
                    out[4 * q + i].0[rows] = block[i];
                }
            }
        }
        out
    }
}
