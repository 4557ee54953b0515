//! Matrix product on slices: own register tiles on [`super::simd`], the
//! right factor packed once and used by any number of callers.
//!
//! Callers parallelise over blocks of rows themselves. A result is a sum over k in
//! order, in parts of [`DEPTH`], whatever the block of rows that it is computed with:
//! how rows are cut into tasks does not show, and fused tiers agree to the byte.
//! Oracle: three loops in f64 (the tests).
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over register tiles unroll, iterators over them need not"
)]

use super::fresh::{Fresh, start};
use super::simd::{Kernel, LANES, Simd, Tier};
use rayon::prelude::*;
use std::cell::RefCell;

/// Columns of a full panel of the right factor: four vectors.
const PANEL: usize = 4 * LANES;
/// Products of one sum in registers: 128 · 64 floats of a panel are 32 KiB, which stay
/// in the first-level cache while the rows of the left factor pass.
const DEPTH: usize = 128;
/// Rows this many floats apart (4 KiB) lie in one set of the first-level cache, where
/// they put one another and the panel out.
const ALIAS: usize = 1024;
/// Rows of a register tile.
const ROWS: usize = 6;

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
    fn check(&self, name: &str) {
        assert!(self.extent() <= self.data.len(), "gemm: {name}");
    }
}

/// The right factor `[k, n]` in panels of [`PANEL`] columns (the last one as wide as it
/// must be, in whole vectors, padded with zeros): `[panel][k][column]`.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    data: Vec<f32>,
    depth: usize,
    cols: usize,
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
        // Every place is written below.
        self.data.resize(rhs.rows * rhs.cols.next_multiple_of(LANES), 0.0);
        if rhs.rows > 0 && rhs.cols > 0 {
            Tier::best().run(Pack { rhs, to: &mut self.data });
        }
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
pub(super) fn copy<S: Simd>(s: S, from: Mat<'_>, pitch: usize, to: &mut [f32]) {
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
    product_on(Tier::best(), dst, lhs, rhs, scale, base);
}

/// [`product`] compiled for `tier`.
pub(crate) fn product_on(
    tier: Tier,
    (dst, row_stride): (&mut [f32], usize),
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
    assert!(row_stride >= n && (m - 1) * row_stride + n <= dst.len(), "gemm: destination");
    assert!(rhs.data.len() == k * n.next_multiple_of(LANES), "gemm: panels");
    if let Base::Row(row) = base {
        assert_eq!(row.len(), n, "gemm: row");
    }
    tier.run(Product { dst, row_stride, lhs, rhs, scale, base });
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
    thread_local! {
        static PACKED: RefCell<Packed> = RefCell::default();
    }
    let base = if accumulate { Base::Own } else { Base::Zero };
    PACKED.with_borrow_mut(|packed| {
        packed.fill(rhs);
        product((dst, row_stride), lhs, packed, scale, base);
    });
}

/// Rows of a task of [`rows_product`]: a chunk of the trunk's parents is one.
const BLOCK: usize = 256;
/// Least rows of a task, and floats of its result beyond which it has fewer rows.
const BLOCK_LEAST: usize = 48;
const BLOCK_FLOATS: usize = 1 << 16;

/// `base + lhs · rhs` into new memory, row-major, blocks of rows in parallel; up to
/// [`BLOCK`] rows on the caller's thread.
///
/// # Panics
/// As [`product`].
pub fn rows_product(lhs: Mat<'_>, rhs: &Packed, base: Base<'_>) -> Vec<f32> {
    let (m, n) = (lhs.rows, rhs.cols);
    lhs.check("operands");
    let mut fresh = Fresh::new(m * n);
    if n > 0 {
        let rows = (BLOCK_FLOATS / n).clamp(BLOCK_LEAST, BLOCK);
        let rows = if m <= BLOCK { BLOCK } else { rows };
        fresh.blocks(rows * n).enumerate().for_each(|(i, block)| {
            let dst = start(block);
            let lhs = Mat {
                data: &lhs.data[(i * rows * lhs.row_stride).min(lhs.data.len())..],
                rows: dst.len() / n,
                ..lhs
            };
            product((dst, n), lhs, rhs, 1.0, base);
        });
    }
    // SAFETY: the loop above started every block; without columns there is none.
    unsafe { fresh.finish() }
}

struct Product<'a> {
    dst: &'a mut [f32],
    row_stride: usize,
    lhs: Mat<'a>,
    rhs: &'a Packed,
    scale: f32,
    base: Base<'a>,
}

