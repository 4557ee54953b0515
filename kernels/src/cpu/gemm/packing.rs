//! Factors of a matrix product: views of slices, and the right factor packed into panels.

use super::PANEL;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel};
use crate::cpu::uninit::grown;
use std::cell::Cell;

/// A matrix inside a slice, with any strides.
#[derive(Clone, Copy)]
pub struct Mat<'a> {
    /// Elements; (i, j) is `data[i * row_stride + j * col_stride]`.
    pub data: &'a [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance of rows in elements.
    pub row_stride: usize,
    /// Distance of columns in elements.
    pub col_stride: usize,
}

impl<'a> Mat<'a> {
    /// Views `data` as a row-major matrix whose rows are `row_stride` elements apart.
    pub fn new(data: &'a [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        Self { data, rows, cols, row_stride, col_stride: 1 }
    }

    /// Returns the transposed view.
    #[must_use]
    pub fn t(self) -> Self {
        Self {
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
            ..self
        }
    }

    /// Returns the elements from the first to the last one of the matrix.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.cols == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.cols - 1) * self.col_stride + 1
    }

    /// Panics where the matrix extends beyond its slice.
    pub(super) fn check(&self, name: &str) {
        assert!(self.extent() <= self.data.len(), "gemm: {name}");
    }
}

/// The right factor `[k, n]` in panels of 64 columns: `[panel][k][column]`. The last panel
/// has as many whole vectors as its columns need; zeros pad it.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    /// The panels, then leftovers of an earlier, larger matrix.
    pub(super) data: Vec<f32>,
    pub(super) depth: usize,
    pub(super) cols: usize,
}

impl Packed {
    /// Packs `rhs`.
    ///
    /// # Panics
    /// Where `rhs` extends beyond its slice.
    pub fn new(rhs: Mat<'_>) -> Self {
        let mut packed = Self::default();
        packed.fill(rhs);
        packed
    }

    /// Packs `rhs` into the memory of this matrix.
    ///
    /// # Panics
    /// As [`Packed::new`].
    pub(crate) fn fill(&mut self, rhs: Mat<'_>) {
        rhs.check("operands");
        self.depth = rhs.rows;
        self.cols = rhs.cols;
        let to = grown(&mut self.data, rhs.rows * rhs.cols.next_multiple_of(LANES));
        if !to.is_empty() {
            SimdLevel::best().run(PackPanels { rhs, to });
        }
    }

    /// Calls `f` with `rhs` packed into memory that this thread reuses.
    ///
    /// # Panics
    /// As [`Packed::new`].
    pub fn with<R>(rhs: Mat<'_>, f: impl FnOnce(&Self) -> R) -> R {
        Self::with_thread_memory(|packed| {
            packed.fill(rhs);
            f(packed)
        })
    }

    /// Calls `f` with a matrix `[depth, cols]` in memory that this thread reuses. `fill`
    /// writes its panels, including the padding of the last one.
    pub(crate) fn with_panels<R>(
        [depth, cols]: [usize; 2],
        fill: impl FnOnce(&mut [f32]),
        f: impl FnOnce(&Self) -> R,
    ) -> R {
        Self::with_thread_memory(|packed| {
            (packed.depth, packed.cols) = (depth, cols);
            fill(grown(&mut packed.data, depth * cols.next_multiple_of(LANES)));
            f(packed)
        })
    }

    fn with_thread_memory<R>(f: impl FnOnce(&mut Self) -> R) -> R {
        thread_local! {
            static KEPT: Cell<Packed> = Cell::default();
        }
        // Taken rather than borrowed: while a task is blocked in rayon, its thread may run
        // another one that packs.
        let mut packed = KEPT.take();
        let result = f(&mut packed);
        KEPT.set(packed);
        result
    }

    /// Returns k.
    pub fn depth(&self) -> usize {
        self.depth
    }

    /// Returns n.
    pub fn cols(&self) -> usize {
        self.cols
    }
}

/// Packs a matrix into panels.
struct PackPanels<'a> {
    rhs: Mat<'a>,
    to: &'a mut [f32],
}

impl Kernel for PackPanels<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { rhs, to } = self;
        for (first, panel) in (0..rhs.cols).step_by(PANEL).zip(to.chunks_mut(PANEL * rhs.rows)) {
            let width = panel.len() / rhs.rows;
            let cols = PANEL.min(rhs.cols - first);
            let from = Mat { data: &rhs.data[first * rhs.col_stride..], cols, ..rhs };
            copy(s, from, width, panel);
        }
    }
}

/// Copies `from` to rows that are `row_len` ≥ `from.cols` long; zeros fill the rest of each
/// row.
#[inline(always)]
pub(in crate::cpu) fn copy<S: Simd>(s: S, from: Mat<'_>, row_len: usize, to: &mut [f32]) {
    let Mat { data, rows, cols, row_stride, col_stride } = from;
    if col_stride == 1 {
        for (i, to) in to.chunks_exact_mut(row_len).enumerate() {
            to[..cols].copy_from_slice(&data[i * row_stride..][..cols]);
            to[cols..].fill(0.0);
        }
        return;
    }
    let squares = row_stride == 1 && rows.min(cols) >= LANES;
    if squares {
        // The contiguous direction of the source is down its columns: transpose squares, of which
        // the last ones overlap those before.
        for j in (0..cols).step_by(LANES) {
            let j = j.min(cols - LANES);
            for i in (0..rows).step_by(LANES) {
                let i = i.min(rows - LANES);
                let mut square = [s.splat(0.0); LANES];
                for (c, v) in square.iter_mut().enumerate() {
                    *v = s.load(lanes(&data[(j + c) * col_stride + i..]));
                }
                for (r, v) in s.transpose(square).into_iter().enumerate() {
                    s.store(v, lanes_mut(&mut to[(i + r) * row_len + j..]));
                }
            }
        }
    }
    let first = if squares { cols } else { 0 };
    for (i, to) in to.chunks_exact_mut(row_len).enumerate() {
        for (j, to) in to[..cols].iter_mut().enumerate().skip(first) {
            *to = data[i * row_stride + j * col_stride];
        }
        to[cols..].fill(0.0);
    }
}

/// Returns the first sixteen floats of `v`; zeros where `v` is shorter.
#[inline(always)]
fn lanes(v: &[f32]) -> &[f32; LANES] {
    v.first_chunk().unwrap_or(&[0.0; LANES])
}

/// Returns the first sixteen floats of `v`.
#[inline(always)]
fn lanes_mut(v: &mut [f32]) -> &mut [f32; LANES] {
    match v.first_chunk_mut() {
        Some(v) => v,
        None => unreachable!("gemm: the caller passes whole vectors"),
    }
}
