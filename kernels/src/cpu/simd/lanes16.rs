//! Sixteen `f32` lanes: bits, shuffles, masked loads and prefetches.

use super::{Kernel, LANES, Mask, Vector};
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Sub};

/// Relative error of [`F32Vector::approx_sqrt`]: AVX2's reciprocal root has 11.4 bits.
pub(crate) const APPROX_SQRT_ERROR: f32 = 4e-4;

/// Returns the lane of element i of sixteen that are stored as a transposed 4×4 matrix. The
/// function is its own inverse.
pub(crate) const fn transpose4x4_index(i: usize) -> usize {
    i % 4 * 4 + i / 4
}

/// Returns the first `n` lanes as bits, 1 ≤ n ≤ 16.
#[inline(always)]
pub(crate) const fn first_lanes_bits(n: usize) -> u16 {
    u16::MAX >> (LANES - n)
}

/// `i32` lanes; sums and differences wrap.
pub(crate) trait IntVector:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + BitAnd<Output = Self>
    + BitOr<Output = Self>
    + BitXor<Output = Self>
{
    /// Puts `v` into every lane.
    fn splat(v: i32) -> Self;
    /// Stores into the first elements, as many as there are lanes.
    fn store(self, to: &mut [i32; LANES]);
    /// self << N.
    fn shl<const N: u32>(self) -> Self;
    /// self << by, lane by lane, 0 ≤ by < 32.
    fn shl_each(self, by: Self) -> Self;
    /// self >> N, the sign kept.
    fn shr<const N: u32>(self) -> Self;
}

/// `f32` lanes and their bits.
pub(crate) trait F32Vector: Vector<Element = f32> {
    /// `i32` lanes, as many.
    type Int: IntVector;

    /// √self to a relative [`APPROX_SQRT_ERROR`] for numbers from [`f32::MIN_POSITIVE`] on.
    /// Levels differ in this operation only; use it where a margin covers the error.
    fn approx_sqrt(self) -> Self;
    /// −|self|.
    fn neg_abs(self) -> Self;
    /// Least whole number not below.
    fn ceil(self) -> Self;
    /// (n, self − n), n the nearest whole number, ties to even. Exact for |self| < 2²² but
    /// for the sign of zeros; any two numbers beyond.
    fn round_and_fraction(self) -> (Self, Self);
    /// self·2^e for self of magnitude ½ to 2 and whole e, −125 ≤ e ≤ 126; any number in
    /// other lanes.
    fn scale_by_power_of_two(self, e: Self) -> Self;
    /// Reinterprets the lanes' bits.
    fn to_bits(self) -> Self::Int;
    /// Reinterprets bits as floats.
    fn from_bits(v: Self::Int) -> Self;
    /// Truncates towards zero; any number for NaN and for lanes outside i32.
    fn to_int(self) -> Self::Int;
    /// Converts whole numbers.
    fn from_int(v: Self::Int) -> Self;
}

