//! From raw head rows to Gaussians in world frame, one pass per pixel (MVSplat's
//! Gaussian adapter; spec 6), with gradients.
//!
//! In, per view: raw rows `[H·W, 9 + 3·D]` (offset 2, scale 3, quaternion xyzw 4,
//! colour-major SH), distances and densities `[H·W, G]`.   Out: packed rows
//! `[H·W·G, 11]` (lanes in [`crate::abi`]); [`colour`] gives the SH.
//! ```text
//! d   = (x + σ(o_x) − c_x)/f_x, …, 1, over its length      x, y: whole pixels
//! μ   = eye + t·R·d        s = t·(least + span·σ(·))       t: distance
//! q   = R ⊗ quaternion, unit, w ≥ 0; zero is no rotation
//! α   = ½(1 − (1 − p)^e + p^{1/e})/G,   p/G for e = 1
//! ```
//! The lanes of a vector are neighbouring pixels of a row. Twin: ops/adapter.rs. The
//! same in tensor operations: model/primaries_ref.rs. Tests: ops/adapter.rs,
//! tests/primaries.rs.

mod backward;
pub mod colour;

pub use backward::{Gradients, Reached, backward};

use super::lanes::{Kernel, LaneReal, Lanes, Machine, WIDTH_MAX};
use crate::abi::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};
use colour::Turn;
use rayon::prelude::*;

/// Numbers of a raw row before its SH.
pub const GEOMETRY: usize = 9;
/// ε of the raw quaternion's normalisation (MVS).
const QUAT_EPS: f64 = 1e-8;
/// Under square roots, so that zero has a finite gradient.
const SQUARE_EPS: f64 = 1e-30;
/// Squared length of a normalised quaternion below which it counts as zero.
const QUAT_ZERO: f64 = 1e-12;
/// Least p and 1 − p that a logarithm is taken of.
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
    /// The eye, world.
    pub origin: [f64; 3],
    /// Row i: where the i-th of x, y, z, w goes, as wxyz in world frame.
    pub quat: [[f64; 4]; 4],
    /// σ at distance 1: the least, and what a sigmoid of 1 adds.
    pub scale: [f64; 2],
    /// SH into world frame.
    pub turn: Turn,
}

/// All views of a call.
#[derive(Clone, Debug, PartialEq)]
pub struct Adapter {
    /// Scene after scene.
    pub views: Vec<View>,
    /// H, W.
    pub size: [usize; 2],
    /// G.
    pub per_pixel: usize,
    /// D: SH functions.
    pub functions: usize,
    /// x of the opacity mapping, e = 2^x.
    pub exponent: f64,
    /// SH that stay in camera frame, the same for every view.
    pub camera: Turn,
}

impl Adapter {
    /// Numbers of a raw row.
    pub fn raw_lanes(&self) -> usize {
        GEOMETRY + 3 * self.functions
    }
}

/// Some lanes' σ(x).
#[inline(always)]
fn sigmoid<M: Machine>(m: M, x: M::V) -> M::V {
    m.of(1.0) / (m.of(1.0) + (-x).exp())
}

/// Σ aᵢ·bᵢ.
#[inline(always)]
fn dot<V: Lanes, const N: usize>(a: [V; N], b: [V; N]) -> V {
    let mut sum = a[0] * b[0];
    for i in 1..N {
        sum = a[i].fma(b[i], sum);
    }
    sum
}

/// Number `first + lane` of every `stride` numbers.
#[inline(always)]
fn strided<M: Machine>(m: M, from: &[M::Scalar], (first, stride): (usize, usize)) -> M::V {
    let mut tile = [M::Scalar::default(); WIDTH_MAX];
    for (to, v) in tile[..M::WIDTH].iter_mut().zip(from[first..].iter().step_by(stride)) {
        *to = *v;
    }
    m.load(&tile)
}

/// What the Gaussians of a pixel share.
struct Pixel<V> {
    /// σ of the offset and the three scales.
    shares: [V; 5],
    /// Unit ray, camera frame, and the length it was divided by.
    ray: [V; 3],
    length: V,
    /// Unit ray, world frame.
    towards: [V; 3],
    /// σ at distance 1.
    scale: [V; 3],
    /// Length of the raw quaternion; the quaternion's length after the turn, which
    /// carries the sign that makes w ≥ 0; the result.
    raw_length: V,
    turned_length: V,
    quat: [V; 4],
}

