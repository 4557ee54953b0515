//! Fast algorithms for 3×3 convolutions along one axis; two of them nested make the
//! two-dimensional ones (Winograd 1980; Lavin and Gray 2016, section 4).
//!
//! Of stride 1, F(4, 3): six products for four outputs, at the points 0, ±1/√2, ±√2, ∞;
//! on noise the error is half of that of the usual 0, ±1, ±2, ∞.
//!
//! Of stride 2 the outer taps of the kernel meet places of one parity only, and the
//! middle tap those of the other: y(i) = w₀·e(i) + w₂·e(i + 1) + w₁·o(i). The first two
//! terms are F(4, 2), five products at ±1/2, ±6/5, ∞ (the least error on noise of a dozen
//! sets tried, half of that of 0, ±1, 2, ∞), the last is four plain products by the same
//! weight: nine for four outputs where the definition needs twelve, 81 and not 144 in two
//! dimensions. ∂L/∂x is the same algorithm turned over.

use crate::cpu::simd::{LANES, Simd, Vector};
use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};

/// Grid positions of a tile along an axis: outputs, or pairs of outputs.
pub(super) const TILE: usize = 4;
/// Weights along an axis, whatever the form: six points, or five and the middle tap.
pub(super) const WEIGHTS: usize = 6;
/// Those of two axes.
pub(super) const GROUPS: usize = WEIGHTS * WEIGHTS;

/// One of these algorithms along an axis: `IN` places read, `POINTS` products, `OUT`
/// outputs. The last weight is that of all products from the sixth on.
pub(super) trait Form<const IN: usize, const POINTS: usize, const OUT: usize>:
    Send + Sync
{
    /// From what one tile reads to what the next does.
    const READ: usize;
    /// Of the places read beyond that, those before; it and what comes after are at most one.
    const BEFORE: usize;

    /// What the products are taken of.
    fn points<S: Simd>(s: S, x: [S::F; IN]) -> [S::F; POINTS];

    /// Outputs from the products.
    fn outputs<S: Simd>(s: S, y: [S::F; POINTS]) -> [S::F; OUT];

    /// The kernel's weights from its taps.
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS];
}

/// What ∂L/∂w needs besides.
pub(super) trait Adjoint<const POINTS: usize> {
    /// The adjoint of [`Form::outputs`].
    fn spread<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; POINTS];

    /// The adjoint of [`Form::weights`].
    fn taps<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3];
}

/// Stride 1, both ways.
pub(super) struct Unit;

impl Form<6, 6, 4> for Unit {
    const READ: usize = TILE;
    const BEFORE: usize = 1;

    #[inline(always)]
    fn points<S: Simd>(s: S, x: [S::F; 6]) -> [S::F; 6] {
        let (half, two) = (s.splat(0.5), s.splat(2.0));
        let both = s.splat(2.5);
        let first = both.fnma(x[2], x[0] + x[4]);
        let last = both.fnma(x[3], x[1] + x[5]);
        let (even, odd) = (two.fnma(x[2], x[4]), two.fnma(x[1], x[3]));
        let root = s.splat(FRAC_1_SQRT_2);
        let (a, b) = (root.fma(odd, even), root.fnma(odd, even));
        let (even, odd) = (half.fnma(x[2], x[4]), half.fnma(x[1], x[3]));
        let root = s.splat(SQRT_2);
        [first, a, b, root.fma(odd, even), root.fnma(odd, even), last]
    }

    #[inline(always)]
    fn outputs<S: Simd>(s: S, y: [S::F; 6]) -> [S::F; 4] {
        let (near, far) = (y[1] + y[2], y[3] + y[4]);
        let (near_odd, far_odd) = (y[1] - y[2], y[3] - y[4]);
        let near_odd = near_odd * s.splat(FRAC_1_SQRT_2);
        let far_odd = far_odd * s.splat(SQRT_2);
        let (half, two) = (s.splat(0.5), s.splat(2.0));
        [
            y[0] + near + far,
            near_odd + far_odd,
            half.fma(near, two * far),
            half.fma(near_odd, two.fma(far_odd, y[5])),
        ]
    }

    /// Value at each point of the polynomial with these coefficients, over the product
    /// of the point's distances to the others.
    #[inline(always)]
    fn weights<S: Simd>(s: S, [g0, g1, g2]: [S::F; 3]) -> [S::F; WEIGHTS] {
        // 2·½·(½ − 2) = −3/2 and 2·2·(2 − ½) = 6.
        let even = s.splat(0.5).fma(g2, g0) * s.splat(-2.0 / 3.0);
        let odd = g1 * s.splat(-2.0 / 3.0 * FRAC_1_SQRT_2);
        let (a, b) = (even + odd, even - odd);
        let even = s.splat(2.0).fma(g2, g0) * s.splat(1.0 / 6.0);
        let odd = g1 * s.splat(1.0 / 6.0 * SQRT_2);
        [g0, a, b, even + odd, even - odd, g2]
    }
}

