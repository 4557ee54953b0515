//! Input and output of the two convolutions of the small backbone's heads.
//!
//! Before: `[B, C + 5, H, W]` of the projected features upsampled to the picture's size
//! (bilinear, corners aligned), the picture, disparity as a share of the largest
//! candidate, confidence. After: `[B, R + 1, H, W]` to raw rows `[B, H·W, R]` and an
//! opacity `[B, H·W]`.

use crate::cpu::activation::sigmoid;
use crate::cpu::gemm::Mat;
use crate::cpu::moves::Turn;
use crate::cpu::resize::{Bilinear, Resize};
use crate::cpu::simd::{SimdLevel, vectorize};
use rayon::prelude::*;

/// Channels of [`Input`] beside the features.
pub const BESIDE: usize = 5;
/// Pixels that are transposed at a time.
const PIXELS: usize = 32;
/// Channels that a task of the transposed transposition takes: a cache line.
const CHANNELS: usize = 16;

/// Sizes and factor of the input.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Input {
    /// C: channels of the features.
    pub channels: usize,
    /// Feature map and picture.
    pub resize: Resize,
    /// Factor of disparity (in candidate indices).
    pub share: f32,
}

impl Input {
    fn plane(&self) -> usize {
        self.resize.to[0] * self.resize.to[1]
    }

    /// Writes `y` from features `[B, C, h, w]`, `rgb` `[B, 3, H, W]`, `index` and
    /// `confidence` (a logit) `[B, H, W]`.
    pub fn forward(&self, features: &[f32], rgb: &[f32], sides: [&[f32]; 2], y: &mut [f32]) {
        let (n, c) = (self.plane(), self.channels);
        let small = self.resize.from[0] * self.resize.from[1];
        let up = Bilinear::new(&self.resize);
        y.par_chunks_exact_mut(n).enumerate().for_each_init(Vec::new, |wide, (i, y)| {
            let b = i / (c + BESIDE);
            let p = i % (c + BESIDE);
            match p.checked_sub(c) {
                None => up.plane(&features[(b * c + p) * small..][..small], y, wide),
                Some(k @ 0..3) => y.copy_from_slice(&rgb[(b * 3 + k) * n..][..n]),
                Some(3) => map(&sides[0][b * n..][..n], y, |v| v * self.share),
                Some(_) => map(&sides[1][b * n..][..n], y, sigmoid),
            }
        });
    }

    /// Gradients of features, index and confidence.
    pub fn backward(&self, confidence: &[f32], dy: &[f32]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let (n, c) = (self.plane(), self.channels);
        let small = self.resize.from[0] * self.resize.from[1];
        let batch = confidence.len() / n.max(1);
        let up = Bilinear::new(&self.resize);
        let mut features = vec![0f32; batch * c * small];
        let planes = features.par_chunks_exact_mut(small.max(1)).enumerate();
        planes.for_each_init(Vec::new, |wide, (i, dx)| {
            let (b, p) = (i / c, i % c);
            up.transposed(&dy[(b * (c + BESIDE) + p) * n..][..n], dx, wide);
        });
        let side = |k: usize, b: usize| &dy[(b * (c + BESIDE) + c + k) * n..][..n];
        let mut index = vec![0f32; batch * n];
        index.par_chunks_exact_mut(n).enumerate().for_each(|(b, dx)| {
            map(side(3, b), dx, |v| v * self.share);
        });
        let mut d_confidence = vec![0f32; batch * n];
        d_confidence.par_chunks_exact_mut(n).enumerate().for_each(|(b, dx)| {
            let x = &confidence[b * n..(b + 1) * n];
            vectorize(
                #[inline(always)]
                || {
                    for ((dx, x), dy) in dx.iter_mut().zip(x).zip(side(4, b)) {
                        let s = sigmoid(*x);
                        *dx = dy * s * (1.0 - s);
                    }
                },
            );
        });
        (features, index, d_confidence)
    }
}

#[inline(always)]
fn map(x: &[f32], y: &mut [f32], f: impl Fn(f32) -> f32) {
    vectorize(
        #[inline(always)]
        || {
            for (y, x) in y.iter_mut().zip(x) {
                *y = f(*x);
            }
        },
    );
}

/// Sizes and rules of the output.
#[derive(Clone, Debug, PartialEq)]
pub struct Output {
    /// R: numbers of a raw row; the last channel of the convolution's output is the
    /// opacity's.
    pub raw: usize,
    /// H, W.
    pub size: [usize; 2],
    /// `[R]`: added to every raw row.
    pub start: Vec<f32>,
    /// Offsets in a row that the pixel's own colour is added to, and factor and offset of the
    /// colour in [0, 1].
    pub colour: Option<([usize; 3], f32, f32)>,
    /// Opacity is σ(confidence + residual)²; else σ(residual + 2).
    pub confident: bool,
}

