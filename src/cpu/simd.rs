//! Sixteen `f32` lanes on every processor: one algorithm, chosen at run time.
//!
//! A kernel is written once against `Simd` and run by `Tier::run`, which
//! compiles it for each instruction set. The number of lanes is 16 in every tier, so
//! the tiers do the same operations in the same order. All operations round as IEEE
//! 754 says, none is an approximation: `Avx2`, `Avx512` and `Neon`, which fuse
//! multiply and add, give the same bits; `Scalar` rounds the product as well and so
//! differs in the last ones.
//!
//! What a kernel calls must be `#[inline(always)]` down to here (closures included),
//! else it is compiled without the instruction set and crawls.

mod array;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(test)]
mod tests;

use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};
use std::sync::OnceLock;

/// Lanes of a vector, in every tier.
pub const LANES: usize = 16;

/// The lane of number i of sixteen that are a 4×4 square read by columns, not rows; its
/// own inverse.
pub(crate) const fn square(i: usize) -> usize {
    i % 4 * 4 + i / 4
}

/// The first `n` lanes as bits, 1 ≤ n ≤ 16.
#[inline(always)]
pub(crate) const fn first_lanes(n: usize) -> u16 {
    u16::MAX >> (LANES - n)
}

/// Relative error of [`Simd::rough_sqrt`]: AVX2's reciprocal root has 11.4 bits.
pub(crate) const ROUGH: f32 = 4e-4;

/// An instruction set that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tier {
    /// What the target has without asking; products and sums round separately.
    Scalar,
    /// x86-64-v3: AVX2 and FMA, a vector is two registers.
    Avx2,
    /// x86-64-v4: AVX-512 F, BW, CD, DQ, VL, a vector is one register.
    Avx512,
    /// AArch64, where NEON and fused multiply-add are always there.
    Neon,
}

impl Tier {
    /// The tiers that this processor runs, slowest first.
    pub fn available() -> &'static [Tier] {
        static FOUND: OnceLock<Vec<Tier>> = OnceLock::new();
        FOUND.get_or_init(|| {
            #[allow(unused_mut, reason = "targets other than these two have one tier")]
            let mut found = vec![Tier::Scalar];
            #[cfg(target_arch = "x86_64")]
            {
                if avx2::detected() {
                    found.push(Tier::Avx2);
                }
                if avx512::detected() {
                    found.push(Tier::Avx512);
                }
            }
            #[cfg(target_arch = "aarch64")]
            found.push(Tier::Neon);
            found
        })
    }

    /// The fastest tier here, or the one that the environment variable
    /// `SUBSPLAT_SIMD` names (`scalar`, `avx2`, `avx512`, `neon`; read once, and
    /// passed over where the processor lacks it).
    pub fn best() -> Tier {
        static BEST: OnceLock<Tier> = OnceLock::new();
        *BEST.get_or_init(|| {
            let named = std::env::var("SUBSPLAT_SIMD").ok();
            let named = named.and_then(|name| Self::named(&name)).filter(|t| t.is_available());
            named.or(Self::available().last().copied()).unwrap_or(Tier::Scalar)
        })
    }

    /// The tier called `name` in `SUBSPLAT_SIMD`.
    pub fn named(name: &str) -> Option<Tier> {
        [Tier::Scalar, Tier::Avx2, Tier::Avx512, Tier::Neon].into_iter().find(|t| t.name() == name)
    }

    /// Its name in `SUBSPLAT_SIMD`.
    pub fn name(self) -> &'static str {
        match self {
            Tier::Scalar => "scalar",
            Tier::Avx2 => "avx2",
            Tier::Avx512 => "avx512",
            Tier::Neon => "neon",
        }
    }

    /// Whether this processor runs it.
    pub fn is_available(self) -> bool {
        Self::available().contains(&self)
    }

    /// Runs `kernel` compiled for this tier (for [`Tier::Scalar`] where the processor
    /// lacks it). Call it inside a parallel task, not around one: what another
    /// thread runs is compiled apart.
    #[inline]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Tier::Avx512 if self.is_available() => {
                // SAFETY: the processor has the features, as just asked.
                unsafe { avx512::run(kernel) }
            }
            #[cfg(target_arch = "x86_64")]
            Tier::Avx2 if self.is_available() => {
                // SAFETY: the processor has the features, as just asked.
                unsafe { avx2::run(kernel) }
            }
            #[cfg(target_arch = "aarch64")]
            Tier::Neon => kernel.run(array::Fused),
            _ => kernel.run(array::Separate),
        }
    }
}

