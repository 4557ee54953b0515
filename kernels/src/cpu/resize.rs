//! Bilinear resize with corner pixels on corner pixels (`align_corners = true`) and
//! nearest upsampling by a whole factor, with their transposes (the gradients).

use super::activation::{self, Activation};
use super::join::repeat;
use super::simd::vectorize;
use super::uninit::{UninitBuffer, zeroed};
use rayon::prelude::*;

/// Sizes of one resize of planes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Resize {
    /// Height and width of the input.
    pub from: [usize; 2],
    /// Height and width of the output.
    pub to: [usize; 2],
}

/// For each output index: the left input index, the right one, and the right one's
/// weight.
fn taps(from: usize, to: usize) -> Vec<(usize, usize, f32)> {
    let step = if to > 1 { (from - 1) as f64 / (to - 1) as f64 } else { 0.0 };
    (0..to)
        .map(|i| {
            let at = i as f64 * step;
            let left = (at as usize).min(from - 1);
            (left, (left + 1).min(from - 1), (at - left as f64) as f32)
        })
        .collect()
}

/// Bilinear interpolation of one plane at a time.
pub(crate) struct Bilinear {
    rows: Vec<(usize, usize, f32)>,
    cols: Vec<(usize, usize, f32)>,
    from: [usize; 2],
    to: [usize; 2],
}

impl Bilinear {
    pub(crate) fn new(r: &Resize) -> Self {
        let ([h, w], [to_h, to_w]) = (r.from, r.to);
        Self { rows: taps(h, to_h), cols: taps(w, to_w), from: r.from, to: r.to }
    }

    /// Resizes `[h, w]` to `[H, W]`. The first pass widens the few input rows, so that the
    /// second one works on whole rows. `wide` is working memory.
    pub(crate) fn plane(&self, x: &[f32], y: &mut [f32], wide: &mut Vec<f32>) {
        let (w, to_w) = (self.from[1], self.to[1]);
        wide.resize(self.from[0] * to_w, 0.0);
        for (x, wide) in x.chunks_exact(w).zip(wide.chunks_exact_mut(to_w)) {
            for (o, &(left, right, f)) in wide.iter_mut().zip(&self.cols) {
                *o = (1.0 - f) * x[left] + f * x[right];
            }
        }
        vectorize(
            #[inline(always)]
            || {
                for (y, &(top, bottom, f)) in y.chunks_exact_mut(to_w).zip(&self.rows) {
                    let (a, b) = (&wide[top * to_w..][..to_w], &wide[bottom * to_w..][..to_w]);
                    for ((y, a), b) in y.iter_mut().zip(a).zip(b) {
                        *y = (1.0 - f) * a + f * b;
                    }
                }
            },
        );
    }

    /// The transpose of [`Bilinear::plane`]; `dx` is overwritten.
    pub(crate) fn transposed(&self, dy: &[f32], dx: &mut [f32], wide: &mut Vec<f32>) {
        let (w, to_w) = (self.from[1], self.to[1]);
        wide.clear();
        wide.resize(self.from[0] * to_w, 0.0);
        vectorize(
            #[inline(always)]
            || {
                for (dy, &(top, bottom, f)) in dy.chunks_exact(to_w).zip(&self.rows) {
                    for (row, share) in [(top, 1.0 - f), (bottom, f)] {
                        for (o, dy) in wide[row * to_w..][..to_w].iter_mut().zip(dy) {
                            *o += share * dy;
                        }
                    }
                }
            },
        );
        dx.fill(0.0);
        for (dx, wide) in dx.chunks_exact_mut(w).zip(wide.chunks_exact(to_w)) {
            for (v, &(left, right, f)) in wide.iter().zip(&self.cols) {
                dx[left] += (1.0 - f) * v;
                dx[right] += f * v;
            }
        }
    }
}

