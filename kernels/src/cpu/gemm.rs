//! Matrix product on slices.
//!
//! ```text
//! dst[i][j] = base[i][j] + scale · Σ_k lhs[i][k] · rhs[k][j]
//! ```
//!
//! Input: lhs `[m, k]` of any strides; rhs `[k, n]`, packed once into panels of 64 columns
//! ([`Packed`], `packing`) and shared by any number of calls; base zero, dst itself or a row
//! `[n]`. Output: dst `[m, n]`, row-major. A register tile of 6 rows × up to 64 columns sums
//! 128 products of each element before its epilogue adds base and scale (`register_tile`).
//! Callers parallelise over blocks of rows themselves.
//! Invariant: each element is summed over k in order, in parts of 128. Cutting the rows into
//! tasks therefore changes no byte, and SIMD levels with fused multiply-add agree bit for bit.
//! WGSL: none. Oracle and tests: gemm/tests.rs (three loops in f64).
//!
//! 1×1 convolutions of any stride, their weight gradients and the feed-forward block are such
//! products.
//!
//! This replaces candle's matrix product, whose own thread pool spins, and locks when rayon's threads call it.

mod packing;
mod register_tile;
#[cfg(test)]
mod tests;

use super::simd::{Kernel, LANES, Simd, SimdLevel};
use super::uninit::UninitBuffer;
use super::work;
pub(super) use packing::copy;
pub use packing::{Mat, Packed};
use rayon::prelude::*;
use register_tile::{PanelProduct, multiply_panel};

/// Columns of a full panel of the right factor: four vectors.
pub(super) const PANEL: usize = 4 * LANES;
/// Maximum products of one sum in registers. 128 · 64 floats of a panel are 32 KiB, which
/// stay in the first-level cache while all rows of the left factor are multiplied with them.
const MAX_DEPTH: usize = 128;
/// Rows whose distance is a multiple of this (4 KiB) share one set of the first-level cache,
/// where they evict each other and the panel.
const CACHE_SET_STRIDE: usize = 1024;

/// The matrix that a product is added to.
#[derive(Clone, Copy, Debug)]
pub enum Base<'a> {
    /// Zeros.
    Zero,
    /// The destination's own numbers.
    Own,
    /// The same row `[n]` for every row of the destination.
    Row(&'a [f32]),
}

/// Computes `dst = base + scale · lhs · rhs`. `dst` is a row-major slice and the distance of
/// its rows.
///
/// # Panics
/// Where a matrix extends beyond its slice, or where sizes differ.
pub fn product(dst: (&mut [f32], usize), lhs: Mat<'_>, rhs: &Packed, scale: f32, base: Base<'_>) {
    product_on(SimdLevel::best(), dst, lhs, rhs, scale, base);
}

/// Computes [`product`] at one SIMD level.
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
    // SAFETY: the rows lie in `dst` without overlap (checked), and `dst` is initialised.
    unsafe {
        product_at(level, OutputRows { at: dst.as_mut_ptr(), row_stride }, lhs, rhs, scale, base)
    };
}

/// Destination of [`product_at`]: row i begins at `at + i·row_stride`.
#[derive(Clone, Copy)]
pub(crate) struct OutputRows {
    pub at: *mut f32,
    pub row_stride: usize,
}

/// Computes [`product_on`] into memory that may be uninitialised, unless `base` is
/// [`Base::Own`]. Writes every column of every row.
///
/// # Safety
/// `dst` has `lhs.rows` writable rows of `rhs.cols` floats, initialised for [`Base::Own`],
/// which no other thread accesses during the call.
pub(crate) unsafe fn product_at(
    level: SimdLevel,
    dst: OutputRows,
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
    assert!(dst.row_stride >= n, "gemm: destination");
    assert!(rhs.data.len() >= k * n.next_multiple_of(LANES), "gemm: panels");
    if let Base::Row(row) = base {
        assert_eq!(row.len(), n, "gemm: row");
    }
    work::add(m * k * n, m * k + k * n + m * n);
    level.run(Product { dst, lhs, rhs, scale, base });
}

/// Computes `dst = scale · lhs · rhs`, or `dst += scale · lhs · rhs` with `accumulate`, for a
/// right factor that is used once.
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
    Packed::with(rhs, |packed| product((dst, row_stride), lhs, packed, scale, base));
}

