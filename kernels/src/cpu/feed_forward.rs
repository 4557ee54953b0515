//! A transformer's feed-forward block with its residual, block of rows by block of
//! rows, forward only: the hidden layer never leaves a core's second-level cache.
//!
//! ```text
//! y = x + LayerNorm(GELU([x ; m]·W₁ᵀ)·W₂ᵀ)
//! ```
//! Calls with gradients run the block as single ops, `model::backbone::transformer`. The tests of
//! ops/feed_forward.rs compare the two.

use super::activation::{Activation, in_place};
use super::gemm::{Base, Mat, Packed, product};
use super::norm::{self, Rows};
use super::simd::LANES;
use super::uninit::{UninitBuffer, as_uninit, zeroed};
use rayon::prelude::*;

/// Rows of a task: 96 · 1024 hidden floats are 384 KiB.
const BLOCK: usize = 96;

/// Parameters, all row-major.
#[derive(Clone, Copy)]
pub struct FeedForward<'a> {
    /// W₁ `[H, 2C]`.
    pub up: &'a [f32],
    /// W₂ `[C, H]`.
    pub down: &'a [f32],
    /// LayerNorm's scale and shift, `[C]` each.
    pub norm: [&'a [f32]; 2],
    /// LayerNorm's ε.
    pub eps: f32,
    /// C.
    pub width: usize,
    /// H.
    pub hidden: usize,
}

/// y `[N, C]` of x and m, `[N, C]` each.
pub fn forward(f: &FeedForward<'_>, x: &[f32], message: &[f32]) -> Vec<f32> {
    let (c, h) = (f.width, f.hidden);
    let own = Mat { data: f.up, rows: h, cols: c, row_stride: 2 * c, col_stride: 1 };
    let theirs = Mat { data: f.up.get(c..).unwrap_or(&[]), ..own };
    let up = [Packed::new(own.t()), Packed::new(theirs.t())];
    let down = Packed::new(Mat::new(f.down, c, h, h).t());
    let rows = Rows { len: c, run: 1, groups: 1, eps: f.eps, activation: None };
    // Off the powers of two, at which rows lie in one another's cache lines.
    let pitch = h + LANES;
    let mut buffer = UninitBuffer::new(x.len());
    let size = BLOCK * c.max(1);
    let blocks = buffer.par_chunks_mut(size).zip(x.par_chunks(size)).zip(message.par_chunks(size));
    blocks.for_each_init(
        || (Vec::new(), Vec::new()),
        |(hidden, narrow), ((block, x), message)| {
            let (y, n) = (zeroed(block), x.len() / c);
            hidden.resize(n * pitch, 0.0);
            narrow.resize(n * c, 0.0);
            product((hidden, pitch), Mat::new(x, n, c, c), &up[0], 1.0, Base::Zero);
            product((hidden, pitch), Mat::new(message, n, c, c), &up[1], 1.0, Base::Own);
            in_place(Activation::Gelu, hidden);
            product((narrow, c), Mat::new(hidden, n, h, pitch), &down, 1.0, Base::Zero);
            // SAFETY: `forward_to` writes numbers.
            norm::forward_to(&rows, narrow, f.norm[0], f.norm[1], unsafe { as_uninit(y) });
            y.iter_mut().zip(x).for_each(|(y, x)| *y += x);
        },
    );
    // SAFETY: the loop above initialised every block.
    unsafe { buffer.assume_init() }
}
