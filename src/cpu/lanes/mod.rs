//! One source for a scalar `f64` kernel and a vector `f32` kernel.
//!
//! A kernel is written over [`Lanes`], numbers that are calculated with in step, and
//! [`Machine`], which makes them from memory. [`Kernel::run`] is called with the
//! widest vectors that the processor has (`f32`), or with single numbers (`f64`, for
//! finite differences and oracles). Lanes never mix: a NaN stays in its own.
//!
//! What a kernel calls must be `#[inline(always)]`, so that it is compiled for the
//! instruction set of the vectors.

#[cfg(target_arch = "x86_64")]
mod transpose;
mod vector;

use super::real::Real;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// Most lanes of any machine.
pub const WIDTH_MAX: usize = 16;

/// Numbers in step.
pub trait Lanes:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// A truth value per lane.
    type Mask: Copy;
    /// `v` in every lane.
    fn of(self, v: f64) -> Self;
    /// self·b + c, rounded once where that is as fast.
    fn fma(self, b: Self, c: Self) -> Self;
    /// The greater; a NaN of `self` stays.
    fn max(self, other: Self) -> Self;
    /// The lesser; a NaN of `self` stays.
    fn min(self, other: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Largest whole number not above; for |x| < 2²².
    fn floor(self) -> Self;
    /// self < other; false for NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// `a` where the mask holds, else `b`.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// eˣ; an argument beyond the range of the type's exponent counts as its end.
    fn exp(self) -> Self;
    /// eˣ − 1 without cancellation.
    fn exp_m1(self) -> Self;
    /// Hyperbolic tangent.
    fn tanh(self) -> Self;
    /// Natural logarithm of a positive normal number.
    fn ln(self) -> Self;
    /// log₂ of a positive normal number.
    fn log2(self) -> Self;
    /// ln(1 + x) without cancellation.
    fn ln_1p(self) -> Self;
    /// Sine and cosine, radians.
    fn sin_cos(self) -> (Self, Self);
}

/// An instruction set.
pub trait Machine: Copy {
    /// The type in memory.
    type Scalar: Real;
    /// Its vector.
    type V: Lanes;
    /// Lanes of `V`, at most [`WIDTH_MAX`].
    const WIDTH: usize;
    /// `v` in every lane.
    fn splat(self, v: Self::Scalar) -> Self::V;
    /// The first `WIDTH` of `from`.
    fn load(self, from: &[Self::Scalar; WIDTH_MAX]) -> Self::V;
    /// Into the first `WIDTH` of `to`.
    fn store(self, v: Self::V, to: &mut [Self::Scalar; WIDTH_MAX]);
    /// `v` in every lane.
    #[inline(always)]
    fn of(self, v: f64) -> Self::V {
        self.splat(Self::Scalar::of(v))
    }
    /// Rows of `L` ≤ 16 numbers, `stride` apart, of `count` lanes: number i of every
    /// lane. Lanes above `count` repeat the last row.
    #[inline(always)]
    fn load_rows<const L: usize>(
        self,
        rows: &[Self::Scalar],
        (stride, count): (usize, usize),
    ) -> [Self::V; L] {
        load_rows(self, rows, (stride, count))
    }
    /// The inverse of [`Machine::load_rows`]: the first `count` lanes into their rows.
    #[inline(always)]
    fn store_rows<const L: usize>(
        self,
        from: &[Self::V; L],
        (stride, count): (usize, usize),
        rows: &mut [Self::Scalar],
    ) {
        store_rows(self, from, (stride, count), rows);
    }
}

/// Something to be done on the best machine for `T`.
pub trait Kernel<T> {
    /// What comes of it.
    type Output;
    /// The work.
    fn run<M: Machine<Scalar = T>>(self, m: M) -> Self::Output;
}

/// A number that kernels can be run on.
pub trait LaneReal: Real {
    /// Runs `kernel` on the best machine for this type.
    fn dispatch<K: Kernel<Self>>(kernel: K) -> K::Output;
}

