//! Channels of each pixel to unit length: y = x / √(Σ_c x² + ε), `[B, C, n]`.

use crate::cpu::simd::vectorize;
use rayon::prelude::*;

/// ε under the root.
const EPS: f32 = 1e-8;
/// Pixels at a time.
const PIXELS: usize = 256;

/// 1 / length of up to [`PIXELS`] pixels from `at`.
#[inline(always)]
fn inverse(channels: usize, n: usize, x: &[f32], at: usize, out: &mut [f32]) {
    out.fill(EPS);
    for c in 0..channels {
        let row = &x[c * n + at..][..out.len()];
        out.iter_mut().zip(row).for_each(|(sum, v)| *sum += v * v);
    }
    out.iter_mut().for_each(|v| *v = 1.0 / v.sqrt());
}

/// y from x.
pub fn forward(channels: usize, n: usize, x: &[f32], y: &mut [f32]) {
    let maps = x.par_chunks_exact(channels * n).zip(y.par_chunks_exact_mut(channels * n));
    maps.for_each(|(x, y)| {
        vectorize(
            #[inline(always)]
            || {
                let mut scale = [0f32; PIXELS];
                for at in (0..n).step_by(PIXELS) {
                    let scale = &mut scale[..PIXELS.min(n - at)];
                    inverse(channels, n, x, at, scale);
                    for c in 0..channels {
                        let from = c * n + at;
                        let to = c * n + at + scale.len();
                        for ((y, x), s) in y[from..to].iter_mut().zip(&x[from..to]).zip(&*scale) {
                            *y = x * s;
                        }
                    }
                }
            },
        );
    });
}

/// dx = (dy − y·Σ_c y·dy) / length.
pub fn backward(channels: usize, n: usize, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    let maps = x.par_chunks_exact(channels * n).zip(dy.par_chunks_exact(channels * n));
    maps.zip(dx.par_chunks_exact_mut(channels * n)).for_each(|((x, dy), dx)| {
        vectorize(
            #[inline(always)]
            || {
                let (mut scale, mut along) = ([0f32; PIXELS], [0f32; PIXELS]);
                for at in (0..n).step_by(PIXELS) {
                    let count = PIXELS.min(n - at);
                    let (scale, along) = (&mut scale[..count], &mut along[..count]);
                    inverse(channels, n, x, at, scale);
                    along.fill(0.0);
                    for c in 0..channels {
                        let part = c * n + at..c * n + at + count;
                        for ((sum, x), g) in along.iter_mut().zip(&x[part.clone()]).zip(&dy[part]) {
                            *sum += x * g;
                        }
                    }
                    for c in 0..channels {
                        let part = c * n + at..c * n + at + count;
                        let sides = scale.iter().zip(&*along).zip(&x[part.clone()]);
                        let pairs = dx[part.clone()].iter_mut().zip(&dy[part]);
                        for ((dx, g), ((s, along), x)) in pairs.zip(sides) {
                            *dx = s * (g - x * along * s * s);
                        }
                    }
                }
            },
        );
    });
}