impl Adjoint<6> for Unit {
    #[inline(always)]
    fn spread<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; 6] {
        let (half, two) = (s.splat(0.5), s.splat(2.0));
        let (even, odd) = (half.fma(d[2], d[0]), half.fma(d[3], d[1]));
        let root = s.splat(FRAC_1_SQRT_2);
        let (a, b) = (root.fma(odd, even), root.fnma(odd, even));
        let (even, odd) = (two.fma(d[2], d[0]), two.fma(d[3], d[1]));
        let root = s.splat(SQRT_2);
        [d[0], a, b, root.fma(odd, even), root.fnma(odd, even), d[3]]
    }

    #[inline(always)]
    fn taps<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3] {
        let (near, far) = (q[1] + q[2], q[3] + q[4]);
        let (near_odd, far_odd) = (q[1] - q[2], q[3] - q[4]);
        let (two_thirds, sixth, third) =
            (s.splat(2.0 / 3.0), s.splat(1.0 / 6.0), s.splat(1.0 / 3.0));
        [
            sixth.fma(far, two_thirds.fnma(near, q[0])),
            s.splat(2.0 / 3.0 * FRAC_1_SQRT_2)
                .fnma(near_odd, s.splat(1.0 / 6.0 * SQRT_2) * far_odd),
            third.fma(far - near, q[5]),
        ]
    }
}

/// `to` = `from`, one by one: an array of vectors that is copied as a whole goes to memory
/// and is copied there, for which a convolution of 32 channels took half as long again.
#[inline(always)]
#[expect(clippy::manual_memcpy, reason = "this is the point of it")]
pub(super) fn put<V: Copy, const N: usize>(to: &mut [V; N], from: [V; N]) {
    for i in 0..N {
        to[i] = from[i];
    }
}

/// F(4, 2)'s points besides ∞: ±A and ±B.
const A: f32 = 0.5;
const B: f32 = 1.2;
/// Product of A's distances to the other points, and of B's.
const AT_A: f32 = 2.0 * A * (A * A - B * B);
const AT_B: f32 = 2.0 * B * (B * B - A * A);

#[inline(always)]
fn pair_points<S: Simd>(s: S, x: [S::F; 5]) -> [S::F; 5] {
    let (a2, b2) = (s.splat(A * A), s.splat(B * B));
    let (even, odd) = (b2.fnma(x[1], x[3]), b2.fnma(x[0], x[2]));
    let a = s.splat(A);
    let (p, q) = (a.fma(odd, even), a.fnma(odd, even));
    let (even, odd) = (a2.fnma(x[1], x[3]), a2.fnma(x[0], x[2]));
    let b = s.splat(B);
    let last = s.splat(A * A * B * B).fma(x[0], s.splat(A * A + B * B).fnma(x[2], x[4]));
    [p, q, b.fma(odd, even), b.fnma(odd, even), last]
}

#[inline(always)]
fn pair_outputs<S: Simd>(s: S, y: [S::F; 5]) -> [S::F; 4] {
    let (near, far) = (y[0] + y[1], y[2] + y[3]);
    let near_odd = (y[0] - y[1]) * s.splat(A);
    let far_odd = (y[2] - y[3]) * s.splat(B);
    let (a2, b2) = (s.splat(A * A), s.splat(B * B));
    [
        near + far,
        near_odd + far_odd,
        a2.fma(near, b2 * far),
        a2.fma(near_odd, b2.fma(far_odd, y[4])),
    ]
}

/// The kernel's weights where its outer taps are F(4, 2)'s.
#[inline(always)]
fn pair_weights<S: Simd>(s: S, [g0, g1, g2]: [S::F; 3]) -> [S::F; WEIGHTS] {
    let (even, odd) = (g2 * s.splat(A / AT_A), g0 * s.splat(1.0 / AT_A));
    let (a, b) = (even + odd, even - odd);
    let (even, odd) = (g2 * s.splat(B / AT_B), g0 * s.splat(1.0 / AT_B));
    [a, b, even + odd, even - odd, g2, g1]
}

/// Stride 2, forward.
pub(super) struct Down;

impl Form<9, 9, 4> for Down {
    const READ: usize = 2 * TILE;
    const BEFORE: usize = 1;

    #[inline(always)]
    fn points<S: Simd>(s: S, x: [S::F; 9]) -> [S::F; 9] {
        let [a, b, c, d, e] = pair_points(s, [x[0], x[2], x[4], x[6], x[8]]);
        [a, b, c, d, e, x[1], x[3], x[5], x[7]]
    }

    #[inline(always)]
    fn outputs<S: Simd>(s: S, y: [S::F; 9]) -> [S::F; 4] {
        let [a, b, c, d] = pair_outputs(s, [y[0], y[1], y[2], y[3], y[4]]);
        [a + y[5], b + y[6], c + y[7], d + y[8]]
    }

