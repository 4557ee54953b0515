//! Winograd transforms along one axis; nesting two of them gives the 2-D transforms.
//!
//! outputs = Aᵀ·[(G·taps) ⊙ (Bᵀ·inputs)]
//!
//! Stride 1 is F(4, 3): six products for four outputs, at the points 0, ±1/√2, ±√2, ∞. For
//! noise as input, its error is half of that of the usual points 0, ±1, ±2, ∞.
//!
//! In stride 2 the outer taps of the kernel read even places e and the middle tap reads odd
//! places o: y(i) = g₀·e(i) + g₂·e(i + 1) + g₁·o(i). The first two terms are F(4, 2), five
//! products at the points ±1/2, ±6/5, ∞. These points have the smallest error for noise among
//! a dozen sets that were tried, half of that of 0, ±1, 2, ∞. The third term takes four plain
//! products that share the weight g₁. That makes nine products for four outputs instead of
//! twelve. ∂L/∂x of stride 2 is the transpose of this algorithm.
//!
//! Notation: Lavin and Gray 2016, section 4.

use crate::cpu::simd::{Simd, Vector};
use std::f32::consts::{FRAC_1_SQRT_2, SQRT_2};

/// Grid positions of a tile along an axis: outputs, or pairs of outputs.
pub(super) const TILE: usize = 4;
/// Transformed weights along an axis of every transform: six points, or five points and the
/// middle tap.
pub(super) const WEIGHTS: usize = 6;

/// One algorithm along an axis: `IN` source places, `POINTS` products, `OUT` outputs.
/// Product i has weight i; all products from the sixth on share the last weight.
pub(super) trait Transform<const IN: usize, const POINTS: usize, const OUT: usize>:
    Send + Sync
{
    /// Source places from one tile's first to the next tile's first.
    const INPUT_STEP: usize;
    /// Source places that a tile reads before its own `INPUT_STEP` ones: 0 or 1. It reads at
    /// most one place after them.
    const INPUTS_BEFORE: usize;

    /// Bᵀ·x.
    fn inputs<S: Simd>(s: S, x: [S::F; IN]) -> [S::F; POINTS];

    /// Aᵀ·y.
    fn outputs<S: Simd>(s: S, y: [S::F; POINTS]) -> [S::F; OUT];

    /// G·g.
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS];
}

/// The adjoint transforms that ∂L/∂w needs.
pub(super) trait Adjoint<const POINTS: usize> {
    /// A·d, the adjoint of [`Transform::outputs`].
    fn outputs_adjoint<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; POINTS];

    /// Gᵀ·q, the adjoint of [`Transform::weights`].
    fn weights_adjoint<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3];
}

/// F(4, 3): stride 1, forward and input gradient.
pub(super) struct Stride1;

impl Transform<6, 6, 4> for Stride1 {
    const INPUT_STEP: usize = TILE;
    const INPUTS_BEFORE: usize = 1;

