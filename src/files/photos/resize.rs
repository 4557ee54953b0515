//! Resampling of 8-bit pictures, bit for bit equal to Pillow's `Image.resize`.
//!
//! The published evaluation protocol resizes with PIL's LANCZOS on uint8 (MVSplat's crop
//! shim); scores are comparable only for the same input. The algorithm is that of Pillow's
//! `Resample.c` (8 bits per channel): a separable filter whose support grows with the
//! reduction (antialiasing), weights normalised in f64 and rounded to 22 fractional bits, a
//! horizontal pass rounded to 8 bits, and a vertical pass.
//!
//! Tests: tests/scenes/resize.rs with tests/goldens/resize.txt (tools/make_resize_golden.py).

use crate::scene::pictures::Rgb;
use rayon::prelude::*;

/// Fractional bits of the weights (Pillow's `PRECISION_BITS`, 32 − 8 − 2).
const PRECISION_BITS: u32 = 22;

/// Resampling filter, Pillow's names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Filter {
    /// Mean over the pixel's footprint.
    Box,
    /// Triangle, support 1.
    Bilinear,
    /// Cubic convolution with a = −½, support 2.
    Bicubic,
    /// Windowed sinc, support 3; the filter of the evaluation protocol.
    #[default]
    Lanczos,
}

impl Filter {
    /// Returns the half width in source pixels at a scale of 1.
    fn support(self) -> f64 {
        match self {
            Self::Box => 0.5,
            Self::Bilinear => 1.0,
            Self::Bicubic => 2.0,
            Self::Lanczos => 3.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        const A: f64 = -0.5;
        let a = x.abs();
        match self {
            Self::Box => f64::from(u8::from(x > -0.5 && x <= 0.5)),
            Self::Bilinear => (1.0 - a).max(0.0),
            Self::Bicubic if a < 1.0 => ((A + 2.0) * a - (A + 3.0)) * a * a + 1.0,
            Self::Bicubic if a < 2.0 => (((a - 5.0) * a + 8.0) * a - 4.0) * A,
            Self::Lanczos if (-3.0..3.0).contains(&x) => sinc(x) * sinc(x / 3.0),
            Self::Bicubic | Self::Lanczos => 0.0,
        }
    }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        return 1.0;
    }
    let x = x * std::f64::consts::PI;
    x.sin() / x
}

/// Source pixels and weights of one output pixel.
struct Taps {
    first: usize,
    /// Weights, in units of 2⁻²².
    weights: Vec<i32>,
}

/// Computes the taps of the output pixels `from .. from + count` of a line resampled from
/// `source` to `target` pixels.
fn taps(source: usize, target: usize, from: usize, count: usize, filter: Filter) -> Vec<Taps> {
    let scale = source as f64 / target as f64;
    let filter_scale = scale.max(1.0);
    let support = filter.support() * filter_scale;
    (from..from + count)
        .map(|i| {
            let center = (i as f64 + 0.5) * scale;
            // `as usize` truncates and maps negative values to 0, as Pillow does.
            let first = (center - support + 0.5) as usize;
            let end = ((center + support + 0.5) as usize).min(source);
            let mut weights: Vec<f64> = (first..end)
                .map(|x| filter.weight((x as f64 - center + 0.5) * (1.0 / filter_scale)))
                .collect();
            let sum: f64 = weights.iter().sum();
            if sum != 0.0 {
                weights.iter_mut().for_each(|w| *w /= sum);
            }
            let fixed = |w: f64| {
                let scaled = w * f64::from(1u32 << PRECISION_BITS);
                // Rounds half away from zero.
                (scaled + if w < 0.0 { -0.5 } else { 0.5 }) as i32
            };
            Taps { first, weights: weights.into_iter().map(fixed).collect() }
        })
        .collect()
}

fn clip(sum: i32) -> u8 {
    (sum >> PRECISION_BITS).clamp(0, 255) as u8
}

