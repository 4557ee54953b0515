//! Register tiles: six rows and up to four vectors of columns summed without a pause.
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over register tiles unroll, iterators over them need not"
)]

use crate::cpu::simd::{LANES, Simd, Vector};

/// Rows of a register tile.
const ROWS: usize = 6;

/// One part of the sums: rows of the left factor, `depth` of its columns, one panel.
#[derive(Clone, Copy)]
pub(super) struct Part {
    /// First element of the left factor, and the distance between its rows.
    pub a: *const f32,
    pub a_stride: usize,
    /// First row of the panel, `depth` of them.
    pub b: *const f32,
    pub depth: usize,
    /// First element of the destination, and the distance between its rows.
    pub dst: *mut f32,
    pub dst_stride: usize,
    /// Columns that exist: the last vector may be partly padding.
    pub cols: usize,
    pub scale: f32,
    /// `None`: the destination's own; else a vector's worth a vector.
    pub base: Option<*const f32>,
}

/// All rows of a part, by register tiles.
///
/// # Safety
/// Every place that `part` names for `m` rows must be there (`Product::run`).
#[inline(always)]
pub(super) unsafe fn rows<S: Simd>(s: S, part: Part, m: usize, width: usize) {
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
                    sums[r][v] = x.fma(columns[v], sums[r][v]);
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
                let base = vector(s, base.add(r * base_stride + v * LANES));
                let sum = scale.fma(sums[r][v], base);
                let to = part.dst.add(r * part.dst_stride + v * LANES);
                s.store(sum, &mut *to.cast::<[f32; LANES]>());
            }
        }
    }
}
