//! Raw head rows to Gaussians in world frame, one pass per pixel (MVSplat's Gaussian
//! adapter), with gradients.
//!
//! Input per view: raw rows `[H·W, 9 + 3·D]` (offset 2, scale 3, quaternion xyzw 4,
//! colour-major SH), distances and densities `[H·W, G]`.   Output: packed rows
//! `[H·W·G, 11]` (offsets in [`crate::layout`]); [`colour`] computes the SH.
//! ```text
//! d   = (x + σ(o_x) − c_x)/f_x, …, 1, over its length      x, y: whole pixels
//! μ   = eye + t·R·d        s = t·(least + span·σ(·))       t: distance
//! q   = R ⊗ quaternion, unit, w ≥ 0; zero is no rotation
//! α   = ½(1 − (1 − p)^e + p^{1/e})/G,   p/G for e = 1
//! ```
//! The lanes of a vector are neighbouring pixels of a row. Op: ops/adapter.rs. Reference in
//! tensor operations: tests/support/src/primaries_reference.rs. Tests: ops/adapter.rs, tests/network/primaries.rs.

mod backward;
pub mod colour;

pub use backward::{Gradients, Reached, backward};

use super::simd::{LANES, Mask, Real, RowLayout, Vector, VectorKernel};
use crate::layout::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};
use colour::Turn;
use rayon::prelude::*;

/// Numbers of a raw row before its SH.
pub const GEOMETRY: usize = 9;
/// ε of the raw quaternion's normalisation (MVS).
const QUAT_EPS: f64 = 1e-8;
/// Added under square roots, so that zero has a finite gradient.
const SQUARE_EPS: f64 = 1e-30;
/// Squared length of a normalised quaternion below which it counts as zero.
const QUAT_ZERO: f64 = 1e-12;
/// Lower clamp of p and 1 − p in logarithms.
const SHARE_MIN: f64 = 1e-30;

/// One view's constants.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// f_x, f_y, px.
    pub focal: [f64; 2],
    /// c_x, c_y, px.
    pub centre: [f64; 2],
    /// Rows of R, world from camera.
    pub rotation: [[f64; 3]; 3],
    /// Position of the eye, world units.
    pub origin: [f64; 3],
    /// Row i: image of the i-th of x, y, z, w, as wxyz in world frame.
    pub quat: [[f64; 4]; 4],
    /// σ at distance 1: the minimum, and the amount that a sigmoid of 1 adds.
    pub scale: [f64; 2],
    /// Matrix of SH into world frame.
    pub turn: Turn,
}

/// Constants of all views of a call.
#[derive(Clone, Debug, PartialEq)]
pub struct Adapter {
    /// Views, scene after scene.
    pub views: Vec<View>,
    /// H, W.
    pub size: [usize; 2],
    /// G.
    pub per_pixel: usize,
    /// D: SH functions.
    pub functions: usize,
    /// x of the opacity mapping, e = 2^x.
    pub exponent: f64,
    /// Matrix of SH that stay in camera frame, the same for every view.
    pub camera: Turn,
}

impl Adapter {
    /// Numbers of a raw row.
    pub fn raw_lanes(&self) -> usize {
        GEOMETRY + 3 * self.functions
    }
}

/// σ(x).
#[inline(always)]
fn sigmoid<V: Vector>(x: V) -> V {
    V::constant(1.0) / (V::constant(1.0) + (-x).exp())
}

/// Σ aᵢ·bᵢ.
#[inline(always)]
fn dot<V: Vector, const N: usize>(a: [V; N], b: [V; N]) -> V {
    let mut sum = a[0] * b[0];
    for i in 1..N {
        sum = a[i].fma(b[i], sum);
    }
    sum
}

/// Loads element `first` + lane·`stride` into each lane.
#[inline(always)]
fn strided<V: Vector>(from: &[V::Element], (first, stride): (usize, usize)) -> V {
    let mut tile = [V::Element::default(); LANES];
    for (to, v) in tile[..V::LANES].iter_mut().zip(from[first..].iter().step_by(stride)) {
        *to = *v;
    }
    V::load(&tile)
}

/// Values that the Gaussians of a pixel share.
struct Pixel<V> {
    /// σ of the offset and the three scales.
    shares: [V; 5],
    /// Unit ray, camera frame, and its length before normalisation.
    ray: [V; 3],
    length: V,
    /// Unit ray, world frame.
    towards: [V; 3],
    /// σ at distance 1.
    scale: [V; 3],
    /// Length of the raw quaternion; length after rotation, with the sign that makes w ≥ 0;
    /// the result.
    raw_length: V,
    turned_length: V,
    quat: [V; 4],
}

