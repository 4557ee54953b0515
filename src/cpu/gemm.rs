//! Matrix product on slices: own register tiles on [`super::simd`], the
//! right factor packed once and used by any number of callers.
//!
//! Callers parallelise over blocks of rows themselves. A result is a sum over k in
//! order, in parts of 128, whatever the block of rows that it is computed with:
//! how rows are cut into tasks does not show, and fused levels agree to the byte.
//! Oracle: three loops in f64 (the tests).

mod packed;
#[cfg(test)]
mod tests;
mod tile;

use super::simd::{Kernel, LANES, Simd, SimdLevel};
use super::uninit::UninitBuffer;
pub(super) use packed::copy;
pub use packed::{Mat, Packed};
use rayon::prelude::*;
use tile::{Part, rows};

/// Columns of a full panel of the right factor: four vectors.
pub(super) const PANEL: usize = 4 * LANES;
/// Products of one sum in registers: 128 · 64 floats of a panel are 32 KiB, which stay
/// in the first-level cache while the rows of the left factor pass.
const DEPTH: usize = 128;
/// Rows this many floats apart (4 KiB) lie in one set of the first-level cache, where
/// they put one another and the panel out.
const ALIAS: usize = 1024;

/// What a product is added to.
#[derive(Clone, Copy, Debug)]
pub enum Base<'a> {
    /// Nothing.
    Zero,
    /// What the destination holds.
    Own,
    /// One number a column.
    Row(&'a [f32]),
}

/// `dst = base + scale · lhs · rhs`. `dst` is row-major, its rows `row_stride` elements
/// apart.
///
/// # Panics
/// Where a matrix reaches past its slice or the sizes differ: the bounds check that the
/// kernel rests on.
pub fn product(dst: (&mut [f32], usize), lhs: Mat<'_>, rhs: &Packed, scale: f32, base: Base<'_>) {
    product_on(SimdLevel::best(), dst, lhs, rhs, scale, base);
}

/// [`product`] compiled for `level`.
pub(crate) fn product_on(
    level: SimdLevel,
    (dst, row_stride): (&mut [f32], usize),
    lhs: Mat<'_>,
    rhs: &Packed,
    scale: f32,
    base: Base<'_>,
) {
    let (m, n) = (lhs.rows, rhs.cols);
    if m == 0 || n == 0 {
        return;
    }
    assert!(row_stride >= n && (m - 1) * row_stride + n <= dst.len(), "gemm: destination");
    // SAFETY: the rows lie in `dst` (checked), apart from one another.
    unsafe { product_at(level, (dst.as_mut_ptr(), row_stride), lhs, rhs, scale, base) };
}

/// [`product_on`] into memory that need hold no numbers yet, unless `base` is
/// [`Base::Own`]. Every column of every row is written.
///
/// # Safety
/// `lhs.rows` rows of `rhs.cols` floats, `row_stride` apart, are there to be written
/// (with [`Base::Own`]: are numbers) and nobody else's meanwhile.
pub(crate) unsafe fn product_at(
    level: SimdLevel,
    (dst, row_stride): (*mut f32, usize),
    lhs: Mat<'_>,
    rhs: &Packed,
    scale: f32,
    base: Base<'_>,
) {
    let (m, k, n) = (lhs.rows, lhs.cols, rhs.cols);
    assert_eq!(k, rhs.depth, "gemm: inner sizes");
    lhs.check("operands");
    if m == 0 || n == 0 {
        return;
    }
    assert!(row_stride >= n, "gemm: destination");
    assert!(rhs.data.len() >= k * n.next_multiple_of(LANES), "gemm: panels");
    if let Base::Row(row) = base {
        assert_eq!(row.len(), n, "gemm: row");
    }
    level.run(Product { dst, row_stride, lhs, rhs, scale, base });
}

/// `dst = scale · lhs · rhs`, or `dst += …` with `accumulate`: [`product`] with a right
/// factor that is used once.
///
/// # Panics
/// As [`product`].
pub fn gemm(
    dst: &mut [f32],
    row_stride: usize,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    scale: f32,
    accumulate: bool,
) {
    let base = if accumulate { Base::Own } else { Base::Zero };
    Packed::kept(rhs, |packed| product((dst, row_stride), lhs, packed, scale, base));
}

