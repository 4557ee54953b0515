//! The traits of vectors: numbers in lanes, and a truth value for each.

use super::{LANES, Real, RowLayout, rows};
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// A truth value per lane of `V`.
pub trait Mask<V>:
    Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self>
{
    /// Takes `a` where the mask holds, `b` elsewhere.
    fn select(self, a: V, b: V) -> V;
    /// Takes `v` where the mask holds, 0 elsewhere.
    fn select_or_zero(self, v: V) -> V;
    /// Returns whether any lane holds.
    fn any(self) -> bool;
    /// Returns lane i as bit i.
    fn to_bits(self) -> u32;
}

/// Numbers in lanes, one operation on all lanes at a time.
///
/// Implementations: `f64` and `f32` (one lane), and the 16 `f32` lanes of every
/// [`super::SimdLevel`]. The type of a level's vector is known inside a kernel only, so a
/// vector proves that the processor has the level. Lanes never mix: a NaN stays in its own.
/// Comparisons with NaN are false.
pub trait Vector:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// Type of one lane.
    type Element: Real;
    /// Result of a comparison.
    type Mask: Mask<Self>;
    /// Number of lanes, at most [`LANES`].
    const LANES: usize;
    /// Number of vectors that the registers hold at once.
    const REGISTERS: usize;

    /// Puts `v` into every lane.
    fn splat(v: Self::Element) -> Self;
    /// Puts `v`, rounded to the element's type, into every lane.
    fn constant(v: f64) -> Self;
    /// Loads the first [`Vector::LANES`] elements.
    fn load(from: &[Self::Element; LANES]) -> Self;
    /// Stores into the first [`Vector::LANES`] elements.
    fn store(self, to: &mut [Self::Element; LANES]);
    /// Loads `L` ≤ 16 elements of each row: lane r of vector i is element i of row r.
    /// Lanes past `layout.count` repeat the last row.
    ///
    /// # Panics
    /// If `rows` ends before the last row's element `L` − 1, or `layout.count` is 0.
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[Self::Element], layout: RowLayout) -> [Self; L] {
        rows::load(rows, layout)
    }
    /// Stores vectors as rows, the inverse of [`Vector::load_rows`]. Lanes past
    /// `layout.count` are not stored.
    ///
    /// # Panics
    /// As [`Vector::load_rows`].
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[Self; L], layout: RowLayout, rows: &mut [Self::Element]) {
        rows::store(from, layout, rows);
    }

    /// self·b + c; rounded once where the level fuses.
    fn fma(self, b: Self, c: Self) -> Self;
    /// c − self·b; rounded once where the level fuses.
    fn fnma(self, b: Self, c: Self) -> Self;
    /// Returns `other` where it is greater than `self`, else `self`: a NaN of `self` stays,
    /// one of `other` is ignored.
    fn max(self, other: Self) -> Self;
    /// Returns `other` where it is less than `self`, else `self`: a NaN of `self` stays, one
    /// of `other` is ignored.
    fn min(self, other: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Largest whole number not above.
    fn floor(self) -> Self;
    /// self < other.
    fn lt(self, other: Self) -> Self::Mask;
    /// self ≤ other.
    fn le(self, other: Self) -> Self::Mask;

    /// eˣ. In `f32`: 0 below −87.3, e⁸⁸ above 88.
    fn exp(self) -> Self;
    /// eˣ − 1 without cancellation. In `f32`: e⁸⁸ above 88.
    fn exp_m1(self) -> Self;
    /// Hyperbolic tangent.
    fn tanh(self) -> Self;
    /// Natural logarithm of a positive normal number; ∞ and NaN stay.
    fn ln(self) -> Self;
    /// log₂ of a positive normal number; ∞ and NaN stay.
    fn log2(self) -> Self;
    /// ln(1 + x) without cancellation.
    fn ln_1p(self) -> Self;
    /// Sine and cosine, radians.
    fn sin_cos(self) -> (Self, Self);
}