/// One part of the sums: rows of the left factor, `depth` of its columns, one panel.
#[derive(Clone, Copy)]
struct Part {
    /// First element of the left factor, and the distance between its rows.
    a: *const f32,
    a_stride: usize,
    /// First row of the panel, `depth` of them.
    b: *const f32,
    depth: usize,
    /// First element of the destination, and the distance between its rows.
    dst: *mut f32,
    dst_stride: usize,
    /// Columns that exist: the last vector may be partly padding.
    cols: usize,
    scale: f32,
    /// `None`: the destination's own; else a vector's worth a vector.
    base: Option<*const f32>,
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
                let part = Part {
                    a: lhs.data.as_ptr(),
                    a_stride: lhs.row_stride,
                    b: self.rhs.data[j * k + first * width..].as_ptr(),
                    depth,
                    dst: self.dst[j..].as_mut_ptr(),
                    dst_stride: self.row_stride,
                    cols: (n - j).min(PANEL),
                    scale: self.scale,
                    base,
                };
                // SAFETY: rows 0..m of `lhs` (checked, or just copied), columns
                // j..j + cols of `dst` (checked) and `depth` rows of a panel `width`
                // wide (checked) lie inside their slices; `dst` is borrowed
                // exclusively; `base` points at PANEL floats that outlive the call.
                unsafe { rows(s, part, m, width) };
            }
            first += depth;
            if first >= k {
                break;
            }
        }
    }
}

/// All rows of a part, by register tiles.
///
/// # Safety
/// Every place that `part` names for `m` rows must be there ([`Product::run`]).
#[inline(always)]
unsafe fn rows<S: Simd>(s: S, part: Part, m: usize, width: usize) {
    // SAFETY: the caller's; tiles stay inside the rows and the panel.
    unsafe {
        if S::REGISTERS >= 32 {
            match width / LANES {
                4 => tiles::<S, 4>(s, part, m, width),
                3 => tiles::<S, 3>(s, part, m, width),
                2 => tiles::<S, 2>(s, part, m, width),
                _ => tiles::<S, 1>(s, part, m, width),
            }
        } else {
            for j in (0..width).step_by(LANES) {
                let own = Part {
                    b: part.b.add(j),
                    dst: part.dst.add(j),
                    cols: (part.cols - j).min(LANES),
                    base: part.base.map(|b| b.add(j)),
                    ..part
                };
                tiles::<S, 1>(s, own, m, width);
            }
        }
    }
}

/// # Safety
/// As [`rows`].
#[inline(always)]
unsafe fn tiles<S: Simd, const V: usize>(s: S, part: Part, m: usize, width: usize) {
    // SAFETY: the caller's.
    unsafe {
        // Holds no vector, so that it may be a closure.
        let at = |i: usize| Part {
            a: part.a.wrapping_add(i * part.a_stride),
            dst: part.dst.add(i * part.dst_stride),
            ..part
        };
        let whole = m / ROWS * ROWS;
        for i in (0..whole).step_by(ROWS) {
            tile::<S, ROWS, V>(s, at(i), width);
        }
        match m - whole {
            0 => {}
            1 => tile::<S, 1, V>(s, at(whole), width),
            2 => tile::<S, 2, V>(s, at(whole), width),
            3 => tile::<S, 3, V>(s, at(whole), width),
            4 => tile::<S, 4, V>(s, at(whole), width),
            _ => tile::<S, 5, V>(s, at(whole), width),
        }
    }
}

/// # Safety
/// Sixteen floats at `p`.
#[inline(always)]
unsafe fn vector<S: Simd>(s: S, p: *const f32) -> S::F {
    // SAFETY: the caller's; an array has the alignment of its elements.
    s.load(unsafe { &*p.cast::<[f32; LANES]>() })
}

/// R rows, V vectors of columns.
///
/// # Safety
/// As [`rows`].
#[inline(always)]
unsafe fn tile<S: Simd, const R: usize, const V: usize>(s: S, part: Part, width: usize) {
    // SAFETY: the caller's; a store past the last column goes through a buffer.
    unsafe {
        let mut sums = [[s.splat(0.0); V]; R];
        let (mut a, mut b) = (part.a, part.b);
        for _ in 0..part.depth {
            let mut columns = [s.splat(0.0); V];
            for v in 0..V {
                columns[v] = vector(s, b.add(v * LANES));
            }
            for r in 0..R {
                let x = s.splat(*a.add(r * part.a_stride));
                for v in 0..V {
                    sums[r][v] = s.fma(x, columns[v], sums[r][v]);
                }
            }
            a = a.add(1);
            b = b.wrapping_add(width);
        }
        finish(s, part, sums);
    }
}