/// f of [`bilinear`] in one pass, new memory.
pub fn bilinear_then(r: &Resize, kind: Activation, x: &[f32]) -> Vec<f32> {
    planes(r, x, |y| activation::in_place(kind, y))
}

/// Every plane resized, then `f` of it.
fn planes(r: &Resize, x: &[f32], f: impl Fn(&mut [f32]) + Sync) -> Vec<f32> {
    let one = Bilinear::new(r);
    let (from, to) = (r.from[0] * r.from[1], r.to[0] * r.to[1]);
    let mut buffer = UninitBuffer::new(x.len() / from * to);
    let planes = x.par_chunks_exact(from).zip(buffer.par_chunks_mut(to));
    planes.for_each_init(Vec::new, |wide, (x, y)| {
        let y = zeroed(y);
        one.plane(x, y, wide);
        f(y);
    });
    // SAFETY: the loop above initialised every block: there is one for each plane of `x`.
    unsafe { buffer.assume_init() }
}

/// The gradient of [`bilinear_then`], `dx` overwritten.
pub fn bilinear_then_backward(r: &Resize, kind: Activation, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    let one = Bilinear::new(r);
    let n = r.to[0] * r.to[1];
    let planes = x.par_chunks_exact(r.from[0] * r.from[1]).zip(dy.par_chunks_exact(n));
    let planes = planes.zip(dx.par_chunks_exact_mut(r.from[0] * r.from[1]));
    planes.for_each_init(
        || (Vec::new(), vec![0f32; n]),
        |(wide, y), ((x, dy), dx)| {
            one.plane(x, y, wide);
            activation::slopes_in_place(kind, y, dy);
            one.transposed(y, dx, wide);
        },
    );
}

/// `[planes, h, w]` to `[planes, H, W]`, new memory.
pub fn bilinear(r: &Resize, x: &[f32]) -> Vec<f32> {
    planes(r, x, |_| ())
}

/// The transpose of [`bilinear`]: `[planes, H, W]` to `[planes, h, w]`, overwritten.
pub fn bilinear_transposed(r: &Resize, dy: &[f32], dx: &mut [f32]) {
    let one = Bilinear::new(r);
    let planes = dx.par_chunks_exact_mut(r.from[0] * r.from[1]);
    planes
        .zip(dy.par_chunks_exact(r.to[0] * r.to[1]))
        .for_each_init(Vec::new, |wide, (dx, dy)| one.transposed(dy, dx, wide));
}

/// Every pixel repeated `s` × `s` times, new memory; `to` = `s`·`from`.
pub fn nearest(r: &Resize, s: usize, x: &[f32]) -> Vec<f32> {
    let ([h, w], [to_h, to_w]) = (r.from, r.to);
    let mut buffer = UninitBuffer::new(x.len() / (h * w) * to_h * to_w);
    let planes = x.par_chunks_exact(h * w).zip(buffer.par_chunks_mut(to_h * to_w));
    planes.for_each(|(x, y)| repeat(x, to_w, s, y));
    // SAFETY: the loop above wrote every block: there is one for each plane of `x`, and
    // `repeat` panics where it does not write all of one.
    unsafe { buffer.assume_init() }
}

/// The transpose of [`nearest`]: sums of `s` × `s` blocks, `dx` overwritten.
pub fn nearest_transposed(r: &Resize, s: usize, dy: &[f32], dx: &mut [f32]) {
    let ([h, w], [to_h, to_w]) = (r.from, r.to);
    dx.par_chunks_exact_mut(h * w).zip(dy.par_chunks_exact(to_h * to_w)).for_each(|(dx, dy)| {
        dx.fill(0.0);
        for (dx, dy) in dx.chunks_exact_mut(w).zip(dy.chunks_exact(s * to_w)) {
            for row in dy.chunks_exact(to_w) {
                for (dx, dy) in dx.iter_mut().zip(row.chunks_exact(s)) {
                    *dx += dy.iter().sum::<f32>();
                }
            }
        }
    });
}
