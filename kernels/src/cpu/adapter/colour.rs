//! SH of the primaries: one matrix per view masks, maps and rotates the raw coefficients;
//! with the gradient.

use super::{Adapter, GEOMETRY};
use crate::cpu::simd::{Real, RowLayout, Vector, VectorKernel};
use rayon::prelude::*;

/// Most SH functions of a set.
const FUNCTIONS_MAX: usize = 25;

/// The non-zero elements of a square matrix, by rows and by columns.
#[derive(Clone, Debug, PartialEq)]
pub struct Turn {
    rows: Vec<Vec<(usize, f64)>>,
    columns: Vec<Vec<(usize, f64)>>,
}

impl Turn {
    /// Returns the row-major matrix `[D, D]`.
    pub fn dense(&self) -> Vec<f64> {
        let d = self.rows.len();
        let mut matrix = vec![0.0; d * d];
        for (i, row) in self.rows.iter().enumerate() {
            row.iter().for_each(|&(j, v)| matrix[i * d + j] = v);
        }
        matrix
    }

    /// Lists the elements of the row-major `[D, D]` matrix `m`, D ≤ 25.
    pub fn new(m: &[f64], d: usize) -> Self {
        let line = |at: &dyn Fn(usize) -> f64| -> Vec<(usize, f64)> {
            (0..d).map(|j| (j, at(j))).filter(|(_, v)| *v != 0.0).collect()
        };
        Self {
            rows: (0..d).map(|i| line(&|j| m[i * d + j])).collect(),
            columns: (0..d).map(|j| line(&|i| m[i * d + j])).collect(),
        }
    }
}

/// Frame and layout of SH: world `[N, D, 3]`, or camera `[N, 3, D]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frame {
    /// World frame, RGB innermost.
    World,
    /// Camera frame, colour-major like the raw row.
    Camera,
}

/// Loads numbers i < 3·D of rows; 3·D is 3, 12, 27, 48 or 75.
#[inline(always)]
pub(super) fn load<V: Vector>(rows: &[V::Element], layout: RowLayout, to: &mut [V]) {
    let mut at = 0;
    while to.len() - at >= 16 {
        to[at..at + 16].copy_from_slice(&V::load_rows::<16>(&rows[at..], layout));
        at += 16;
    }
    match to.len() - at {
        3 => to[at..].copy_from_slice(&V::load_rows::<3>(&rows[at..], layout)),
        11 => to[at..].copy_from_slice(&V::load_rows::<11>(&rows[at..], layout)),
        12 => to[at..].copy_from_slice(&V::load_rows::<12>(&rows[at..], layout)),
        _ => {}
    }
}

/// Stores rows, the inverse of [`load`].
#[inline(always)]
pub(super) fn store<V: Vector>(from: &[V], layout: RowLayout, rows: &mut [V::Element]) {
    let mut at = 0;
    while from.len() - at >= 16 {
        let mut part = [V::constant(0.0); 16];
        part.copy_from_slice(&from[at..at + 16]);
        V::store_rows(&part, layout, &mut rows[at..]);
        at += 16;
    }
    let rest = from.len() - at;
    let mut part = [V::constant(0.0); 12];
    part[..rest.min(12)].copy_from_slice(&from[at..at + rest.min(12)]);
    let [a, b, c, d, e, f, g, h, i, j, k, _] = part;
    match rest {
        3 => V::store_rows(&[a, b, c], layout, &mut rows[at..]),
        11 => V::store_rows(&[a, b, c, d, e, f, g, h, i, j, k], layout, &mut rows[at..]),
        12 => V::store_rows(&part, layout, &mut rows[at..]),
        _ => {}
    }
}

/// Adds Σⱼ lines[i][j]·from[function j of colour c] to function i of colour c in `to`.
/// `steps` are the strides of colours and functions in `from` and in `to`.
#[inline(always)]
fn apply<V: Vector>(
    lines: &[Vec<(usize, f64)>],
    (from, to): (&[V], &mut [V]),
    steps: [(usize, usize); 2],
) {
    let [(colour, function), (to_colour, to_function)] = steps;
    for (i, line) in lines.iter().enumerate() {
        let mut sums = [V::constant(0.0); 3];
        for &(j, v) in line {
            let v = V::constant(v);
            for (c, sum) in sums.iter_mut().enumerate() {
                *sum = v.fma(from[c * colour + j * function], *sum);
            }
        }
        for (c, sum) in sums.into_iter().enumerate() {
            let to = &mut to[c * to_colour + i * to_function];
            *to = *to + sum;
        }
    }
}

impl Frame {
    fn turn(self, adapter: &Adapter, view: usize) -> &Turn {
        match self {
            Self::World => &adapter.views[view].turn,
            Self::Camera => &adapter.camera,
        }
    }

    /// Strides of colours and functions in a set of `d` functions.
    fn steps(self, d: usize) -> (usize, usize) {
        match self {
            Self::World => (1, 3),
            Self::Camera => (d, 1),
        }
    }
}

struct Forward<'a, T> {
    adapter: &'a Adapter,
    frame: Frame,
    view: usize,
    raw: &'a [T],
    out: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for Forward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let (g, d) = (self.adapter.per_pixel, self.adapter.functions);
        let n = 3 * d;
        let width = self.adapter.size[1];
        let lanes = self.adapter.raw_lanes();
        let turn = self.frame.turn(self.adapter, self.view);
        for first in (0..width).step_by(V::LANES) {
            let count = V::LANES.min(width - first);
            let mut from = [V::constant(0.0); 3 * FUNCTIONS_MAX];
            load(
                &self.raw[first * lanes + GEOMETRY..],
                RowLayout { stride: lanes, count },
                &mut from[..n],
            );
            let mut to = [V::constant(0.0); 3 * FUNCTIONS_MAX];
            apply(&turn.rows, (&from[..n], &mut to[..n]), [(d, 1), self.frame.steps(d)]);
            for k in 0..g {
                store(
                    &to[..n],
                    RowLayout { stride: g * n, count },
                    &mut self.out[(first * g + k) * n..],
                );
            }
        }
    }
}

/// Computes the SH of all views' Gaussians into `out` `[views·H·W·G, 3·D]`, in the layout of
/// `frame`.
pub fn forward<T: Real>(a: &Adapter, frame: Frame, raw: &[T], out: &mut [T]) {
    let ([height, width], lanes) = (a.size, a.raw_lanes());
    let set = width * a.per_pixel * 3 * a.functions;
    out.par_chunks_mut(set).enumerate().for_each(|(i, out)| {
        let raw = &raw[i * width * lanes..][..width * lanes];
        T::dispatch(Forward { adapter: a, frame, view: i / height, raw, out });
    });
}

/// Adds to `to` `[3·D]` the gradient of a vector of pixels' raw SH, from the gradient `d_out`
/// of the SH of their Gaussians.
#[inline(always)]
pub(super) fn backward<V: Vector>(
    (adapter, frame, view): (&Adapter, Frame, usize),
    (d_out, count): (&[V::Element], usize),
    to: &mut [V],
) {
    let (g, d) = (adapter.per_pixel, adapter.functions);
    let n = 3 * d;
    let lines = &frame.turn(adapter, view).columns;
    for k in 0..g {
        let mut from = [V::constant(0.0); 3 * FUNCTIONS_MAX];
        load(&d_out[k * n..], RowLayout { stride: g * n, count }, &mut from[..n]);
        apply(lines, (&from[..n], to), [frame.steps(d), (d, 1)]);
    }
}
