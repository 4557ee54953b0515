//! Bilinear resize with corner pixels on corner pixels (`align_corners = true`) and
//! nearest upsampling by a whole factor, with their transposes (the gradients).

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

/// `[planes, h, w]` to `[planes, H, W]`.
pub fn bilinear(r: &Resize, x: &[f32], y: &mut [f32]) {
    let ([h, w], [to_h, to_w]) = (r.from, r.to);
    let (rows, cols) = (taps(h, to_h), taps(w, to_w));
    let planes = x.par_chunks_exact(h * w).zip(y.par_chunks_exact_mut(to_h * to_w));
    planes.for_each_init(
        || vec![0f32; w],
        |mixed, (x, y)| {
            for (y, &(top, bottom, f)) in y.chunks_exact_mut(to_w).zip(&rows) {
                let (a, b) = (&x[top * w..(top + 1) * w], &x[bottom * w..(bottom + 1) * w]);
                for ((m, a), b) in mixed.iter_mut().zip(a).zip(b) {
                    *m = (1.0 - f) * a + f * b;
                }
                for (y, &(left, right, f)) in y.iter_mut().zip(&cols) {
                    *y = (1.0 - f) * mixed[left] + f * mixed[right];
                }
            }
        },
    );
}

/// The transpose of [`bilinear`]: `[planes, H, W]` to `[planes, h, w]`, overwritten.
pub fn bilinear_transposed(r: &Resize, dy: &[f32], dx: &mut [f32]) {
    let ([h, w], [to_h, to_w]) = (r.from, r.to);
    let (rows, cols) = (taps(h, to_h), taps(w, to_w));
    let planes = dx.par_chunks_exact_mut(h * w).zip(dy.par_chunks_exact(to_h * to_w));
    planes.for_each_init(
        || vec![0f32; w],
        |mixed, (dx, dy)| {
            dx.fill(0.0);
            for (dy, &(top, bottom, f)) in dy.chunks_exact(to_w).zip(&rows) {
                mixed.fill(0.0);
                for (dy, &(left, right, f)) in dy.iter().zip(&cols) {
                    mixed[left] += (1.0 - f) * dy;
                    mixed[right] += f * dy;
                }
                for (i, m) in mixed.iter().enumerate() {
                    dx[top * w + i] += (1.0 - f) * m;
                    dx[bottom * w + i] += f * m;
                }
            }
        },
    );
}

/// Every pixel repeated `s` × `s` times; `to` = `s`·`from`.
pub fn nearest(r: &Resize, s: usize, x: &[f32], y: &mut [f32]) {
    let ([h, w], [to_h, to_w]) = (r.from, r.to);
    x.par_chunks_exact(h * w).zip(y.par_chunks_exact_mut(to_h * to_w)).for_each(|(x, y)| {
        for (x, y) in x.chunks_exact(w).zip(y.chunks_exact_mut(s * to_w)) {
            for row in y.chunks_exact_mut(to_w) {
                for (x, y) in x.iter().zip(row.chunks_exact_mut(s)) {
                    y.fill(*x);
                }
            }
        }
    });
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