/// A SIMD level's `f32` vectors, 16 lanes each. A value of the type is a token: it proves
/// that the processor has the level, and exists in a [`super::Kernel`] only.
#[allow(dead_code, reason = "a complete set; no build uses every operation")]
pub(crate) trait Simd: Copy + Send + Sync + 'static {
    /// Sixteen floats.
    type F: F32Vector<Mask = Self::M, Int = Self::I>;
    /// Sixteen truth values.
    type M: Mask<Self::F>;
    /// Sixteen integers.
    type I: IntVector;

    /// Vectors that the registers hold at once: the limit of a register tile.
    const REGISTERS: usize = <Self::F as Vector>::REGISTERS;

    /// Runs `kernel` as a function of its own, compiled for this level. All callers share its
    /// code; `kernel.run(self)` would compile a copy into each of them. It serves kernels that
    /// take much longer than a call.
    fn call<K: Kernel>(self, kernel: K) -> K::Output;

    /// Puts `v` into every lane.
    #[inline(always)]
    fn splat(self, v: f32) -> Self::F {
        Self::F::splat(v)
    }
    /// Loads 16 floats.
    #[inline(always)]
    fn load(self, v: &[f32; LANES]) -> Self::F {
        Self::F::load(v)
    }
    /// Stores 16 floats.
    #[inline(always)]
    fn store(self, v: Self::F, to: &mut [f32; LANES]) {
        v.store(to);
    }
    /// Stores 16 floats into uninitialised memory.
    fn store_uninit(self, v: Self::F, to: &mut [MaybeUninit<f32>; LANES]);
    /// Makes a mask: bit i of the low 16 is lane i.
    fn mask_from_bits(self, bits: u32) -> Self::M;

    /// Prefetches the cache line at `v`; any address is allowed.
    fn prefetch<T>(self, v: *const T);
    /// Prefetches into the second-level cache, which has more requests in flight, for
    /// memory that is read microseconds later.
    fn prefetch_l2<T>(self, v: *const T);

    /// Sums the lanes: lane i + lane (i + 8), then + 4, + 2, + 1.
    fn sum(self, v: Self::F) -> f32;
    /// [`Simd::sum`] of each of up to 16 vectors.
    #[inline(always)]
    fn sums<const N: usize>(self, v: [Self::F; N]) -> [f32; N] {
        let mut out = [0.0; N];
        for (out, v) in out.iter_mut().zip(v) {
            *out = self.sum(v);
        }
        out
    }

    /// Gathers four floats at each of 16 places as four vectors: lane i of vector c is
    /// `from[at[i] + offset + c]`. Zeros if any of them lies outside.
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [Self::F; 4];
    /// Loads `from[i]` into the lanes whose bit i is set; 0 into the others.
    ///
    /// # Safety
    /// These floats must be readable.
    #[inline(always)]
    unsafe fn load_masked(self, from: *const f32, bits: u16) -> Self::F {
        if bits == u16::MAX {
            // SAFETY: the caller guarantees all sixteen.
            return self.load(unsafe { &*from.cast() });
        }
        let mut out = [0.0; LANES];
        for (i, out) in out.iter_mut().enumerate() {
            if bits & (1 << i) != 0 {
                // SAFETY: the caller guarantees this float.
                *out = unsafe { *from.wrapping_add(i) };
            }
        }
        self.load(&out)
    }
    /// Stores the lanes whose bit i is set to `to[i]`.
    ///
    /// # Safety
    /// These places must be writable, and no other thread may use them.
    #[inline(always)]
    unsafe fn store_masked(self, v: Self::F, to: *mut MaybeUninit<f32>, bits: u16) {
        if bits == u16::MAX {
            // SAFETY: the caller guarantees all sixteen places, for this thread alone.
            return self.store_uninit(v, unsafe { &mut *to.cast() });
        }
        let mut lanes = [0.0; LANES];
        v.store(&mut lanes);
        for (i, v) in lanes.into_iter().enumerate() {
            if bits & (1 << i) != 0 {
                // SAFETY: the caller guarantees this place, for this thread alone.
                unsafe { to.wrapping_add(i).write(MaybeUninit::new(v)) };
            }
        }
    }

    /// Rotates 16 elements in the order of [`transpose4x4_index`]: element i becomes
    /// element i + 1, the last one the first.
    fn rotate_left(self, v: Self::F) -> Self::F;
    /// The inverse of [`Simd::rotate_left`].
    fn rotate_right(self, v: Self::F) -> Self::F;
    /// Interleaves the lanes of `a` and `b`, as two vectors: a₀ b₀ a₁ b₁ …
    fn interleave(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// The inverse of [`Simd::interleave`]: even lanes of `a`, then of `b`; and odd ones.
    fn deinterleave(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// Transposes: lane j of vector i goes to lane i of vector j.
    fn transpose(self, v: [Self::F; LANES]) -> [Self::F; LANES];
    /// Transposes the 4×4 matrix that each quarter of the vectors makes. From 16 rows of
    /// four, of which each vector holds four, it makes columns in the order of
    /// [`transpose4x4_index`]. It is its own inverse.
    fn transpose_quarters(self, v: [Self::F; 4]) -> [Self::F; 4];
    /// Quarters 0 and 2 of `a`, then of `b`; and quarters 1 and 3.
    fn deinterleave_quarters(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// The inverse of [`Simd::deinterleave_quarters`].
    fn interleave_quarters(self, even: Self::F, odd: Self::F) -> [Self::F; 2];
    /// Columns, in the order of [`transpose4x4_index`], of a matrix of 16 rows of eight, of
    /// which each vector holds two rows.
    #[inline(always)]
    fn columns_of_8(self, [a, b, c, d, e, f, g, h]: [Self::F; 8]) -> [Self::F; 8] {
        let even = self.transpose_quarters([a, c, e, g]);
        let odd = self.transpose_quarters([b, d, f, h]);
        let mut out = [a; 8];
        for i in 0..4 {
            [out[i], out[4 + i]] = self.deinterleave_quarters(even[i], odd[i]);
        }
        out
    }
    /// The inverse of [`Simd::columns_of_8`].
    #[inline(always)]
    fn rows_of_8(self, v: [Self::F; 8]) -> [Self::F; 8] {
        let mut even = [v[0]; 4];
        let mut odd = [v[0]; 4];
        for i in 0..4 {
            [even[i], odd[i]] = self.interleave_quarters(v[i], v[4 + i]);
        }
        let [a, c, e, g] = self.transpose_quarters(even);
        let [b, d, f, h] = self.transpose_quarters(odd);
        [a, b, c, d, e, f, g, h]
    }
}

/// Returns whether four floats from `offset` past each place of `at` lie inside `len`.
#[inline(always)]
pub(crate) fn all_inside(len: usize, at: &[usize; LANES], offset: usize) -> bool {
    let most = at.iter().fold(0, |m, &a| if a > m { a } else { m });
    // Sums cannot wrap: a slice is shorter than half of usize's range.
    let room = len.wrapping_sub(offset).wrapping_sub(4);
    len >= 4 && offset <= len - 4 && most <= room
}