/// Resamples a picture to `width` × `height`, which must not be zero.
pub fn resize(picture: &Rgb, width: usize, height: usize, filter: Filter) -> Rgb {
    let size = [width, height];
    resize_window(picture, &Window { full: size, origin: [0, 0], size }, filter)
}

/// A window of a resampled picture; (x, y), px.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Size of the whole resampled picture.
    pub full: [usize; 2],
    /// Corner of the window.
    pub origin: [usize; 2],
    /// Size of the window, which must lie inside `full`.
    pub size: [usize; 2],
}

/// Computes a window of a resampled picture. The numbers are those of [`resize`] and a crop;
/// pixels outside the window are not computed. An empty source gives black.
pub fn resize_window(picture: &Rgb, window: &Window, filter: Filter) -> Rgb {
    let Window { full, origin, size } = *window;
    debug_assert!((0..2).all(|axis| origin[axis] + size[axis] <= full[axis]));
    let mut out = Rgb::black(size[0], size[1]);
    if picture.data.is_empty() || out.data.is_empty() {
        return out;
    }
    let columns = taps(picture.width, full[0], origin[0], size[0], filter);
    let rows = taps(picture.height, full[1], origin[1], size[1], filter);
    // The horizontal pass computes the rows that the vertical pass reads.
    let top = rows.iter().map(|t| t.first).min().unwrap_or(0);
    let bottom = rows.iter().map(|t| t.first + t.weights.len()).max().unwrap_or(0);
    let stride = 3 * size[0];

    let half = 1i32 << (PRECISION_BITS - 1);

    let mut between = vec![0u8; stride * (bottom - top)];
    between.par_chunks_mut(stride).enumerate().for_each(|(y, line)| {
        let source = &picture.data[3 * picture.width * (y + top)..][..3 * picture.width];
        for (pixel, tap) in line.chunks_exact_mut(3).zip(&columns) {
            let mut sum = [half; 3];
            for (p, &w) in source[3 * tap.first..].chunks_exact(3).zip(&tap.weights) {
                for c in 0..3 {
                    sum[c] += i32::from(p[c]) * w;
                }
            }
            pixel.copy_from_slice(&sum.map(clip));
        }
    });
    out.data.par_chunks_mut(stride).zip(&rows).for_each(|(line, tap)| {
        let mut sums = vec![half; stride];
        let source = between[stride * (tap.first - top)..].chunks_exact(stride);
        for (row, &w) in source.zip(&tap.weights) {
            for (sum, &v) in sums.iter_mut().zip(row) {
                *sum += i32::from(v) * w;
            }
        }
        for (v, sum) in line.iter_mut().zip(sums) {
            *v = clip(sum);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: usize, height: usize) -> Rgb {
        let mut state = 12345u32;
        let data = (0..width * height * 3)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        Rgb { width, height, data }
    }

    #[test]
    fn same_size_is_the_same_picture() {
        let p = noise(13, 9);
        for f in [Filter::Box, Filter::Bilinear, Filter::Bicubic, Filter::Lanczos] {
            assert_eq!(resize(&p, 13, 9, f), p);
        }
    }

    #[test]
    fn a_window_is_a_crop_of_the_whole() {
        let p = noise(61, 47);
        for (w, h) in [(23, 19), (90, 100)] {
            let whole = resize(&p, w, h, Filter::Lanczos);
            let place = Window { full: [w, h], origin: [5, 3], size: [11, 13] };
            let window = resize_window(&p, &place, Filter::Lanczos);
            assert_eq!(window, whole.window(5, 3, 11, 13).unwrap());
        }
    }

    #[test]
    fn box_by_an_integer_is_the_mean() {
        let p = noise(8, 8);
        let half = resize(&p, 4, 8, Filter::Box);
        for y in 0..8 {
            for x in 0..4 {
                let at = |x: usize| u32::from(p.data[3 * (y * 8 + x)]);
                let mean = (at(2 * x) + at(2 * x + 1)).div_ceil(2);
                assert_eq!(u32::from(half.data[3 * (y * 4 + x)]), mean);
            }
        }
    }
}
