//! Sums and moves of whole tensors. Memory limits them, so each is one pass by all threads
//! into uninitialised memory.

use super::gemm::{Mat, copy};
use super::simd::{Kernel, Simd, SimdLevel};
use super::uninit::{UninitBuffer, filled, zeroed};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements per task.
const PART: usize = 1 << 15;

/// Computes a + b into new memory.
pub fn sum(a: &[f32], b: &[f32]) -> Vec<f32> {
    assert_eq!(a.len(), b.len(), "sum: lengths");
    let mut buffer = UninitBuffer::new(a.len());
    let parts = buffer.par_chunks_mut(PART).zip(a.par_chunks(PART)).zip(b.par_chunks(PART));
    parts.for_each(|((block, a), b)| {
        for ((to, a), b) in block.iter_mut().zip(a).zip(b) {
            *to = MaybeUninit::new(a + b);
        }
    });
    // SAFETY: the loop above wrote every place of every block, the lengths being equal.
    unsafe { buffer.assume_init() }
}

/// Concatenates slices into new memory.
pub fn stacked(parts: &[&[f32]]) -> Vec<f32> {
    let mut buffer = UninitBuffer::new(parts.iter().map(|p| p.len()).sum());
    buffer.par_chunks_mut(PART).enumerate().for_each(|(i, block)| {
        let mut skip = i * PART;
        let mut block = block;
        for part in parts {
            let own = part.get(skip..).unwrap_or(&[]);
            skip = skip.saturating_sub(part.len());
            let (now, rest) = block.split_at_mut(own.len().min(block.len()));
            filled(now, &own[..now.len()]);
            block = rest;
        }
    });
    // SAFETY: the blocks together are as long as the parts together, and block i begins
    // where i·PART of them are written.
    unsafe { buffer.assume_init() }
}

/// Rows of the result in a task of [`transposed`].
const ROWS: usize = 256;

/// `[count, rows, cols]` to `[count, cols, rows]`.
pub fn transposed(x: &[f32], rows: usize, cols: usize) -> Vec<f32> {
    let mut buffer = UninitBuffer::new(x.len());
    let area = rows * cols;
    if area > PART {
        // Tasks end where a matrix does.
        let size = if cols.is_multiple_of(ROWS) { ROWS } else { cols };
        buffer.par_chunks_mut(size * rows).enumerate().for_each(|(i, block)| {
            let matrix = i * size / cols;
            let first = i * size % cols;
            let data = &x[matrix * area + first..(matrix + 1) * area];
            let from = Mat { data, rows: size, cols: rows, row_stride: 1, col_stride: cols };
            SimdLevel::best().run(Turn { from, to: zeroed(block) });
        });
    } else if let Some(matrices) = PART.checked_div(area) {
        let size = matrices * area;
        buffer.par_chunks_mut(size).zip(x.par_chunks(size)).for_each(|(block, x)| {
            let all = zeroed(block).chunks_exact_mut(area).zip(x.chunks_exact(area));
            for (to, data) in all {
                let from = Mat::new(data, rows, cols, cols).t();
                SimdLevel::best().run(Turn { from, to });
            }
        });
    }
    // SAFETY: either loop above initialised every block; there is none of an empty matrix.
    unsafe { buffer.assume_init() }
}

/// Copies a matrix of any strides to a row-major one.
pub(super) struct Turn<'a> {
    pub from: Mat<'a>,
    pub to: &'a mut [f32],
}

impl Kernel for Turn<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        copy(s, self.from, self.from.cols, self.to);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(n: usize) -> Vec<f32> {
        (0..n).map(|i| i as f32).collect()
    }

    #[test]
    fn sums_and_stacks_are_what_they_say() {
        let a = numbers(2 * PART + 7);
        let b = vec![0.5; 2 * PART + 7];
        let got = sum(&a, &b);
        assert!(got.iter().zip(&a).all(|(got, a)| *got == a + 0.5));
        let whole = numbers(5 * PART / 2);
        let (first, rest) = whole.split_at(PART + 3);
        let (second, third) = rest.split_at(11);
        assert_eq!(stacked(&[first, &[], second, third]), whole);
        assert!(stacked(&[]).is_empty());
    }

    #[test]
    fn transposes_agree_with_indices() {
        for (count, rows, cols) in
            [(2, 37, 256), (3, 16, 21), (2, 84, 1024), (2, 84, 1001), (20_000, 3, 25), (2, 0, 4)]
        {
            let x = numbers(count * rows * cols);
            let got = transposed(&x, rows, cols);
            for (i, v) in got.iter().enumerate() {
                let m = i / (rows * cols);
                let c = i / rows % cols;
                let r = i % rows;
                assert_eq!(*v, x[(m * rows + r) * cols + c], "{count} {rows} {cols} {i}");
            }
        }
    }
}