impl Output {
    fn plane(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Raw rows from the convolution's output `x` and the picture.
    pub fn raw(&self, x: &[f32], rgb: &[f32], raw: &mut [f32]) {
        let (n, r, [h, w]) = (self.plane(), self.raw, self.size);
        raw.par_chunks_exact_mut(r * w).enumerate().for_each(|(i, rows)| {
            let (b, y) = (i / h, i % h);
            for (j, rows) in rows.chunks_mut(PIXELS * r).enumerate() {
                let at = y * w + j * PIXELS;
                let count = rows.len() / r;
                let data = &x[b * (r + 1) * n + at..];
                let from = Mat { data, rows: count, cols: r, row_stride: 1, col_stride: n };
                SimdLevel::best().run(Turn { from, to: rows });
                for row in rows.chunks_exact_mut(r) {
                    row.iter_mut().zip(&self.start).for_each(|(v, start)| *v += start);
                }
                let Some((places, factor, offset)) = self.colour else { continue };
                for (k, place) in places.into_iter().enumerate() {
                    let colours = &rgb[(b * 3 + k) * n + at..][..count];
                    for (x, v) in colours.iter().zip(rows.iter_mut().skip(place).step_by(r)) {
                        *v += factor * x + offset;
                    }
                }
            }
        });
    }

    /// Opacities `[B, H·W]` from the convolution's output and `confidence` (a logit).
    pub fn opacity(&self, x: &[f32], confidence: &[f32], y: &mut [f32]) {
        let (n, r) = (self.plane(), self.raw);
        y.par_chunks_exact_mut(n).enumerate().for_each(|(b, y)| {
            let x = &x[(b * (r + 1) + r) * n..][..n];
            let c = &confidence[b * n..][..n];
            vectorize(
                #[inline(always)]
                || {
                    for ((y, x), c) in y.iter_mut().zip(x).zip(c) {
                        let s = sigmoid(if self.confident { c + x } else { x + 2.0 });
                        *y = if self.confident { s * s } else { s };
                    }
                },
            );
        });
    }

    /// Gradients of the convolution's output and of confidence, for those of opacity
    /// `[B, H·W]` and, if there are any, of the raw rows.
    pub fn backward(
        &self,
        x: &[f32],
        confidence: &[f32],
        d_opacity: &[f32],
        d_raw: Option<&[f32]>,
    ) -> (Vec<f32>, Vec<f32>) {
        let (n, r) = (self.plane(), self.raw);
        let mut d_logit = vec![0f32; d_opacity.len()];
        d_logit.par_chunks_exact_mut(n).enumerate().for_each(|(b, d)| {
            let x = &x[(b * (r + 1) + r) * n..][..n];
            let c = &confidence[b * n..][..n];
            let g = &d_opacity[b * n..][..n];
            vectorize(
                #[inline(always)]
                || {
                    for (((d, x), c), g) in d.iter_mut().zip(x).zip(c).zip(g) {
                        let s = sigmoid(if self.confident { c + x } else { x + 2.0 });
                        *d = g * s * (1.0 - s) * if self.confident { 2.0 * s } else { 1.0 };
                    }
                },
            );
        });
        let mut dx = vec![0f32; x.len()];
        dx.par_chunks_exact_mut((r + 1) * n).enumerate().for_each(|(b, dx)| {
            dx.par_chunks_mut(CHANNELS * n).enumerate().for_each(|(i, planes)| {
                let first = i * CHANNELS;
                let count = (planes.len() / n).min(r - first.min(r));
                if let Some(d_raw) = d_raw {
                    let rows = &d_raw[b * n * r..(b + 1) * n * r];
                    transpose(rows, r, first, &mut planes[..count * n], n);
                }
                if let Some(last) = planes.chunks_exact_mut(n).nth(r.saturating_sub(first))
                    && first <= r
                {
                    last.copy_from_slice(&d_logit[b * n..][..n]);
                }
            });
        });
        let d_confidence = if self.confident { d_logit } else { vec![0.0; d_logit.len()] };
        (dx, d_confidence)
    }
}

/// Columns from `first` of `rows` `[n, r]` as planes of `n`.
fn transpose(rows: &[f32], r: usize, first: usize, planes: &mut [f32], n: usize) {
    let count = planes.len() / n;
    if count == CHANNELS {
        let data = &rows[first..];
        let from = Mat { data, rows: count, cols: n, row_stride: 1, col_stride: r };
        return SimdLevel::best().run(Turn { from, to: planes });
    }
    for at in (0..n).step_by(PIXELS) {
        let count = PIXELS.min(n - at);
        for (c, plane) in planes.chunks_exact_mut(n).enumerate() {
            let column = rows[at * r + first + c..].iter().step_by(r);
            for (to, from) in plane[at..at + count].iter_mut().zip(column) {
                *to = *from;
            }
        }
    }
}

/// Depth candidates, uniform in disparity (1 / camera z).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidates {
    /// Disparity of candidate 0, the farthest.
    pub low: f32,
    /// Difference between successive candidates.
    pub step: f32,
}

/// Distance along the unit ray of candidate indices: length / (low + step·index), for
/// each of `ranges` one map of `n` pixels.
pub fn distance(ranges: &[Candidates], lengths: &[f32], index: &[f32], out: &mut [f32]) {
    let n = index.len() / ranges.len().max(1);
    let maps = out.par_chunks_exact_mut(n.max(1)).zip(ranges).enumerate();
    maps.for_each(|(b, (out, &Candidates { low, step }))| {
        let (lengths, index) = (&lengths[b * n..][..n], &index[b * n..][..n]);
        for ((out, length), i) in out.iter_mut().zip(lengths).zip(index) {
            *out = length / (low + step * i);
        }
    });
}

/// Gradient of [`distance`] with respect to `index`.
pub fn distance_backward(
    ranges: &[Candidates],
    lengths: &[f32],
    index: &[f32],
    grad: &[f32],
) -> Vec<f32> {
    let n = index.len() / ranges.len().max(1);
    let mut out = vec![0f32; index.len()];
    let maps = out.par_chunks_exact_mut(n.max(1)).zip(ranges).enumerate();
    maps.for_each(|(b, (out, &Candidates { low, step }))| {
        let (lengths, index) = (&lengths[b * n..][..n], &index[b * n..][..n]);
        let values = lengths.iter().zip(index).zip(&grad[b * n..][..n]);
        for (out, ((length, i), g)) in out.iter_mut().zip(values) {
            let disparity = low + step * i;
            *out = -g * length * step / (disparity * disparity);
        }
    });
    out
}
