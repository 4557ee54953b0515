//! Register tiles of the matrix product.
//!
//! A register tile holds the sums of 6 rows × up to four vectors of columns. The loop over k
//! loads one row of the panel as vectors and six elements of the left factor as scalars, and
//! adds their products. The epilogue computes `base + scale · sums` and stores it once.
//!
//! Register tiles follow the registers of a level (`Simd::REGISTERS`, in vectors of 16 lanes): 24 sums with
//! AVX-512; 12, then 8, with AVX2 and NEON. Each sum has its products in the same order, so the tile's size
//! changes no bit.
//!
//! The row pointers come from a place that the compiler cannot see. It would compute the addresses anew
//! in the loop: 29 instead of 24 instructions for 12 multiply-adds with AVX2, which is slower on processors with four
//! instructions a cycle. Matrix products take 16 % fewer instructions this way.
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over register tiles unroll, iterators over them need not"
)]

use crate::cpu::simd::{LANES, Simd, Vector};
use std::hint::black_box;

/// Rows of a register tile.
const TILE_ROWS: usize = 6;

/// Operands of a product of some rows of the left factor with one panel, over a part of k.
#[derive(Clone, Copy)]
pub(super) struct PanelProduct {
    /// First element of the left factor.
    pub a: *const f32,
    /// Distance of rows of the left factor.
    pub a_stride: usize,
    /// First row of the panel.
    pub b: *const f32,
    /// Rows of the panel: products per sum.
    pub depth: usize,
    /// First element of the destination.
    pub dst: *mut f32,
    /// Distance of rows of the destination.
    pub dst_stride: usize,
    /// Columns of the destination; the panel's last vector may be partly padding.
    pub cols: usize,
    pub scale: f32,
    /// A row to add, as long as the panel is wide; `None` adds the destination's own numbers.
    pub base: Option<*const f32>,
}

/// Multiplies `m` rows with a panel that is `width` columns wide.
///
/// # Safety
/// All operands of `part` are valid for `m` rows; the destination for `part.cols` columns.
#[inline(always)]
pub(super) unsafe fn multiply_panel<S: Simd>(s: S, part: PanelProduct, m: usize, width: usize) {
    // SAFETY: the contract of this function; tiles stay inside the rows and the panel.
    unsafe {
        if S::REGISTERS >= 32 {
            match width / LANES {
                4 => tiles::<S, 4>(s, part, m, width),
                3 => tiles::<S, 3>(s, part, m, width),
                2 => tiles::<S, 2>(s, part, m, width),
                _ => tiles::<S, 1>(s, part, m, width),
            }
        } else {
            // A tile's rows stay in the first-level cache for all columns of the panel.
            for i in (0..m).step_by(TILE_ROWS) {
                for j in (0..width).step_by(LANES) {
                    let own = PanelProduct {
                        a: part.a.wrapping_add(i * part.a_stride),
                        b: part.b.add(j),
                        dst: part.dst.add(i * part.dst_stride + j),
                        cols: (part.cols - j).min(LANES),
                        base: part.base.map(|b| b.add(j)),
                        ..part
                    };
                    tiles::<S, 1>(s, own, (m - i).min(TILE_ROWS), width);
                }
            }
        }
    }
}

/// Multiplies `m` rows with `V` vectors of columns, one register tile after another.
///
/// # Safety
/// As [`multiply_panel`].
#[inline(always)]
unsafe fn tiles<S: Simd, const V: usize>(s: S, part: PanelProduct, m: usize, width: usize) {
    // SAFETY: the contract of this function.
    unsafe {
        // A closure is inlined well only where it holds no vector.
        let at = |i: usize| PanelProduct {
            a: part.a.wrapping_add(i * part.a_stride),
            dst: part.dst.add(i * part.dst_stride),
            ..part
        };
        let whole = m / TILE_ROWS * TILE_ROWS;
        for i in (0..whole).step_by(TILE_ROWS) {
            tile::<S, TILE_ROWS, V>(s, at(i), width);
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

/// Loads sixteen floats.
///
/// # Safety
/// `p` points at sixteen floats.
#[inline(always)]
unsafe fn load<S: Simd>(s: S, p: *const f32) -> S::F {
    // SAFETY: the contract of this function; an array is aligned as its elements are.
    s.load(unsafe { &*p.cast::<[f32; LANES]>() })
}

/// Computes one register tile of `R` rows and `V` vectors of columns.
///
/// # Safety
/// As [`multiply_panel`], for `R` rows.
#[inline(always)]
unsafe fn tile<S: Simd, const R: usize, const V: usize>(s: S, part: PanelProduct, width: usize) {
    // SAFETY: the contract of this function.
    unsafe {
        let mut sums = [[s.splat(0.0); V]; R];
        let mut b = part.b;
        // A pointer to each row, whose origin the compiler does not see: it would compute the
        // addresses anew in the loop, 29 instructions instead of 24 for 12 of AVX2's multiply-adds.
        let mut a = [part.a; R];
        for r in 0..R {
            a[r] = part.a.wrapping_add(r * part.a_stride);
        }
        let a = black_box(a);
        for i in 0..part.depth {
            let mut columns = [s.splat(0.0); V];
            for v in 0..V {
                columns[v] = load(s, b.add(v * LANES));
            }
            for r in 0..R {
                let x = s.splat(*a[r].wrapping_add(i));
                for v in 0..V {
                    sums[r][v] = x.fma(columns[v], sums[r][v]);
                }
            }
            b = b.wrapping_add(width);
        }
        epilogue(s, part, sums);
    }
}

/// Stores base + scale · sums. Loops over registers do nothing but their loads and stores:
/// longer loops are not unrolled, and the sums would live on the stack.
///
/// # Safety
/// As [`tile`].
#[inline(always)]
unsafe fn epilogue<S: Simd, const R: usize, const V: usize>(
    s: S,
    part: PanelProduct,
    sums: [[S::F; V]; R],
) {
    let scale = s.splat(part.scale);
    // SAFETY: the contract of this function; padded columns go to `edge`, not to `dst`.
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
                    let sum = scale.fma(sums[r][v], s.load(&edge[r][v]));
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
                let base = load(s, base.add(r * base_stride + v * LANES));
                let sum = scale.fma(sums[r][v], base);
                let to = part.dst.add(r * part.dst_stride + v * LANES);
                s.store(sum, &mut *to.cast::<[f32; LANES]>());
            }
        }
    }
}