impl<V: Lanes> Pixel<V> {
    #[inline(always)]
    fn new<M: Machine<V = V>>(m: M, view: &View, raw: &[V; GEOMETRY], (x, y): (V, V)) -> Self {
        let one = m.of(1.0);
        let mut shares = [one; 5];
        for (s, r) in shares.iter_mut().zip(raw) {
            *s = sigmoid(m, *r);
        }
        let across = (x + shares[0] - m.of(view.centre[0])) / m.of(view.focal[0]);
        let down = (y + shares[1] - m.of(view.centre[1])) / m.of(view.focal[1]);
        let length = across.fma(across, down.fma(down, one)).sqrt();
        let ray = [across / length, down / length, one / length];
        let mut towards = ray;
        for (t, row) in towards.iter_mut().zip(&view.rotation) {
            *t = dot([m.of(row[0]), m.of(row[1]), m.of(row[2])], ray);
        }
        let (least, span) = (m.of(view.scale[0]), m.of(view.scale[1]));
        let mut scale = [least; 3];
        for (s, share) in scale.iter_mut().zip(&shares[2..]) {
            *s = span.fma(*share, least);
        }
        let q = [raw[5], raw[6], raw[7], raw[8]];
        let raw_length = (dot(q, q) + m.of(SQUARE_EPS)).sqrt();
        let inverse = one / (raw_length + m.of(QUAT_EPS));
        let mut own = q;
        for v in &mut own {
            *v = *v * inverse;
        }
        let zero = dot(own, own).lt(m.of(QUAT_ZERO));
        own[3] = own[3] + V::select(zero, one, m.of(0.0));
        let mut quat = own;
        for (k, q) in quat.iter_mut().enumerate() {
            let [x, y, z, w] = &view.quat;
            let column = [m.of(x[k]), m.of(y[k]), m.of(z[k]), m.of(w[k])];
            *q = dot(column, own);
        }
        let length_q = (dot(quat, quat) + m.of(SQUARE_EPS)).sqrt();
        let turned_length = V::select(quat[0].lt(m.of(0.0)), -length_q, length_q);
        for q in &mut quat {
            *q = *q / turned_length;
        }
        Self { shares, ray, length, towards, scale, raw_length, turned_length, quat }
    }
}

/// yᵉ of y in [0, 1]; NaN for NaN.
#[inline(always)]
#[expect(clippy::eq_op, reason = "y − y is 0, and NaN for NaN and the infinities")]
fn power<M: Machine>(m: M, y: M::V, e: f64) -> M::V {
    let least = m.of(SHARE_MIN);
    let p = (m.of(e) * y.max(least).ln()).exp();
    M::V::select(y.lt(least), m.of(0.0), p) + (y - y)
}

/// α of density p, and its slope.
#[inline(always)]
fn opacity<M: Machine>(m: M, adapter: &Adapter, p: M::V) -> (M::V, M::V) {
    let share = m.of(1.0 / adapter.per_pixel as f64);
    if adapter.exponent == 0.0 {
        return (p * share, share);
    }
    let (e, one, least) = (adapter.exponent.exp2(), m.of(1.0), m.of(SHARE_MIN));
    let (low, high) = (power(m, one - p, e), power(m, p, 1.0 / e));
    let half = share * m.of(0.5);
    let slope = m.of(e) * low / (one - p).max(least) + m.of(1.0 / e) * high / p.max(least);
    ((one - low + high) * half, slope * half)
}

/// Whole-pixel columns of a vector from `first` on.
#[inline(always)]
fn columns<M: Machine>(m: M, first: usize) -> M::V {
    let mut tile = [M::Scalar::default(); WIDTH_MAX];
    for (i, v) in tile.iter_mut().enumerate() {
        *v = <M::Scalar as super::real::Real>::of((first + i) as f64);
    }
    m.load(&tile)
}

/// One row of pixels forward.
struct Forward<'a, T> {
    adapter: &'a Adapter,
    view: &'a View,
    row: usize,
    raw: &'a [T],
    depths: &'a [T],
    densities: &'a [T],
    out: &'a mut [T],
}

impl<T: LaneReal> Kernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let (width, lanes, g) =
            (self.adapter.size[1], self.adapter.raw_lanes(), self.adapter.per_pixel);
        let y = m.of(self.row as f64);
        for first in (0..width).step_by(M::WIDTH) {
            let count = M::WIDTH.min(width - first);
            let raw: [M::V; GEOMETRY] = m.load_rows(&self.raw[first * lanes..], (lanes, count));
            let pixel = Pixel::new(m, self.view, &raw, (columns(m, first), y));
            for k in 0..g {
                let t = strided(m, self.depths, (first * g + k, g));
                let p = strided(m, self.densities, (first * g + k, g));
                let mut row = [m.of(0.0); SPLAT_STRIDE];
                for i in 0..3 {
                    row[MEAN_OFFSET + i] = pixel.towards[i].fma(t, m.of(self.view.origin[i]));
                    row[SCALE_OFFSET + i] = pixel.scale[i] * t;
                }
                row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&pixel.quat);
                row[OPACITY_OFFSET] = opacity(m, self.adapter, p).0;
                let out = &mut self.out[(first * g + k) * SPLAT_STRIDE..];
                m.store_rows(&row, (g * SPLAT_STRIDE, count), out);
            }
        }
    }
}

/// Packed rows of all views' Gaussians into `out` `[views·H·W·G, 11]` (module doc).
pub fn forward<T: LaneReal>(a: &Adapter, [raw, depths, densities]: [&[T]; 3], out: &mut [T]) {
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
