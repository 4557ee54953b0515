//! PSNR and SSIM of two pictures by the protocol of MVSplat's and SubSplat's tables, and GMSD.
//!
//! Pictures are `[H, W, 3]`, row-major, RGB innermost, display values with 1 as white. Sums
//! are in f64. `tests/scenes/metrics.rs` compares with scikit-image. Imports nothing of the crate.

use rayon::prelude::*;
use thiserror::Error;

/// Side of the SSIM window, px: `win_size` of scikit-image.
pub const SSIM_WINDOW: usize = 11;
/// σ of the window's Gaussian, px; 3.5σ rounds to a radius of 5, the whole window.
const SSIM_SIGMA: f64 = 1.5;
/// Rows and columns at the border that are left out of the mean, px.
const SSIM_BORDER: usize = SSIM_WINDOW / 2;
/// (K1·L)² and (K2·L)² (Wang et al. 2004) with K1 = 0.01, K2 = 0.03, L = 1.
pub(crate) const SSIM_C1: f64 = 0.01 * 0.01;
pub(crate) const SSIM_C2: f64 = 0.03 * 0.03;
/// n/(n − 1) for the n = 121 pixels of a window: sample covariance.
pub(crate) const SSIM_COVARIANCE: f64 = 121.0 / 120.0;

/// Reason for which two pictures are not compared.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum MetricsError {
    /// The length of a buffer does not match the size.
    #[error("picture {which}: expected {expected} values ({width}x{height} RGB), got {got}")]
    Length {
        /// `a` or `b`.
        which: &'static str,
        /// Width given, px.
        width: usize,
        /// Height given, px.
        height: usize,
        /// Values expected.
        expected: usize,
        /// Values found.
        got: usize,
    },
    /// The pictures have no pixels, or a side shorter than the SSIM window.
    #[error("pictures: expected at least {least}x{least} pixels, got {width}x{height}")]
    TooSmall {
        /// Shortest accepted side, px.
        least: usize,
        /// Width, px.
        width: usize,
        /// Height, px.
        height: usize,
    },
    /// A value is NaN or infinite.
    #[error("picture {which}: expected finite values, got {value} at column {x}, row {y}")]
    NotFinite {
        /// `a` or `b`.
        which: &'static str,
        /// Column of the first such pixel.
        x: usize,
        /// Its row.
        y: usize,
        /// `NaN`, `inf` or `-inf`.
        value: String,
    },
}

fn check(
    a: &[f32],
    b: &[f32],
    width: usize,
    height: usize,
    least: usize,
) -> Result<(), MetricsError> {
    if width < least || height < least {
        return Err(MetricsError::TooSmall { least, width, height });
    }
    let expected = width.saturating_mul(height).saturating_mul(3);
    for (which, picture) in [("a", a), ("b", b)] {
        if picture.len() != expected {
            let got = picture.len();
            return Err(MetricsError::Length { which, width, height, expected, got });
        }
        if let Some(i) = picture.iter().position(|v| !v.is_finite()) {
            let (x, y) = (i / 3 % width, i / 3 / width);
            return Err(MetricsError::NotFinite { which, x, y, value: picture[i].to_string() });
        }
    }
    Ok(())
}