    #[inline(always)]
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS] {
        pair_weights(s, g)
    }
}

impl Adjoint<9> for Down {
    #[inline(always)]
    fn spread<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; 9] {
        let (a2, b2) = (s.splat(A * A), s.splat(B * B));
        let (even, odd) = (a2.fma(d[2], d[0]), a2.fma(d[3], d[1]));
        let a = s.splat(A);
        let (p, q) = (a.fma(odd, even), a.fnma(odd, even));
        let (even, odd) = (b2.fma(d[2], d[0]), b2.fma(d[3], d[1]));
        let b = s.splat(B);
        let (r, t) = (b.fma(odd, even), b.fnma(odd, even));
        [p, q, r, t, d[3], d[0], d[1], d[2], d[3]]
    }

    #[inline(always)]
    fn taps<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3] {
        let first = s.splat(1.0 / AT_A).fma(q[0] - q[1], s.splat(1.0 / AT_B) * (q[2] - q[3]));
        let last = s.splat(B / AT_B).fma(q[2] + q[3], q[4]);
        [first, q[5], s.splat(A / AT_A).fma(q[0] + q[1], last)]
    }
}

/// Stride 2 and one zero of padding, ∂L/∂x: outputs of even places are those of the
/// middle tap.
pub(super) struct Up;

impl Form<5, 9, 8> for Up {
    const READ: usize = TILE;
    const BEFORE: usize = 0;

    #[inline(always)]
    fn points<S: Simd>(s: S, x: [S::F; 5]) -> [S::F; 9] {
        let [a, b, c, d, e] = pair_points(s, x);
        [a, b, c, d, e, x[0], x[1], x[2], x[3]]
    }

    #[inline(always)]
    fn outputs<S: Simd>(s: S, y: [S::F; 9]) -> [S::F; 8] {
        let [a, b, c, d] = pair_outputs(s, [y[0], y[1], y[2], y[3], y[4]]);
        [y[5], a, y[6], b, y[7], c, y[8], d]
    }

    #[inline(always)]
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS] {
        pair_weights(s, g)
    }
}

/// Most products of a tile.
const PRODUCTS: usize = 81;

/// Where the products of a tile lie in a buffer of `channels` rows of `length` tiles:
/// one matrix for each of [`GROUPS`], whose rows hold the tiles of all products that
/// share its weight.
pub(super) struct Places {
    channels: usize,
    length: usize,
    /// Of each product, row-major: its place in the first channel.
    at: [usize; PRODUCTS],
    /// From channel to channel, by the number of axes along which its weight is shared.
    steps: [usize; 3],
    /// Of each group: where it begins and the length of its rows.
    pub groups: Vec<(usize, usize)>,
    /// Floats of all.
    pub floats: usize,
}

impl Places {
    /// Of a form with so many `points` along an axis; groups lie `apart` floats beyond
    /// their own.
    pub fn new(points: usize, channels: usize, length: usize, apart: usize) -> Self {
        let shared = points - (WEIGHTS - 1);
        let count = |weight: usize| if weight == WEIGHTS - 1 { shared } else { 1 };
        let mut groups = Vec::with_capacity(GROUPS);
        let mut floats = 0;
        for group in 0..GROUPS {
            let row = count(group / WEIGHTS) * count(group % WEIGHTS) * length;
            groups.push((floats, row));
            floats += channels * row + apart;
        }
        let mut at = [0; PRODUCTS];
        for (product, at) in at.iter_mut().enumerate().take(points * points) {
            let axes = [product / points, product % points];
            let [i, j] = axes.map(|p| p.min(WEIGHTS - 1));
            let [p, q] = [axes[0] - i, axes[1] - j];
            *at = groups[i * WEIGHTS + j].0 + (p * count(j) + q) * length;
        }
        let steps = [1, shared, shared * shared].map(|n| n * length);
        Self { channels, length, at, steps, groups, floats }
    }

    /// Those of lanes `first..first + LANES` of `channel`.
    #[inline(always)]
    pub fn vectors(&self, channel: usize, first: usize) -> Vectors<'_> {
        assert!(channel < self.channels && first + LANES <= self.length, "conv: no such tiles");
        Vectors { at: &self.at, from: self.steps.map(|step| channel * step + first) }
    }
}

/// Where the products of sixteen tiles lie.
pub(super) struct Vectors<'a> {
    at: &'a [usize; PRODUCTS],
    from: [usize; 3],
}

impl Vectors<'_> {
    /// Product i, j of a form with `points` along an axis: whole vectors, inside
    /// [`Places::floats`].
    #[inline(always)]
    pub fn place(&self, points: usize, i: usize, j: usize) -> usize {
        let shared = usize::from(i >= WEIGHTS - 1) + usize::from(j >= WEIGHTS - 1);
        // A form without products that share a weight has steps of one length.
        self.at[i * points + j] + self.from[shared]
    }
}