/// Rows of a task of [`rows_product`]: a chunk of the trunk's parents is one.
const BLOCK: usize = 256;
/// Least rows of a task, and floats of its result beyond which it has fewer rows.
const BLOCK_LEAST: usize = 48;
const BLOCK_FLOATS: usize = 1 << 16;

/// `base + lhs · rhs` into new memory, row-major, blocks of rows in parallel; up to
/// 256 rows on the caller's thread.
///
/// # Panics
/// As [`product`].
pub fn rows_product(lhs: Mat<'_>, rhs: &Packed, base: Base<'_>) -> Vec<f32> {
    let (m, n) = (lhs.rows, rhs.cols);
    lhs.check("operands");
    assert!(!matches!(base, Base::Own), "gemm: new memory holds nothing");
    let mut fresh = UninitBuffer::new(m * n);
    if let Some(rows) = BLOCK_FLOATS.checked_div(n) {
        let rows = rows.clamp(BLOCK_LEAST, BLOCK);
        let rows = if m <= BLOCK { BLOCK } else { rows };
        fresh.par_chunks_mut(rows * n).enumerate().for_each(|(i, block)| {
            let lhs = Mat {
                data: &lhs.data[(i * rows * lhs.row_stride).min(lhs.data.len())..],
                rows: block.len() / n,
                ..lhs
            };
            let dst = (block.as_mut_ptr().cast(), n);
            // SAFETY: the block is that many rows, this task's alone; `base` is not
            // `Own` (asserted above).
            unsafe { product_at(SimdLevel::best(), dst, lhs, rhs, 1.0, base) };
        });
    }
    // SAFETY: the products above wrote every block; without columns there is none.
    unsafe { fresh.assume_init() }
}

struct Product<'a> {
    dst: *mut f32,
    row_stride: usize,
    lhs: Mat<'a>,
    rhs: &'a Packed,
    scale: f32,
    base: Base<'a>,
}

impl Kernel for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (m, k, n) = (self.lhs.rows, self.lhs.cols, self.rhs.cols);
        let mut turned = Vec::new();
        let mut first = 0;
        loop {
            let depth = DEPTH.min(k - first);
            let mut lhs = Mat { cols: depth, ..self.lhs };
            // An empty part is there for the base alone.
            lhs.data = if depth == 0 { &[] } else { &lhs.data[first * lhs.col_stride..] };
            if lhs.col_stride != 1 || (lhs.row_stride.is_multiple_of(ALIAS) && n > PANEL) {
                turned.resize(m * depth, 0.0);
                copy(s, lhs, depth, &mut turned);
                lhs = Mat::new(&turned, m, depth, depth);
            }
            for j in (0..n).step_by(PANEL) {
                let width = (n - j).next_multiple_of(LANES).min(PANEL);
                let mut start = [0.0; PANEL];
                let base = match self.base {
                    Base::Own => None,
                    _ if first > 0 => None,
                    Base::Zero => Some(start.as_ptr()),
                    Base::Row(row) => {
                        let row = &row[j..(j + PANEL).min(n)];
                        start[..row.len()].copy_from_slice(row);
                        Some(start.as_ptr())
                    }
                };
                // SAFETY: j < n, the floats of each row.
                let dst = unsafe { self.dst.add(j) };
                let part = Part {
                    a: lhs.data.as_ptr(),
                    a_stride: lhs.row_stride,
                    b: self.rhs.data[j * k + first * width..].as_ptr(),
                    depth,
                    dst,
                    dst_stride: self.row_stride,
                    cols: (n - j).min(PANEL),
                    scale: self.scale,
                    base,
                };
                // SAFETY: rows 0..m of `lhs` (checked, or just copied), columns
                // j..j + cols of `dst` (the callers' promise) and `depth` rows of a panel
                // `width` wide (checked) are there; `base` points at PANEL floats that
                // outlive the call.
                unsafe { rows(s, part, m, width) };
            }
            first += depth;
            if first >= k {
                break;
            }
        }
    }
}
