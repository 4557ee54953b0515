//! Channels of one map beside those of a coarser one, each coarse pixel repeated.

use super::uninit::{UninitBuffer, UninitSlice, filled};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Sizes: `[B, C₁, h, w]` beside `[B, C₂, h/s, w/s]` gives `[B, C₁ + C₂, h, w]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Join {
    /// C₁, C₂.
    pub channels: [usize; 2],
    /// h, w.
    pub size: [usize; 2],
    /// s: number of repetitions of a coarse pixel along either side.
    pub repeat: usize,
}

impl Join {
    fn plane(&self) -> usize {
        self.size[0] * self.size[1]
    }
}

/// Both maps of `batch` pictures, new memory.
pub fn forward(j: &Join, batch: usize, fine: &[f32], coarse: &[f32]) -> Vec<f32> {
    let (n, [c1, c2], s, w) = (j.plane(), j.channels, j.repeat, j.size[1]);
    let small = n / (s * s);
    let mut buffer = UninitBuffer::new(batch * (c1 + c2) * n);
    buffer.par_chunks_mut(n).enumerate().for_each(|(i, y)| {
        let (b, c) = (i / (c1 + c2), i % (c1 + c2));
        if c < c1 {
            filled(y, &fine[(b * c1 + c) * n..][..n]);
        } else {
            repeat(&coarse[(b * c2 + c - c1) * small..][..small], w, s, y);
        }
    });
    // SAFETY: the loop above filled every block.
    unsafe { buffer.assume_init() }
}

/// A plane of which every pixel is repeated `s` × `s` times into one `w` wide.
///
/// # Panics
/// Where the sizes do not fit: the block is then not all written.
pub(super) fn repeat(x: &[f32], w: usize, s: usize, y: &mut UninitSlice<f32>) {
    assert!(x.len() * s * s == y.len() && y.len().is_multiple_of(w * s) && w.is_multiple_of(s));
    if s == 1 {
        filled(y, x);
        return;
    }
    for (x, y) in x.chunks_exact(w / s).zip(y.chunks_exact_mut(s * w)) {
        let (first, others) = y.split_at_mut(w);
        match s {
            2 => spread::<2>(x, first),
            4 => spread::<4>(x, first),
            _ => {
                for (x, y) in x.iter().zip(first.chunks_exact_mut(s)) {
                    y.fill(MaybeUninit::new(*x));
                }
            }
        }
        others.chunks_exact_mut(w).for_each(|row| row.copy_from_slice(first));
    }
}

/// Each number S times; a count that is known makes it shuffles of vectors.
fn spread<const S: usize>(x: &[f32], y: &mut UninitSlice<f32>) {
    for (x, y) in x.iter().zip(y.as_chunks_mut::<S>().0) {
        *y = [MaybeUninit::new(*x); S];
    }
}

/// The fine map's gradient.
pub fn backward_fine(j: &Join, dy: &[f32], dx: &mut [f32]) {
    let (n, [c1, c2]) = (j.plane(), j.channels);
    dx.par_chunks_exact_mut(n).enumerate().for_each(|(i, dx)| {
        dx.copy_from_slice(&dy[(i / c1 * (c1 + c2) + i % c1) * n..][..n]);
    });
}

/// The coarse map's gradient.
pub fn backward_coarse(j: &Join, dy: &[f32], dx: &mut [f32]) {
    let (n, [c1, c2], s, w) = (j.plane(), j.channels, j.repeat, j.size[1]);
    dx.par_chunks_exact_mut(n / (s * s)).enumerate().for_each(|(i, dx)| {
        let dy = &dy[(i / c2 * (c1 + c2) + c1 + i % c2) * n..][..n];
        if s == 1 {
            return dx.copy_from_slice(dy);
        }
        dx.fill(0.0);
        for (dx, dy) in dx.chunks_exact_mut(w / s).zip(dy.chunks_exact(s * w)) {
            for row in dy.chunks_exact(w) {
                for (dx, dy) in dx.iter_mut().zip(row.chunks_exact(s)) {
                    *dx += dy.iter().sum::<f32>();
                }
            }
        }
    });
}
