//! Effects of cameras and files on pictures: blur, exposure, JPEG compression.

use rayon::prelude::*;
use subsplat::image::codecs::jpeg::JpegEncoder;
use subsplat::image::{ExtendedColorType, ImageFormat};
use subsplat::scene::pictures::Rgb;

/// Applies a Gaussian blur of σ `sigma` px to `[H, W, 3]`, 3σ wide, with the border repeated.
pub(crate) fn blurred(rgb: &[f32], width: usize, sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as usize;
    let tap = |i: usize| (-0.5 * ((i as f32 - radius as f32) / sigma).powi(2)).exp();
    let mut taps: Vec<f32> = (0..=2 * radius).map(tap).collect();
    let sum: f32 = taps.iter().sum();
    taps.iter_mut().for_each(|t| *t /= sum);
    let height = rgb.len() / (3 * width.max(1));
    // Position `at` shifted by tap k, clamped to 0..n.
    let clamped = |at: usize, k: usize, n: usize| (at + k).saturating_sub(radius).min(n - 1);
    let pass =
        |source: &[f32], index: &(dyn Fn(usize, usize, usize) -> usize + Sync)| -> Vec<f32> {
            let value = |i: usize| {
                let (pixel, c) = (i / 3, i % 3);
                let (x, y) = (pixel % width, pixel / width);
                taps.iter().enumerate().map(|(k, t)| t * source[index(x, y, k) * 3 + c]).sum()
            };
            (0..source.len()).into_par_iter().map(value).collect()
        };
    let across = pass(rgb, &|x, y, k| y * width + clamped(x, k, width));
    pass(&across, &|x, y, k| clamped(y, k, height) * width + x)
}

/// Changes the exposure of display values by `stops` of light, for a display curve with exponent
/// 2.2.
pub(crate) fn expose(rgb: &mut [f32], stops: f32) {
    let factor = (stops / 2.2).exp2();
    rgb.iter_mut().for_each(|v| *v = (*v * factor).min(1.0));
}

/// Compresses a picture as JPEG of `quality` 1 to 100, and reads it again.
pub(crate) fn compress(picture: &mut Rgb, quality: u8) {
    let (Ok(width), Ok(height)) = (u32::try_from(picture.width), u32::try_from(picture.height))
    else {
        return;
    };
    let mut bytes = Vec::new();
    let encoded = JpegEncoder::new_with_quality(&mut bytes, quality).encode(
        &picture.data,
        width,
        height,
        ExtendedColorType::Rgb8,
    );
    // A picture beyond the limits of JPEG (65535 px) stays as it is.
    if encoded.is_err() {
        return;
    }
    if let Ok(read) = subsplat::image::load_from_memory_with_format(&bytes, ImageFormat::Jpeg) {
        picture.data = read.into_rgb8().into_raw();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Rgb {
        let data = (0..3 * 20 * 16).map(|i| (i * 7919 % 256) as u8).collect();
        Rgb { width: 20, height: 16, data }
    }

    #[test]
    fn a_stop_halves_the_light() {
        let mut values = [0.0, 0.5, 1.0];
        expose(&mut values, -1.0);
        let light = |v: f32| v.powf(2.2);
        assert!((light(values[1]) / light(0.5) - 0.5).abs() < 1e-5);
        assert!((light(values[2]) - 0.5).abs() < 1e-5 && values[0] == 0.0);
        expose(&mut values, 3.0);
        assert_eq!(values[2], 1.0);
    }

    #[test]
    fn a_blur_keeps_the_sum_of_an_inner_point() {
        let mut rgb = vec![0.0f32; 3 * 21 * 21];
        rgb[3 * (10 * 21 + 10) + 1] = 1.0;
        let out = blurred(&rgb, 21, 1.5);
        assert!((out.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        // The second moment along a row is σ².
        let moment: f32 =
            (0..21 * 21).map(|i| ((i % 21) as f32 - 10.0).powi(2) * out[3 * i + 1]).sum();
        assert!((moment - 2.25).abs() < 0.1, "{moment}");
    }

    #[test]
    fn compression_changes_little_at_high_quality() {
        let difference = |quality: u8| -> f64 {
            let mut out = picture();
            compress(&mut out, quality);
            let original = picture();
            let pairs = out.data.iter().zip(&original.data).map(|(a, b)| a.abs_diff(*b));
            pairs.map(f64::from).sum::<f64>() / out.data.len() as f64
        };
        let [low, high] = [20, 100].map(difference);
        assert!(high > 0.0 && high < low && low < 90.0, "{high} {low}");
    }
}