/// Maximum rows of a task of [`rows_product`]. Products of at most as many rows, such as those
/// of one chunk of primaries, run on the caller's thread.
const MAX_TASK_ROWS: usize = 256;
/// Minimum rows of a task.
const MIN_TASK_ROWS: usize = 48;
/// Floats of a task's result, within these limits.
const TASK_FLOATS: usize = 1 << 16;

/// Computes `base + lhs · rhs` into new memory, row-major, with blocks of rows in parallel.
/// Up to 256 rows run on the caller's thread.
///
/// # Panics
/// As [`product`]; also where `base` is [`Base::Own`].
pub fn rows_product(lhs: Mat<'_>, rhs: &Packed, base: Base<'_>) -> Vec<f32> {
    let (m, n) = (lhs.rows, rhs.cols);
    lhs.check("operands");
    assert!(!matches!(base, Base::Own), "gemm: new memory has no numbers to add to");
    let mut fresh = UninitBuffer::new(m * n);
    if let Some(rows) = TASK_FLOATS.checked_div(n) {
        let rows = rows.clamp(MIN_TASK_ROWS, MAX_TASK_ROWS);
        let rows = if m <= MAX_TASK_ROWS { MAX_TASK_ROWS } else { rows };
        fresh.par_chunks_mut(rows * n).enumerate().for_each(|(i, block)| {
            let lhs = Mat {
                data: &lhs.data[(i * rows * lhs.row_stride).min(lhs.data.len())..],
                rows: block.len() / n,
                ..lhs
            };
            let dst = OutputRows { at: block.as_mut_ptr().cast(), row_stride: n };
            // SAFETY: the block holds that many rows, which no other task accesses; `base`
            // is not `Own` (asserted above).
            unsafe { product_at(SimdLevel::best(), dst, lhs, rhs, 1.0, base) };
        });
    }
    // SAFETY: the products above wrote every block; without columns there is no block.
    unsafe { fresh.assume_init() }
}

/// The kernel of [`product_at`].
struct Product<'a> {
    dst: OutputRows,
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
        let mut copied = Vec::new();
        let mut first = 0;
        loop {
            let depth = MAX_DEPTH.min(k - first);
            let mut lhs = Mat { cols: depth, ..self.lhs };
            // With k = 0 a single empty part writes the base.
            lhs.data = if depth == 0 { &[] } else { &lhs.data[first * lhs.col_stride..] };
            let aliased = lhs.row_stride.is_multiple_of(CACHE_SET_STRIDE) && n > PANEL;
            if lhs.col_stride != 1 || aliased {
                copied.resize(m * depth, 0.0);
                copy(s, lhs, depth, &mut copied);
                lhs = Mat::new(&copied, m, depth, depth);
            }
            for j in (0..n).step_by(PANEL) {
                let width = (n - j).next_multiple_of(LANES).min(PANEL);
                let mut base_row = [0.0; PANEL];
                // Parts after the first one add to the destination.
                let base = match self.base {
                    Base::Own => None,
                    _ if first > 0 => None,
                    Base::Zero => Some(base_row.as_ptr()),
                    Base::Row(row) => {
                        let row = &row[j..(j + PANEL).min(n)];
                        base_row[..row.len()].copy_from_slice(row);
                        Some(base_row.as_ptr())
                    }
                };
                // SAFETY: j < n, the floats of each row.
                let dst = unsafe { self.dst.at.add(j) };
                let panel = PanelProduct {
                    a: lhs.data.as_ptr(),
                    a_stride: lhs.row_stride,
                    b: self.rhs.data[j * k + first * width..].as_ptr(),
                    depth,
                    dst,
                    dst_stride: self.dst.row_stride,
                    cols: (n - j).min(PANEL),
                    scale: self.scale,
                    base,
                };
                // SAFETY: rows 0..m of `lhs` (checked, or just copied), columns
                // j..j + cols of `dst` (the contract of `product_at`) and `depth` rows of
                // a panel `width` wide (checked) are valid; `base` points at PANEL floats
                // that outlive the call.
                unsafe { multiply_panel(s, panel, m, width) };
            }
            first += depth;
            if first >= k {
                break;
            }
        }
    }
}