    #[inline(always)]
    fn inputs<S: Simd>(s: S, x: [S::F; 6]) -> [S::F; 6] {
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

    /// The value of g₀ + g₁·p + g₂·p² at each point p, divided by the product of p's
    /// differences from the other points.
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

impl Adjoint<6> for Stride1 {
    #[inline(always)]
    fn outputs_adjoint<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; 6] {
        let (half, two) = (s.splat(0.5), s.splat(2.0));
        let (even, odd) = (half.fma(d[2], d[0]), half.fma(d[3], d[1]));
        let root = s.splat(FRAC_1_SQRT_2);
        let (a, b) = (root.fma(odd, even), root.fnma(odd, even));
        let (even, odd) = (two.fma(d[2], d[0]), two.fma(d[3], d[1]));
        let root = s.splat(SQRT_2);
        [d[0], a, b, root.fma(odd, even), root.fnma(odd, even), d[3]]
    }

    #[inline(always)]
    fn weights_adjoint<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3] {
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

/// Copies an array of vectors element by element. The compiler copies a whole array through
/// memory, which makes a convolution of 32 channels take 1.5 times as long.
#[inline(always)]
#[expect(clippy::manual_memcpy, reason = "a whole-array copy goes through memory")]
pub(super) fn copy_vectors<V: Copy, const N: usize>(to: &mut [V; N], from: [V; N]) {
    for i in 0..N {
        to[i] = from[i];
    }
}

/// The finite points of F(4, 2) are ±A and ±B.
const A: f32 = 0.5;
const B: f32 = 1.2;
/// The product of A's differences from the other finite points, and the same of B.
const DENOMINATOR_A: f32 = 2.0 * A * (A * A - B * B);
const DENOMINATOR_B: f32 = 2.0 * B * (B * B - A * A);

/// Bᵀ·x of F(4, 2).
#[inline(always)]
fn f42_inputs<S: Simd>(s: S, x: [S::F; 5]) -> [S::F; 5] {
    let (a2, b2) = (s.splat(A * A), s.splat(B * B));
    let (even, odd) = (b2.fnma(x[1], x[3]), b2.fnma(x[0], x[2]));
    let a = s.splat(A);
    let (p, q) = (a.fma(odd, even), a.fnma(odd, even));
    let (even, odd) = (a2.fnma(x[1], x[3]), a2.fnma(x[0], x[2]));
    let b = s.splat(B);
    let last = s.splat(A * A * B * B).fma(x[0], s.splat(A * A + B * B).fnma(x[2], x[4]));
    [p, q, b.fma(odd, even), b.fnma(odd, even), last]
}

/// Aᵀ·y of F(4, 2).
#[inline(always)]
fn f42_outputs<S: Simd>(s: S, y: [S::F; 5]) -> [S::F; 4] {
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

/// G·g of stride 2: the outer taps at the points of F(4, 2), then the middle tap itself.
#[inline(always)]
fn f42_weights<S: Simd>(s: S, [g0, g1, g2]: [S::F; 3]) -> [S::F; WEIGHTS] {
    let (even, odd) = (g2 * s.splat(A / DENOMINATOR_A), g0 * s.splat(1.0 / DENOMINATOR_A));
    let (a, b) = (even + odd, even - odd);
    let (even, odd) = (g2 * s.splat(B / DENOMINATOR_B), g0 * s.splat(1.0 / DENOMINATOR_B));
    [a, b, even + odd, even - odd, g2, g1]
}

/// Stride 2, forward: nine inputs for four outputs.
pub(super) struct Stride2;

impl Transform<9, 9, 4> for Stride2 {
    const INPUT_STEP: usize = 2 * TILE;
    const INPUTS_BEFORE: usize = 1;

    #[inline(always)]
    fn inputs<S: Simd>(s: S, x: [S::F; 9]) -> [S::F; 9] {
        let [a, b, c, d, e] = f42_inputs(s, [x[0], x[2], x[4], x[6], x[8]]);
        [a, b, c, d, e, x[1], x[3], x[5], x[7]]
    }

    #[inline(always)]
    fn outputs<S: Simd>(s: S, y: [S::F; 9]) -> [S::F; 4] {
        let [a, b, c, d] = f42_outputs(s, [y[0], y[1], y[2], y[3], y[4]]);
        [a + y[5], b + y[6], c + y[7], d + y[8]]
    }

    #[inline(always)]
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS] {
        f42_weights(s, g)
    }
}

impl Adjoint<9> for Stride2 {
    #[inline(always)]
    fn outputs_adjoint<S: Simd>(s: S, d: [S::F; TILE]) -> [S::F; 9] {
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
    fn weights_adjoint<S: Simd>(s: S, q: [S::F; WEIGHTS]) -> [S::F; 3] {
        let first = s
            .splat(1.0 / DENOMINATOR_A)
            .fma(q[0] - q[1], s.splat(1.0 / DENOMINATOR_B) * (q[2] - q[3]));
        let last = s.splat(B / DENOMINATOR_B).fma(q[2] + q[3], q[4]);
        [first, q[5], s.splat(A / DENOMINATOR_A).fma(q[0] + q[1], last)]
    }
}

/// Input gradient of stride 2 with one zero of padding: the middle tap computes the outputs
/// at even places, the outer taps those at odd places.
pub(super) struct Stride2InputGrad;

impl Transform<5, 9, 8> for Stride2InputGrad {
    const INPUT_STEP: usize = TILE;
    const INPUTS_BEFORE: usize = 0;

    #[inline(always)]
    fn inputs<S: Simd>(s: S, x: [S::F; 5]) -> [S::F; 9] {
        let [a, b, c, d, e] = f42_inputs(s, x);
        [a, b, c, d, e, x[0], x[1], x[2], x[3]]
    }

    #[inline(always)]
    fn outputs<S: Simd>(s: S, y: [S::F; 9]) -> [S::F; 8] {
        let [a, b, c, d] = f42_outputs(s, [y[0], y[1], y[2], y[3], y[4]]);
        [y[5], a, y[6], b, y[7], c, y[8], d]
    }

    #[inline(always)]
    fn weights<S: Simd>(s: S, g: [S::F; 3]) -> [S::F; WEIGHTS] {
        f42_weights(s, g)
    }
}
