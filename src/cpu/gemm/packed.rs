//! Factors of a product as slices, and the right one as the register tiles read it.

use super::PANEL;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel};
use crate::cpu::uninit::grown;
use std::cell::Cell;

/// A matrix inside a slice, any strides.
#[derive(Clone, Copy)]
pub struct Mat<'a> {
    /// Storage; element (i, j) is `data[i * row_stride + j * col_stride]`.
    pub data: &'a [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance between rows, elements.
    pub row_stride: usize,
    /// Distance between columns, elements.
    pub col_stride: usize,
}

impl<'a> Mat<'a> {
    /// Row-major matrix whose rows lie `row_stride` elements apart.
    pub fn new(data: &'a [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        Self { data, rows, cols, row_stride, col_stride: 1 }
    }

    /// The transposed view.
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

    /// One past the last element touched.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.cols == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.cols - 1) * self.col_stride + 1
    }

    /// Panics where the matrix reaches past its slice.
    pub(super) fn check(&self, name: &str) {
        assert!(self.extent() <= self.data.len(), "gemm: {name}");
    }
}

/// The right factor `[k, n]` in panels of 64 columns (the last one as wide as it
/// must be, in whole vectors, padded with zeros): `[panel][k][column]`.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    /// Beyond the panels: what an earlier matrix left in this memory.
    pub(super) data: Vec<f32>,
    pub(super) depth: usize,
    pub(super) cols: usize,
}

impl Packed {
    /// Of `rhs`.
    ///
    /// # Panics
    /// Where it reaches past its slice.
    pub fn new(rhs: Mat<'_>) -> Self {
        let mut packed = Self::default();
        packed.fill(rhs);
        packed
    }

    /// [`Packed::new`] in the memory that this one has.
    ///
    /// # Panics
    /// As [`Packed::new`].
    pub(crate) fn fill(&mut self, rhs: Mat<'_>) {
        rhs.check("operands");
        self.depth = rhs.rows;
        self.cols = rhs.cols;
        let to = grown(&mut self.data, rhs.rows * rhs.cols.next_multiple_of(LANES));
        if !to.is_empty() {
            SimdLevel::best().run(Pack { rhs, to });
        }
    }

    /// `f` of `rhs`, packed into memory that this thread keeps.
    ///
    /// # Panics
    /// As [`Packed::new`].
    pub(crate) fn kept<R>(rhs: Mat<'_>, f: impl FnOnce(&Self) -> R) -> R {
        Self::in_kept(|packed| {
            packed.fill(rhs);
            f(packed)
        })
    }

    /// `f` of a matrix `[depth, cols]` that is no [`Mat`], in memory that this thread
    /// keeps: `fill` writes its panels, those floats too that pad the last one.
    pub(crate) fn kept_by<R>(
        [depth, cols]: [usize; 2],
        fill: impl FnOnce(&mut [f32]),
        f: impl FnOnce(&Self) -> R,
    ) -> R {
        Self::in_kept(|packed| {
            (packed.depth, packed.cols) = (depth, cols);
            fill(grown(&mut packed.data, depth * cols.next_multiple_of(LANES)));
            f(packed)
        })
    }

    fn in_kept<R>(f: impl FnOnce(&mut Self) -> R) -> R {
        thread_local! {
            static KEPT: Cell<Packed> = Cell::default();
        }
        // Taken, not borrowed: a task may run inside another one's wait.
        let mut packed = KEPT.take();
        let result = f(&mut packed);
        KEPT.set(packed);
        result
    }

    /// k.
    pub fn depth(&self) -> usize {
        self.depth
    }

    /// n.
    pub fn cols(&self) -> usize {
        self.cols
    }
}

struct Pack<'a> {
    rhs: Mat<'a>,
    to: &'a mut [f32],
}

impl Kernel for Pack<'_> {
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

/// `from` into rows `pitch` ≥ `from.cols` long, the rest of each zeros.
#[inline(always)]
pub(in crate::cpu) fn copy<S: Simd>(s: S, from: Mat<'_>, pitch: usize, to: &mut [f32]) {
    let Mat { data, rows, cols, row_stride, col_stride } = from;
    if col_stride == 1 {
        for (i, to) in to.chunks_exact_mut(pitch).enumerate() {
            to[..cols].copy_from_slice(&data[i * row_stride..][..cols]);
            to[cols..].fill(0.0);
        }
        return;
    }
    let (whole_rows, whole_cols) = (rows / LANES * LANES, cols / LANES * LANES);
    if row_stride == 1 {
        // Along the lines of the source, however far apart they lie.
        for j in (0..whole_cols).step_by(LANES) {
            for i in (0..whole_rows).step_by(LANES) {
                let mut square = [s.splat(0.0); LANES];
                for (c, v) in square.iter_mut().enumerate() {
                    *v = s.load(lanes(&data[(j + c) * col_stride + i..]));
                }
                for (r, v) in s.transpose(square).into_iter().enumerate() {
                    s.store(v, lanes_mut(&mut to[(i + r) * pitch + j..]));
                }
            }
        }
    }
    let done = if row_stride == 1 { [whole_rows, whole_cols] } else { [0, 0] };
    for (i, to) in to.chunks_exact_mut(pitch).enumerate() {
        let first = if i < done[0] { done[1] } else { 0 };
        for (j, to) in to[..cols].iter_mut().enumerate().skip(first) {
            *to = data[i * row_stride + j * col_stride];
        }
        to[cols..].fill(0.0);
    }
}

/// The first sixteen of `v`; zeros where it is shorter.
#[inline(always)]
fn lanes(v: &[f32]) -> &[f32; LANES] {
    v.first_chunk().unwrap_or(&[0.0; LANES])
}

#[inline(always)]
fn lanes_mut(v: &mut [f32]) -> &mut [f32; LANES] {
    match v.first_chunk_mut() {
        Some(v) => v,
        None => unreachable!("gemm: a whole vector was asked for"),
    }
}