impl LaneReal for f32 {
    fn dispatch<K: Kernel<f32>>(kernel: K) -> K::Output {
        struct Run<K>(K);
        impl<K: Kernel<f32>> pulp::WithSimd for Run<K> {
            type Output = K::Output;
            #[inline(always)]
            fn with_simd<S: pulp::Simd>(self, simd: S) -> K::Output {
                self.0.run(vector::Vectors(simd))
            }
        }
        pulp::Arch::new().dispatch(Run(kernel))
    }
}

impl LaneReal for f64 {
    fn dispatch<K: Kernel<f64>>(kernel: K) -> K::Output {
        kernel.run(Doubles)
    }
}

/// One `f64` at a time.
#[derive(Clone, Copy)]
struct Doubles;

impl Machine for Doubles {
    type Scalar = f64;
    type V = f64;
    const WIDTH: usize = 1;
    #[inline(always)]
    fn splat(self, v: f64) -> f64 {
        v
    }
    #[inline(always)]
    fn load(self, from: &[f64; WIDTH_MAX]) -> f64 {
        from[0]
    }
    #[inline(always)]
    fn store(self, v: f64, to: &mut [f64; WIDTH_MAX]) {
        to[0] = v;
    }
}

impl Lanes for f64 {
    type Mask = bool;
    #[inline(always)]
    fn of(self, v: f64) -> f64 {
        v
    }
    #[inline(always)]
    fn fma(self, b: f64, c: f64) -> f64 {
        self * b + c
    }
    #[inline(always)]
    fn max(self, other: f64) -> f64 {
        if other > self { other } else { self }
    }
    #[inline(always)]
    fn min(self, other: f64) -> f64 {
        if other < self { other } else { self }
    }
    #[inline(always)]
    fn sqrt(self) -> f64 {
        self.sqrt()
    }
    #[inline(always)]
    fn abs(self) -> f64 {
        self.abs()
    }
    #[inline(always)]
    fn floor(self) -> f64 {
        self.floor()
    }
    #[inline(always)]
    fn lt(self, other: f64) -> bool {
        self < other
    }
    #[inline(always)]
    fn select(mask: bool, a: f64, b: f64) -> f64 {
        if mask { a } else { b }
    }
    #[inline(always)]
    fn exp(self) -> f64 {
        self.exp()
    }
    #[inline(always)]
    fn exp_m1(self) -> f64 {
        self.exp_m1()
    }
    #[inline(always)]
    fn tanh(self) -> f64 {
        self.tanh()
    }
    #[inline(always)]
    fn ln(self) -> f64 {
        self.ln()
    }
    #[inline(always)]
    fn log2(self) -> f64 {
        self.log2()
    }
    #[inline(always)]
    fn ln_1p(self) -> f64 {
        self.ln_1p()
    }
    #[inline(always)]
    fn sin_cos(self) -> (f64, f64) {
        self.sin_cos()
    }
}

/// [`Machine::load_rows`] by single moves.
#[inline(always)]
fn load_rows<M: Machine, const L: usize>(
    m: M,
    rows: &[M::Scalar],
    (stride, count): (usize, usize),
) -> [M::V; L] {
    let mut tile = [[M::Scalar::default(); WIDTH_MAX]; L];
    for lane in 0..M::WIDTH {
        let at = lane.min(count - 1) * stride;
        for (out, &v) in tile.iter_mut().zip(&rows[at..at + L]) {
            out[lane] = v;
        }
    }
    let mut out = [m.of(0.0); L];
    for (out, tile) in out.iter_mut().zip(&tile) {
        *out = m.load(tile);
    }
    out
}

/// [`Machine::store_rows`] by single moves.
#[inline(always)]
fn store_rows<M: Machine, const L: usize>(
    m: M,
    from: &[M::V; L],
    (stride, count): (usize, usize),
    rows: &mut [M::Scalar],
) {
    let mut tile = [[M::Scalar::default(); WIDTH_MAX]; L];
    for (&v, tile) in from.iter().zip(&mut tile) {
        m.store(v, tile);
    }
    for lane in 0..count {
        let at = lane * stride;
        for (v, tile) in rows[at..at + L].iter_mut().zip(&tile) {
            *v = tile[lane];
        }
    }
}