/// Computes the peak signal-to-noise ratio, dB: −10·log₁₀ of the mean squared difference
/// over all pixels and channels. Both pictures are clipped to [0, 1] first.
///
/// Equal pictures give `f64::INFINITY`, which JSON cannot express; the writer of a report
/// handles it.
///
/// # Errors
/// Lengths that do not match `width`×`height`, no pixels, NaN or infinite values.
pub fn psnr(a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64, MetricsError> {
    check(a, b, width, height, 1)?;
    let row = |(a, b): (&[f32], &[f32])| -> f64 {
        let square = |(a, b): (&f32, &f32)| {
            let d = f64::from(a.clamp(0.0, 1.0)) - f64::from(b.clamp(0.0, 1.0));
            d * d
        };
        a.iter().zip(b).map(square).sum()
    };
    // The sum over rows is sequential: the same digits for any number of threads.
    let rows: Vec<f64> = a.par_chunks(width * 3).zip(b.par_chunks(width * 3)).map(row).collect();
    let mse = rows.iter().sum::<f64>() / a.len() as f64;
    Ok(-10.0 * mse.log10())
}

pub(crate) fn window() -> [f64; SSIM_WINDOW] {
    let mut taps = [0.0; SSIM_WINDOW];
    for (i, tap) in taps.iter_mut().enumerate() {
        let d = i as f64 - SSIM_BORDER as f64;
        *tap = (-0.5 * d * d / (SSIM_SIGMA * SSIM_SIGMA)).exp();
    }
    let sum: f64 = taps.iter().sum();
    taps.map(|t| t / sum)
}

/// Number of images that SSIM blurs: x, y, x², y², xy.
const MOMENTS: usize = 5;

/// Blurs the moments of one row of one channel horizontally: `[width − 10][MOMENTS]`, window
/// centres 5 … width − 6.
fn blur_row(a: &[f32], b: &[f32], channel: usize, taps: &[f64; SSIM_WINDOW]) -> Vec<[f64; 5]> {
    let width = a.len() / 3;
    let moments: Vec<[f64; MOMENTS]> = (0..width)
        .map(|x| {
            let (p, q) = (f64::from(a[x * 3 + channel]), f64::from(b[x * 3 + channel]));
            [p, q, p * p, q * q, p * q]
        })
        .collect();
    moments.windows(SSIM_WINDOW).map(|w| weighted(taps, w.iter())).collect()
}

fn weighted<'a>(
    taps: &[f64; SSIM_WINDOW],
    moments: impl Iterator<Item = &'a [f64; MOMENTS]>,
) -> [f64; MOMENTS] {
    let mut sum = [0.0; MOMENTS];
    for (tap, m) in taps.iter().zip(moments) {
        for (s, v) in sum.iter_mut().zip(m) {
            *s += tap * v;
        }
    }
    sum
}

fn ssim_at([ux, uy, uxx, uyy, uxy]: [f64; MOMENTS]) -> f64 {
    let vx = SSIM_COVARIANCE * (uxx - ux * ux);
    let vy = SSIM_COVARIANCE * (uyy - uy * uy);
    let vxy = SSIM_COVARIANCE * (uxy - ux * uy);
    let structure = (2.0 * ux * uy + SSIM_C1) * (2.0 * vxy + SSIM_C2);
    structure / ((ux * ux + uy * uy + SSIM_C1) * (vx + vy + SSIM_C2))
}

/// Computes the structural similarity of Wang et al. 2004: Gaussian σ = 1.5 on 11×11,
/// sample covariance, mean over the pixels at least 5 from the border and over the three
/// channels. Values are **not** clipped.
///
/// Equals `structural_similarity(win_size=11, gaussian_weights=True, channel_axis=2,
/// data_range=1)` of scikit-image. That function pads by reflection before the blur and
/// crops as many pixels after it; this one makes no padding.
///
/// # Errors
/// Lengths that do not match `width`×`height`, a side below 11, NaN or infinite values.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64, MetricsError> {
    check(a, b, width, height, SSIM_WINDOW)?;
    let taps = window();
    let stride = width * 3;
    let mut total = 0.0;
    for channel in 0..3 {
        let rows: Vec<Vec<[f64; MOMENTS]>> = a
            .par_chunks(stride)
            .zip(b.par_chunks(stride))
            .map(|(a, b)| blur_row(a, b, channel, &taps))
            .collect();
        let sums: Vec<f64> = rows
            .par_windows(SSIM_WINDOW)
            .map(|rows| {
                let centre = |x: usize| ssim_at(weighted(&taps, rows.iter().map(|r| &r[x])));
                (0..width - 2 * SSIM_BORDER).map(centre).sum()
            })
            .collect();
        total += sums.iter().sum::<f64>();
    }
    let counted = (width - 2 * SSIM_BORDER) * (height - 2 * SSIM_BORDER) * 3;
    Ok(total / counted as f64)
}

/// Computes the mean absolute difference of neighbouring pixels over both directions and the
/// three channels, a measure of sharpness. The picture is clipped to [0, 1] first.
///
/// # Errors
/// A length that does not match `width`×`height`, a side below 2, NaN or infinite values.
pub fn mean_gradient(picture: &[f32], width: usize, height: usize) -> Result<f64, MetricsError> {
    check(picture, picture, width, height, 2)?;
    let stride = width * 3;
    let apart = |(a, b): (&f32, &f32)| f64::from((a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).abs());
    let sum = |a: &[f32], b: &[f32]| a.iter().zip(b).map(apart).sum::<f64>();
    let rows = |y: usize| {
        let row = &picture[y * stride..][..stride];
        let below = picture.get((y + 1) * stride..).map_or(&[][..], |rest| rest);
        sum(row, &row[3..]) + sum(row, below)
    };
    let total: f64 = (0..height).into_par_iter().map(rows).collect::<Vec<_>>().iter().sum();
    let pairs = 3 * ((width - 1) * height + width * (height - 1));
    Ok(total / pairs as f64)
}