impl<V: Vector> Pixel<V> {
    #[inline(always)]
    fn new(view: &View, raw: &[V; GEOMETRY], (x, y): (V, V)) -> Self {
        let one = V::constant(1.0);
        let mut shares = [one; 5];
        for (s, r) in shares.iter_mut().zip(raw) {
            *s = sigmoid(*r);
        }
        let across = (x + shares[0] - V::constant(view.centre[0])) / V::constant(view.focal[0]);
        let down = (y + shares[1] - V::constant(view.centre[1])) / V::constant(view.focal[1]);
        let length = across.fma(across, down.fma(down, one)).sqrt();
        let ray = [across / length, down / length, one / length];
        let mut towards = ray;
        for (t, row) in towards.iter_mut().zip(&view.rotation) {
            *t = dot([V::constant(row[0]), V::constant(row[1]), V::constant(row[2])], ray);
        }
        let (least, span) = (V::constant(view.scale[0]), V::constant(view.scale[1]));
        let mut scale = [least; 3];
        for (s, share) in scale.iter_mut().zip(&shares[2..]) {
            *s = span.fma(*share, least);
        }
        let q = [raw[5], raw[6], raw[7], raw[8]];
        let raw_length = (dot(q, q) + V::constant(SQUARE_EPS)).sqrt();
        let inverse = one / (raw_length + V::constant(QUAT_EPS));
        let mut own = q;
        for v in &mut own {
            *v = *v * inverse;
        }
        let zero = dot(own, own).lt(V::constant(QUAT_ZERO));
        own[3] = own[3] + zero.select(one, V::constant(0.0));
        let mut quat = own;
        for (k, q) in quat.iter_mut().enumerate() {
            let [x, y, z, w] = &view.quat;
            let column =
                [V::constant(x[k]), V::constant(y[k]), V::constant(z[k]), V::constant(w[k])];
            *q = dot(column, own);
        }
        let length_q = (dot(quat, quat) + V::constant(SQUARE_EPS)).sqrt();
        let turned_length = quat[0].lt(V::constant(0.0)).select(-length_q, length_q);
        for q in &mut quat {
            *q = *q / turned_length;
        }
        Self { shares, ray, length, towards, scale, raw_length, turned_length, quat }
    }
}

/// Computes yᵉ of y in [0, 1]; NaN for NaN.
#[inline(always)]
#[expect(clippy::eq_op, reason = "y − y is 0, and NaN for NaN and the infinities")]
fn power<V: Vector>(y: V, e: f64) -> V {
    let least = V::constant(SHARE_MIN);
    let p = (V::constant(e) * y.max(least).ln()).exp();
    y.lt(least).select(V::constant(0.0), p) + (y - y)
}

/// Computes α of density p, and its derivative.
#[inline(always)]
fn opacity<V: Vector>(adapter: &Adapter, p: V) -> (V, V) {
    let share = V::constant(1.0 / adapter.per_pixel as f64);
    if adapter.exponent == 0.0 {
        return (p * share, share);
    }
    let e = adapter.exponent.exp2();
    let one = V::constant(1.0);
    let least = V::constant(SHARE_MIN);
    let low = power(one - p, e);
    let high = power(p, 1.0 / e);
    let half = share * V::constant(0.5);
    let slope =
        V::constant(e) * low / (one - p).max(least) + V::constant(1.0 / e) * high / p.max(least);
    ((one - low + high) * half, slope * half)
}

/// Whole-pixel columns of a vector from `first` on.
#[inline(always)]
fn columns<V: Vector>(first: usize) -> V {
    let mut tile = [V::Element::default(); LANES];
    for (i, v) in tile.iter_mut().enumerate() {
        *v = V::Element::constant((first + i) as f64);
    }
    V::load(&tile)
}

/// The forward pass of one row of pixels.
struct Forward<'a, T> {
    adapter: &'a Adapter,
    view: &'a View,
    row: usize,
    raw: &'a [T],
    depths: &'a [T],
    densities: &'a [T],
    out: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let width = self.adapter.size[1];
        let lanes = self.adapter.raw_lanes();
        let g = self.adapter.per_pixel;
        let y = V::constant(self.row as f64);
        for first in (0..width).step_by(V::LANES) {
            let count = V::LANES.min(width - first);
            let raw: [V; GEOMETRY] =
                V::load_rows(&self.raw[first * lanes..], RowLayout { stride: lanes, count });
            let pixel = Pixel::new(self.view, &raw, (columns(first), y));
            for k in 0..g {
                let t = strided(self.depths, (first * g + k, g));
                let p = strided(self.densities, (first * g + k, g));
                let mut row = [V::constant(0.0); SPLAT_STRIDE];
                for i in 0..3 {
                    row[MEAN_OFFSET + i] =
                        pixel.towards[i].fma(t, V::constant(self.view.origin[i]));
                    row[SCALE_OFFSET + i] = pixel.scale[i] * t;
                }
                row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&pixel.quat);
                row[OPACITY_OFFSET] = opacity(self.adapter, p).0;
                let out = &mut self.out[(first * g + k) * SPLAT_STRIDE..];
                V::store_rows(&row, RowLayout { stride: g * SPLAT_STRIDE, count }, out);
            }
        }
    }
}

/// Computes packed rows of all views' Gaussians into `out` `[views·H·W·G, 11]` (module
/// documentation).
pub fn forward<T: Real>(a: &Adapter, [raw, depths, densities]: [&[T]; 3], out: &mut [T]) {
    let ([height, width], g, lanes) = (a.size, a.per_pixel, a.raw_lanes());
    out.par_chunks_mut(width * g * SPLAT_STRIDE).enumerate().for_each(|(i, out)| {
        T::dispatch(Forward {
            adapter: a,
            view: &a.views[i / height],
            row: i % height,
            raw: &raw[i * width * lanes..][..width * lanes],
            depths: &depths[i * width * g..][..width * g],
            densities: &densities[i * width * g..][..width * g],
            out,
        });
    });
}