/// base + scale · sums. Loops over registers hold nothing but their moves, or else
/// they are not unrolled and the sums live on the stack.
///
/// # Safety
/// As [`rows`].
#[inline(always)]
unsafe fn finish<S: Simd, const R: usize, const V: usize>(s: S, part: Part, sums: [[S::F; V]; R]) {
    let scale = s.splat(part.scale);
    // SAFETY: the caller's; columns past the last are in the buffer alone.
    unsafe {
        if part.cols < V * LANES {
            let mut edge = [[[0.0; LANES]; V]; R];
            for (r, edge) in edge.iter_mut().enumerate() {
                let own = part.dst.add(r * part.dst_stride);
                let base = part.base.unwrap_or(own);
                let base = std::slice::from_raw_parts(base, part.cols);
                edge.as_flattened_mut()[..part.cols].copy_from_slice(base);
            }
            for r in 0..R {
                for v in 0..V {
                    let sum = s.fma(scale, sums[r][v], s.load(&edge[r][v]));
                    s.store(sum, &mut edge[r][v]);
                }
            }
            for (r, edge) in edge.iter().enumerate() {
                let own = part.dst.add(r * part.dst_stride);
                let own = std::slice::from_raw_parts_mut(own, part.cols);
                own.copy_from_slice(&edge.as_flattened()[..part.cols]);
            }
            return;
        }
        let (base, base_stride) = match part.base {
            Some(base) => (base, 0),
            None => (part.dst.cast_const(), part.dst_stride),
        };
        for r in 0..R {
            for v in 0..V {
                let base = vector(s, base.add(r * base_stride + v * LANES));
                let sum = s.fma(scale, sums[r][v], base);
                let to = part.dst.add(r * part.dst_stride + v * LANES);
                s.store(sum, &mut *to.cast::<[f32; LANES]>());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(n: usize, k: f32) -> Vec<f32> {
        (0..n).map(|i| ((i as f32 + 0.5) * k).sin()).collect()
    }

    /// Σ lhs(i, x)·rhs(x, j) in f64.
    fn dot(lhs: Mat<'_>, rhs: Mat<'_>, i: usize, j: usize) -> f64 {
        let at = |m: Mat<'_>, i: usize, j: usize| m.data[i * m.row_stride + j * m.col_stride];
        (0..lhs.cols).map(|x| f64::from(at(lhs, i, x)) * f64::from(at(rhs, x, j))).sum()
    }

    /// Sizes around every edge: rows of a tile, vectors and panels of columns, parts of
    /// the sums; each factor as it is and transposed.
    #[test]
    fn agrees_with_three_loops() {
        for (m, k, n) in [(7, 13, 9), (6, 129, 64), (23, 256, 80), (1, 1, 1), (40, 300, 150)] {
            let (a, b) = (numbers(m * k, 0.7), numbers(k * n, 0.3));
            let own = numbers(m * (n + 2), 1.9);
            let row = numbers(n, 2.3);
            for turned in 0..4 {
                let lhs = match turned & 1 {
                    0 => Mat::new(&a, m, k, k),
                    _ => Mat::new(&a, k, m, m).t(),
                };
                let rhs = match turned & 2 {
                    0 => Mat::new(&b, k, n, n),
                    _ => Mat::new(&b, n, k, k).t(),
                };
                for base in [Base::Zero, Base::Own, Base::Row(&row)] {
                    let mut dst = own.clone();
                    let packed = Packed::new(rhs);
                    product((&mut dst, n + 2), lhs, &packed, 2.0, base);
                    for (at, (&v, &before)) in dst.iter().zip(&own).enumerate() {
                        let (i, j) = (at / (n + 2), at % (n + 2));
                        if j >= n {
                            assert_eq!(v, before, "{m} {k} {n}: past the row at {i} {j}");
                            continue;
                        }
                        let base = match base {
                            Base::Zero => 0.0,
                            Base::Own => before,
                            Base::Row(row) => row[j],
                        };
                        let want = f64::from(base) + 2.0 * dot(lhs, rhs, i, j);
                        let far = (f64::from(v) - want).abs();
                        assert!(
                            far < 4e-6 * (k as f64).sqrt() + 1e-6,
                            "{m} {k} {n} {i} {j}: {far}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn every_tier_agrees_and_rows_may_be_cut_anywhere() {
        let (m, k, n) = (31, 200, 100);
        let (a, b) = (numbers(m * k, 0.7), numbers(k * n, 0.3));
        let rhs = Packed::new(Mat::new(&b, k, n, n));
        let run = |tier: Tier, cut: usize| {
            let mut dst = vec![0.0; m * n];
            for (first, dst) in (0..m).step_by(cut).zip(dst.chunks_mut(cut * n)) {
                let lhs = Mat::new(&a[first * k..], dst.len() / n, k, k);
                let (row_stride, rhs, base) = (n, &rhs, Base::Zero);
                tier.run(Product { dst, row_stride, lhs, rhs, scale: 1.0, base });
            }
            dst
        };
        let mut fused = None;
        for &tier in Tier::available() {
            let whole = run(tier, m);
            for cut in [1, 5, 8] {
                assert_eq!(run(tier, cut), whole, "{tier:?} in blocks of {cut}");
            }
            if tier == Tier::Scalar {
                continue;
            }
            assert_eq!(fused.get_or_insert_with(|| whole.clone()), &whole, "{tier:?}");
        }
    }

    #[test]
    fn empty_sums_give_the_base() {
        let mut dst = [5.0; 4];
        product(
            (&mut dst, 2),
            Mat::new(&[], 2, 0, 0),
            &Packed::new(Mat::new(&[], 0, 2, 2)),
            1.0,
            Base::Row(&[1.0, 2.0]),
        );
        assert_eq!(dst, [1.0, 2.0, 1.0, 2.0]);
    }

    #[test]
    #[should_panic(expected = "gemm: destination")]
    fn short_destination_is_refused() {
        let a = [1.0; 4];
        gemm(&mut [0.0; 3], 2, Mat::new(&a, 2, 2, 2), Mat::new(&a, 2, 2, 2), 1.0, false);
    }
}