impl Default for Tier {
    fn default() -> Self {
        Tier::best()
    }
}

/// Work that [`Tier::run`] compiles for a tier. Mark `run` `#[inline(always)]`.
pub(crate) trait Kernel {
    /// What `run` returns.
    type Output;
    /// The work; `s` makes vectors.
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

/// Sixteen floats.
pub(crate) trait Floats:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
}

/// Sixteen truths.
pub(crate) trait Mask:
    Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self>
{
}

/// Sixteen `i32`; sums and differences wrap.
pub(crate) trait Ints:
    Copy + Add<Output = Self> + Sub<Output = Self> + BitAnd<Output = Self> + BitOr<Output = Self>
{
}

/// A token that the processor has a tier, and the operations on its vectors.
///
/// Comparisons are false where an operand is NaN; `min` and `max` then give their
/// second operand.
#[allow(dead_code, reason = "a vocabulary, not all of whose words every kernel uses")]
pub(crate) trait Simd: Copy + Send + Sync + 'static {
    type F: Floats;
    type M: Mask;
    type I: Ints;

    /// Vectors that fit in the registers at once: how large a register tile may be.
    const REGISTERS: usize;

    /// `v` in every lane.
    fn splat(self, v: f32) -> Self::F;
    fn load(self, v: &[f32; LANES]) -> Self::F;
    fn store(self, v: Self::F, to: &mut [f32; LANES]);
    /// Into memory that nobody has written yet.
    fn store_fresh(self, v: Self::F, to: &mut [MaybeUninit<f32>; LANES]);
    /// a·b + c; rounded once where the tier fuses.
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c − a·b; rounded once where the tier fuses.
    fn fnma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// a < b ? a : b.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// a > b ? a : b.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    fn sqrt(self, v: Self::F) -> Self::F;
    /// √v to a relative [`ROUGH`] for v ≥ [`f32::MIN_POSITIVE`]: the one operation in
    /// which tiers differ, for tests that leave a margin.
    fn rough_sqrt(self, v: Self::F) -> Self::F;
    fn abs(self, v: Self::F) -> Self::F;
    /// −|v|.
    fn negative(self, v: Self::F) -> Self::F;
    fn floor(self, v: Self::F) -> Self::F;
    fn ceil(self, v: Self::F) -> Self::F;
    /// (n, v − n), n the nearest whole number (ties to even), exact for |v| < 2²²
    /// but for the sign of zeros; any two numbers beyond.
    fn split(self, v: Self::F) -> (Self::F, Self::F);
    /// v·2^e for v of magnitude ½ to 2 and whole e, −125 ≤ e ≤ 126; any number in
    /// other lanes.
    fn scale(self, v: Self::F, e: Self::F) -> Self::F;

    /// a < b.
    fn lt(self, a: Self::F, b: Self::F) -> Self::M;
    /// a ≤ b.
    fn le(self, a: Self::F, b: Self::F) -> Self::M;
    /// m ? a : b.
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// m ? v : 0.
    fn keep(self, m: Self::M, v: Self::F) -> Self::F;
    /// Lane i as bit i.
    fn bits(self, m: Self::M) -> u32;
    /// Bit i of the low 16 as lane i.
    fn mask(self, bits: u32) -> Self::M;
    fn any(self, m: Self::M) -> bool;

    /// `v` in every lane.
    fn splat_int(self, v: i32) -> Self::I;
    fn store_int(self, v: Self::I, to: &mut [i32; LANES]);
    /// The floats' bits.
    fn to_bits(self, v: Self::F) -> Self::I;
    fn of_bits(self, v: Self::I) -> Self::F;
    /// Truncated towards zero; any number for lanes outside i32 and for NaN.
    fn to_int(self, v: Self::F) -> Self::I;
    fn of_int(self, v: Self::I) -> Self::F;
    /// v << N.
    fn shl<const N: u32>(self, v: Self::I) -> Self::I;
    /// v << by, 0 ≤ by < 32.
    fn shift(self, v: Self::I, by: Self::I) -> Self::I;
    /// v >> N, the sign kept.
    fn shr<const N: u32>(self, v: Self::I) -> Self::I;

    /// Asks for the cache line at `v`; any address will do.
    fn prefetch<T>(self, v: *const T);
    /// The same into the second-level cache, where more can be under way: for what is
    /// needed microseconds later.
    fn prefetch_early<T>(self, v: *const T);
    /// Sum of the lanes: lane i + lane (i + 8), then + 4, + 2, + 1.
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
    /// Four floats at each of 16 places of `from`, as four vectors: lane i of
    /// vector c is `from[at[i] + offset + c]`. Zeros if any of them lies outside.
    fn load4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [Self::F; 4];
    /// The float i places behind `from` in the lanes whose bit i is set, zeros in the others.
    ///
    /// # Safety
    /// Those floats must be there.
    unsafe fn load_lanes(self, from: *const f32, bits: u16) -> Self::F;
    /// The lanes whose bit i is set to i places behind `to`.
    ///
    /// # Safety
    /// Those places must be there, and nobody else's.
    unsafe fn store_lanes(self, v: Self::F, to: *mut MaybeUninit<f32>, bits: u16);
    /// Of sixteen in the order of [`square`]: the one after each, the first after the last.
    fn after(self, v: Self::F) -> Self::F;
    /// The inverse of [`Simd::after`].
    fn before(self, v: Self::F) -> Self::F;
    /// The lanes of `a` and `b` in turns, as two vectors: a₀ b₀ a₁ b₁ …
    fn zip(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// The inverse of [`Simd::zip`]: even lanes of `a`, then of `b`; and odd ones.
    fn unzip(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// Rows and columns exchanged: lane j of vector i goes to lane i of vector j.
    fn transpose(self, v: [Self::F; LANES]) -> [Self::F; LANES];
    /// Rows and columns of the 4×4 matrix exchanged that each quarter of the vectors makes.
    /// Of sixteen rows of four, of which each vector holds four, it makes columns in the
    /// order of [`square`], and is its own inverse.
    fn transpose4(self, v: [Self::F; 4]) -> [Self::F; 4];
    /// Quarters 0 and 2 of `a`, then of `b`; and quarters 1 and 3.
    fn split_quarters(self, a: Self::F, b: Self::F) -> [Self::F; 2];
    /// The inverse of [`Simd::split_quarters`].
    fn join_quarters(self, even: Self::F, odd: Self::F) -> [Self::F; 2];
    /// Columns, in the order of [`square`], of a matrix of 16 rows of eight, of which each
    /// vector holds two rows.
    #[inline(always)]
    fn columns8(self, [a, b, c, d, e, f, g, h]: [Self::F; 8]) -> [Self::F; 8] {
        let (even, odd) = (self.transpose4([a, c, e, g]), self.transpose4([b, d, f, h]));
        let mut out = [a; 8];
        for i in 0..4 {
            [out[i], out[4 + i]] = self.split_quarters(even[i], odd[i]);
        }
        out
    }
    /// The inverse of [`Simd::columns8`].
    #[inline(always)]
    fn rows8(self, v: [Self::F; 8]) -> [Self::F; 8] {
        let (mut even, mut odd) = ([v[0]; 4], [v[0]; 4]);
        for i in 0..4 {
            [even[i], odd[i]] = self.join_quarters(v[i], v[4 + i]);
        }
        let ([a, c, e, g], [b, d, f, h]) = (self.transpose4(even), self.transpose4(odd));
        [a, b, c, d, e, f, g, h]
    }
}

/// Whether four floats from `offset` past each place of `at` lie inside `len`.
#[inline(always)]
fn all_inside(len: usize, at: &[usize; LANES], offset: usize) -> bool {
    let most = at.iter().fold(0, |m, &a| if a > m { a } else { m });
    // No sum can wrap: slices are shorter than half of what a usize counts.
    let room = len.wrapping_sub(offset).wrapping_sub(4);
    len >= 4 && offset <= len - 4 && most <= room
}

/// 2^p to 2 ulp for −125 ≤ p ≤ 126, any number elsewhere.
#[inline(always)]
pub(crate) fn exp2<S: Simd>(s: S, p: S::F) -> S::F {
    let (n, f) = s.split(p);
    s.scale(exp2_part(s, f), n)
}

/// 2^p to 2 ulp for −125 ≤ p ≤ 126, NaN for NaN, any number elsewhere: with sums in place
/// of [`Simd::split`] and [`Simd::scale`], which keep busy what products need.
#[inline(always)]
pub(crate) fn exp2_by_sums<S: Simd>(s: S, p: S::F) -> S::F {
    // 1.5·2²³: a sum with it is rounded to a whole number that stands in the low bits of
    // the mantissa; 127 is the exponent's bias.
    let magic = s.splat(12_582_912.0 + 127.0);
    let shifted = p + magic;
    let f = p - (shifted - magic);
    exp2_part(s, f) * s.of_bits(s.shl::<23>(s.to_bits(shifted)))
}

/// 2^f on [−½, ½]: a minimax polynomial of degree 5 (relative error 7.5e-8; Remez).
#[inline(always)]
fn exp2_part<S: Simd>(s: S, f: S::F) -> S::F {
    const C: [f32; 6] =
        [1.000_000_1, 0.693_146_94, 0.240_221_2, 0.055_507_13, 0.009_675_541, 0.001_327_647_2];
    let mut m = s.splat(C[5]);
    m = s.fma(m, f, s.splat(C[4]));
    m = s.fma(m, f, s.splat(C[3]));
    m = s.fma(m, f, s.splat(C[2]));
    m = s.fma(m, f, s.splat(C[1]));
    s.fma(m, f, s.splat(C[0]))
}

/// log₂ of a normal positive number to 3 ulp or 1e-7, whichever is more; anything
/// elsewhere. Mantissa in [√½, √2) by a minimax polynomial of degree 8 for
/// log₂(1 + t) / t (relative error 2.6e-8; Remez).
#[inline(always)]
pub(crate) fn log2<S: Simd>(s: S, v: S::F) -> S::F {
    const C: [f32; 9] = [
        std::f32::consts::LOG2_E,
        -0.721_347_35,
        0.480_910_64,
        -0.360_703_68,
        0.287_916_25,
        -0.238_944_82,
        0.215_715_6,
        -0.207_269_76,
        0.125_837_06,
    ];
    let bits = s.to_bits(v);
    let root_half = s.splat_int(std::f32::consts::FRAC_1_SQRT_2.to_bits() as i32);
    let e = s.shr::<23>(bits - root_half);
    let t = s.of_bits(bits - s.shl::<23>(e)) - s.splat(1.0);
    let mut m = s.splat(C[8]);
    m = s.fma(m, t, s.splat(C[7]));
    m = s.fma(m, t, s.splat(C[6]));
    m = s.fma(m, t, s.splat(C[5]));
    m = s.fma(m, t, s.splat(C[4]));
    m = s.fma(m, t, s.splat(C[3]));
    m = s.fma(m, t, s.splat(C[2]));
    m = s.fma(m, t, s.splat(C[1]));
    m = s.fma(m, t, s.splat(C[0]));
    s.fma(m, t, s.of_int(e))
}
