//! `f32` and `f64`: the elements of vectors, and vectors of one lane themselves.

use super::{F32Vector, IntVector, Kernel, LANES, Mask, Simd, SimdLevel, Vector, elementary};
use std::iter::Sum;
use std::num::Wrapping;
use std::ops::{AddAssign, MulAssign};

/// `f32` (inference and training) or `f64` (oracles and finite differences).
///
/// The elementary functions of `f32` are those of `simd::elementary`, so that loops over them
/// vectorize; those of `f64` are the standard library's.
pub trait Real:
    Vector<Element = Self, Mask = bool>
    + Default
    + PartialOrd
    + std::fmt::Debug
    + Send
    + Sync
    + Sum
    + AddAssign
    + MulAssign
    + 'static
{
    /// Widens to double precision.
    fn to_f64(self) -> f64;
    /// Returns whether the number is neither NaN nor infinite.
    fn is_finite(self) -> bool;
    /// Runs `kernel` on the best vectors for this type: those of [`SimdLevel::best`] for
    /// `f32`, single numbers for `f64`.
    fn dispatch<K: VectorKernel<Self>>(kernel: K) -> K::Output;
}

/// Work on vectors with elements `T`, for [`Real::dispatch`]. Mark `run`
/// `#[inline(always)]`.
pub trait VectorKernel<T: Real> {
    /// Result of the work.
    type Output;
    /// Does the work.
    fn run<V: Vector<Element = T>>(self) -> Self::Output;
}

/// A [`VectorKernel`] as a [`Kernel`].
pub(super) struct OnLevel<K>(pub(super) K);

impl<K: VectorKernel<f32>> Kernel for OnLevel<K> {
    type Output = K::Output;
    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> K::Output {
        self.0.run::<S::F>()
    }
}

impl Real for f32 {
    #[inline(always)]
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        f32::is_finite(self)
    }
    #[inline]
    fn dispatch<K: VectorKernel<f32>>(kernel: K) -> K::Output {
        SimdLevel::best().run(OnLevel(kernel))
    }
}

impl Real for f64 {
    #[inline(always)]
    fn to_f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        f64::is_finite(self)
    }
    #[inline]
    fn dispatch<K: VectorKernel<f64>>(kernel: K) -> K::Output {
        kernel.run::<f64>()
    }
}

/// The functions of [`Vector`] that single numbers have alike.
macro_rules! one_lane {
    ($t:ty) => {
        type Element = $t;
        type Mask = bool;
        const LANES: usize = 1;
        const REGISTERS: usize = 16;

        #[inline(always)]
        fn splat(v: $t) -> $t {
            v
        }
        #[inline(always)]
        fn constant(v: f64) -> $t {
            v as $t
        }
        #[inline(always)]
        fn load(from: &[$t; LANES]) -> $t {
            from[0]
        }
        #[inline(always)]
        fn store(self, to: &mut [$t; LANES]) {
            to[0] = self;
        }
        #[inline(always)]
        fn fma(self, b: $t, c: $t) -> $t {
            self * b + c
        }
        #[inline(always)]
        fn fnma(self, b: $t, c: $t) -> $t {
            c - self * b
        }
        #[inline(always)]
        fn max(self, other: $t) -> $t {
            if other > self { other } else { self }
        }
        #[inline(always)]
        fn min(self, other: $t) -> $t {
            if other < self { other } else { self }
        }
        #[inline(always)]
        fn sqrt(self) -> $t {
            <$t>::sqrt(self)
        }
        #[inline(always)]
        fn abs(self) -> $t {
            <$t>::abs(self)
        }
        #[inline(always)]
        fn floor(self) -> $t {
            <$t>::floor(self)
        }
        #[inline(always)]
        fn lt(self, other: $t) -> bool {
            self < other
        }
        #[inline(always)]
        fn le(self, other: $t) -> bool {
            self <= other
        }
    };
}

impl Vector for f32 {
    one_lane!(f32);
    elementary::functions!();
}

impl Vector for f64 {
    one_lane!(f64);

    #[inline(always)]
    fn exp(self) -> f64 {
        f64::exp(self)
    }
    #[inline(always)]
    fn exp_m1(self) -> f64 {
        f64::exp_m1(self)
    }
    #[inline(always)]
    fn tanh(self) -> f64 {
        f64::tanh(self)
    }
    #[inline(always)]
    fn ln(self) -> f64 {
        f64::ln(self)
    }
    #[inline(always)]
    fn log2(self) -> f64 {
        f64::log2(self)
    }
    #[inline(always)]
    fn ln_1p(self) -> f64 {
        f64::ln_1p(self)
    }
    #[inline(always)]
    fn sin_cos(self) -> (f64, f64) {
        f64::sin_cos(self)
    }
}

macro_rules! bool_mask {
    ($($t:ty),*) => { $(
        impl Mask<$t> for bool {
            #[inline(always)]
            fn select(self, a: $t, b: $t) -> $t {
                if self { a } else { b }
            }
            #[inline(always)]
            fn select_or_zero(self, v: $t) -> $t {
                if self { v } else { 0.0 }
            }
            #[inline(always)]
            fn any(self) -> bool {
                self
            }
            #[inline(always)]
            fn to_bits(self) -> u32 {
                u32::from(self)
            }
        }
    )* };
}
bool_mask!(f32, f64);

impl F32Vector for f32 {
    type Int = Wrapping<i32>;

    #[inline(always)]
    fn approx_sqrt(self) -> f32 {
        f32::sqrt(self)
    }
    #[inline(always)]
    fn neg_abs(self) -> f32 {
        -f32::abs(self)
    }
    #[inline(always)]
    fn ceil(self) -> f32 {
        f32::ceil(self)
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (f32, f32) {
        let n = self.round_ties_even();
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: f32) -> f32 {
        self * f32::from_bits(((e as i32 + 127) << 23) as u32)
    }
    #[inline(always)]
    fn to_bits(self) -> Wrapping<i32> {
        Wrapping(f32::to_bits(self) as i32)
    }
    #[inline(always)]
    fn from_bits(v: Wrapping<i32>) -> f32 {
        f32::from_bits(v.0 as u32)
    }
    #[inline(always)]
    fn to_int(self) -> Wrapping<i32> {
        Wrapping(self as i32)
    }
    #[inline(always)]
    fn from_int(v: Wrapping<i32>) -> f32 {
        v.0 as f32
    }
}

impl IntVector for Wrapping<i32> {
    #[inline(always)]
    fn splat(v: i32) -> Self {
        Wrapping(v)
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        to[0] = self.0;
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> Self {
        Wrapping(self.0 << N)
    }
    #[inline(always)]
    fn shl_each(self, by: Self) -> Self {
        Wrapping(self.0 << (by.0 & 31))
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> Self {
        Wrapping(self.0 >> N)
    }
}