/// T of GMSD (Xue et al. 2014: 170 for values up to 255), for display values up to 1.
const GMSD_T: f64 = 170.0 / (255.0 * 255.0);

/// Computes the gradient magnitude similarity deviation of Xue et al. 2014 (IEEE TIP 23(2)): 0 for
/// equal pictures, larger for worse ones. Blur raises it where it hardly lowers PSNR.
///
/// As in the paper: luminance (BT.601 weights, as the reference code's grey images), 2×2 means at
/// every second pixel, Prewitt gradients over 3, T = 170/255², standard deviation of the similarity.
/// The border of one reduced pixel, where the gradient has no neighbours, is left out. The pictures
/// are clipped to [0, 1] first.
///
/// # Errors
/// Lengths that do not match `width`×`height`, a side below 6, NaN or infinite values.
pub fn gmsd(a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64, MetricsError> {
    check(a, b, width, height, 6)?;
    let (w, h) = (width / 2, height / 2);
    let reduced = |picture: &[f32]| -> Vec<f64> {
        let luminance = |x: usize, y: usize| {
            let px = &picture[3 * (y * width + x)..][..3];
            let [r, g, b] = [0, 1, 2].map(|c| f64::from(px[c].clamp(0.0, 1.0)));
            0.299 * r + 0.587 * g + 0.114 * b
        };
        let mean = |i: usize| {
            let (x, y) = (2 * (i % w), 2 * (i / w));
            let sum = luminance(x, y) + luminance(x + 1, y);
            (sum + luminance(x, y + 1) + luminance(x + 1, y + 1)) / 4.0
        };
        (0..w * h).map(mean).collect()
    };
    let magnitude = |grey: &[f64], x: usize, y: usize| {
        let at = |dx: usize, dy: usize| grey[(y + dy - 1) * w + x + dx - 1];
        let across: f64 = (0..3).map(|i| at(0, i) - at(2, i)).sum();
        let down: f64 = (0..3).map(|i| at(i, 0) - at(i, 2)).sum();
        across.hypot(down) / 3.0
    };
    let (a, b) = (reduced(a), reduced(b));
    let similarity = |y: usize| {
        let a = &a;
        let b = &b;
        (1..w - 1).map(move |x| {
            let (p, q) = (magnitude(a, x, y), magnitude(b, x, y));
            (2.0 * p * q + GMSD_T) / (p * p + q * q + GMSD_T)
        })
    };
    let all: Vec<f64> = (1..h - 1).flat_map(similarity).collect();
    let mean = all.iter().sum::<f64>() / all.len() as f64;
    Ok((all.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / all.len() as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize, seed: u32) -> Vec<f32> {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32
        };
        (0..width * height * 3).map(|_| next()).collect()
    }

    #[test]
    fn psnr_of_a_constant_difference() {
        let a = vec![0.5; 12 * 11 * 3];
        let b = vec![0.6; 12 * 11 * 3];
        assert!((psnr(&a, &b, 12, 11).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&a, &a, 12, 11).unwrap(), f64::INFINITY);
    }

    #[test]
    fn psnr_clips_and_ssim_does_not() {
        let a = picture(16, 14, 1);
        let over: Vec<f32> = a.iter().map(|v| if *v > 0.5 { 1.0 } else { *v }).collect();
        let far: Vec<f32> = a.iter().map(|v| if *v > 0.5 { 1.7 } else { *v }).collect();
        let limited = psnr(&a, &over, 16, 14).unwrap();
        assert_eq!(limited, psnr(&a, &far, 16, 14).unwrap());
        assert_eq!(limited, psnr(&far, &a, 16, 14).unwrap());
        let (near, far) = (ssim(&a, &over, 16, 14).unwrap(), ssim(&a, &far, 16, 14).unwrap());
        assert!((near - far).abs() > 1e-3, "{near} {far}");
    }

    /// Straight from the definition, one 2-D window at a time.
    fn naive_ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
        let taps = window();
        let mut values = Vec::new();
        for c in 0..3 {
            for y in 5..height - 5 {
                for x in 5..width - 5 {
                    let mut m = [0.0; 5];
                    for dy in 0..11 {
                        for dx in 0..11 {
                            let i = ((y + dy - 5) * width + x + dx - 5) * 3 + c;
                            let (p, q) = (f64::from(a[i]), f64::from(b[i]));
                            for (s, v) in m.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                                *s += taps[dy] * taps[dx] * v;
                            }
                        }
                    }
                    values.push(ssim_at(m));
                }
            }
        }
        values.iter().sum::<f64>() / values.len() as f64
    }

    #[test]
    fn ssim_is_its_definition_on_any_shape() {
        for (w, h) in [(11, 11), (19, 12), (13, 27)] {
            let (a, b) = (picture(w, h, 3), picture(w, h, 4));
            let got = ssim(&a, &b, w, h).unwrap();
            assert!((got - naive_ssim(&a, &b, w, h)).abs() < 1e-12);
            assert!((ssim(&a, &a, w, h).unwrap() - 1.0).abs() < 1e-12);
        }
    }

    /// One window by hand, with the constants as numbers: a change of either by 3 % is more than the tolerance.
    #[test]
    fn ssim_of_one_window_by_hand() {
        // Means 0.2 and 0.6, both variances 0.01, covariance 0.005; 121/120 times as much for the sample.
        // Luminance (0.24 + 0.0001) / (0.40 + 0.0001), structure (0.0100833 + 0.0009) / (0.0201667 + 0.0009).
        let moments = [0.2, 0.6, 0.04 + 0.01, 0.36 + 0.01, 0.12 + 0.005];
        assert!((ssim_at(moments) - 0.312868578741).abs() < 1e-9, "{}", ssim_at(moments));
    }

    #[test]
    fn the_mean_gradient_of_a_ramp_is_its_slope() {
        // 0.01 a column and 0.02 a row, clipped nowhere; 12·9 and 13·8 neighbours.
        let ramp: Vec<f32> =
            (0..13 * 9 * 3).map(|i| 0.01 * (i / 3 % 13) as f32 + 0.02 * (i / 39) as f32).collect();
        let expected = (108.0 * 0.01 + 104.0 * 0.02) / 212.0;
        assert!((mean_gradient(&ramp, 13, 9).unwrap() - expected).abs() < 1e-7);
        let over: Vec<f32> = ramp.iter().map(|v| 2.0 + v).collect();
        assert_eq!(mean_gradient(&over, 13, 9).unwrap(), 0.0);
        assert!(mean_gradient(&ramp, 13, 8).is_err() && mean_gradient(&[0.0; 3], 1, 1).is_err());
    }

    #[test]
    fn gmsd_is_its_definition() {
        let (w, h) = (16, 12);
        let a = picture(w, h, 1);
        assert_eq!(gmsd(&a, &a, w, h).unwrap(), 0.0);
        // A vertical edge in one half of the picture, a flat picture beside it. The reduced picture is
        // 8x6; the gradient is 1 in the two columns beside the edge, 0 elsewhere, so that the
        // similarity is T / (1 + T) in these columns and 1 in the other four.
        let edge: Vec<f32> = (0..3 * w * h).map(|i| f32::from(i / 3 % w >= 8)).collect();
        let flat = vec![0.5; 3 * w * h];
        let low = GMSD_T / (1.0 + GMSD_T);
        let mean = (2.0 * low + 4.0) / 6.0;
        let expected = ((2.0 * (low - mean).powi(2) + 4.0 * (1.0 - mean).powi(2)) / 6.0).sqrt();
        assert!((gmsd(&edge, &flat, w, h).unwrap() - expected).abs() < 1e-12);
        // Green weighs more than blue.
        let only = |c: usize| -> Vec<f32> {
            edge.iter().enumerate().map(|(i, v)| if i % 3 == c { *v } else { 0.0 }).collect()
        };
        let [green, blue] = [1, 2].map(|c| gmsd(&only(c), &edge, w, h).unwrap());
        assert!(green < blue, "{green} {blue}");
        assert!(gmsd(&a, &a, 5, 12).is_err());
    }

    #[test]
    fn what_cannot_be_compared_is_refused_by_name() {
        let a = picture(12, 12, 1);
        let small = ssim(&a[..10 * 12 * 3], &a[..10 * 12 * 3], 12, 10).unwrap_err();
        assert_eq!(small, MetricsError::TooSmall { least: 11, width: 12, height: 10 });
        assert!(matches!(
            psnr(&a, &a[3..], 12, 12),
            Err(MetricsError::Length { which: "b", expected: 432, got: 429, .. })
        ));
        assert!(psnr(&[], &[], 0, 0).is_err());
        let mut nan = a.clone();
        nan[(5 * 12 + 7) * 3 + 1] = f32::NAN;
        let e = ssim(&nan, &a, 12, 12).unwrap_err().to_string();
        assert_eq!(e, "picture a: expected finite values, got NaN at column 7, row 5");
        assert!(psnr(&a, &a, usize::MAX, usize::MAX).is_err());
    }
}
