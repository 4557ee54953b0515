//! Ranges of samples beyond 8 bits, by one rule:
//!
//! | samples | white |
//! |---|---|
//! | 8 bits | 255 |
//! | 16 bits | 65535; the TIFF's `MaxSampleValue`, where it is 2ⁿ − 1 and no sample exceeds it; 4095, 1023 or 255 where no sample exceeds this value, one exceeds half of it, and no `sBIT` of a PNG says that the full range is used |
//! | floating point | 1; 255 or 65535 where a sample exceeds 16 and none exceeds this value |
//!
//! Samples are sRGB, or what the ICC profile says, whatever their type. Those outside the range are clipped. Each
//! case but 8 bits and 65535 gives a line, as do 16-bit samples of almost no contrast. Cameras and converters store 10 and 12 bits in 16 without scaling
//! them, and arrays of floats are saved in levels of 8 or 16 bits.

use super::tiff_tags::{MAX_SAMPLE_VALUE, numbers};
use image::DynamicImage;

/// Largest values of samples of 8, 10 and 12 bits.
const RANGES: [u16; 3] = [255, 1023, 4095];
/// Greatest floating-point sample that may be a highlight above white.
const HIGHLIGHT: f32 = 16.0;
/// Least range of 16-bit samples, of 65,535: 8 levels of 255. Thermal cameras store temperatures in fewer.
const LEAST_RANGE: u16 = 2056;

/// Brings the samples of a file to the full range of their type. Returns the line about it.
pub(super) fn to_full_range(pixels: &mut DynamicImage, file: &[u8]) -> Option<String> {
    match pixels {
        DynamicImage::ImageLuma16(p) => sixteen(p, 1, 1, file),
        DynamicImage::ImageLumaA16(p) => sixteen(p, 2, 1, file),
        DynamicImage::ImageRgb16(p) => sixteen(p, 3, 3, file),
        DynamicImage::ImageRgba16(p) => sixteen(p, 4, 3, file),
        DynamicImage::ImageRgb32F(p) => float(p, 3),
        DynamicImage::ImageRgba32F(p) => float(p, 4),
        _ => None,
    }
}

/// `channels` samples a pixel, of which the first `colors` are no alpha.
fn sixteen(samples: &mut [u16], channels: usize, colors: usize, file: &[u8]) -> Option<String> {
    let greatest = |range: std::ops::Range<usize>, samples: &[u16]| {
        let alphas = samples.chunks_exact(channels).flat_map(|pixel| &pixel[range.clone()]);
        alphas.copied().max().unwrap_or(0)
    };
    let brightest = greatest(0..colors, samples);
    let stated = numbers(file, MAX_SAMPLE_VALUE).and_then(|v| v.into_iter().max());
    let stated = stated.and_then(|v| u16::try_from(v).ok());
    let stated = stated.filter(|v| v.count_ones() == v.trailing_ones() && *v >= brightest.max(255));
    let (white, reason) = match stated {
        Some(u16::MAX) => return None,
        Some(white) => (white, "as the file states"),
        None if has_sbit(file) => return None,
        None => {
            let white = RANGES.into_iter().find(|white| brightest <= *white);
            match white.filter(|white| brightest > white / 2) {
                Some(white) => (white, "as no sample exceeds it"),
                None => return little_contrast(samples, channels, colors, brightest),
            }
        }
    };
    let scale = |v: u16| {
        let white = u32::from(white);
        u16::try_from((u32::from(v) * 65_535 + white / 2) / white).unwrap_or(u16::MAX)
    };
    // An alpha of the full range stays.
    let alpha = channels > colors && greatest(colors..channels, samples) <= white;
    let scaled = if alpha { channels } else { colors };
    for pixel in samples.chunks_exact_mut(channels) {
        pixel[..scaled].iter_mut().for_each(|v| *v = scale(*v));
    }
    Some(format!(
        "samples of 16 bits are read with the white of {} bits, {white}, {reason}",
        white.count_ones()
    ))
}

/// A line about samples that differ by less than [`LEAST_RANGE`], as those of thermal cameras do.
fn little_contrast(
    samples: &[u16],
    channels: usize,
    colors: usize,
    brightest: u16,
) -> Option<String> {
    let of_colors = samples.chunks_exact(channels).flat_map(|pixel| &pixel[..colors]);
    let darkest = of_colors.copied().min()?;
    (brightest > darkest && brightest - darkest < LEAST_RANGE).then(|| {
        format!(
            "samples of 16 bits lie between {darkest} and {brightest} alone, so that the picture has almost no \
             contrast (a thermal picture?): spread this range from black to white, the same for all pictures"
        )
    })
}

/// Returns whether a PNG states its significant bits: its samples are then scaled to 16 bits (PNG, 11.3.2.7).
fn has_sbit(file: &[u8]) -> bool {
    let mut rest = file.strip_prefix(b"\x89PNG\r\n\x1a\n").unwrap_or_default();
    while let Some(length) = rest.get(..4).and_then(|b| b.try_into().ok()).map(u32::from_be_bytes) {
        match rest.get(4..8) {
            Some(b"sBIT") => return true,
            // The chunk stands before the pixels.
            Some(b"IDAT") | None => return false,
            Some(_) => rest = rest.get((length as usize).saturating_add(12)..).unwrap_or_default(),
        }
    }
    false
}

/// Three colours and perhaps an alpha from 0 to 1.
fn float(samples: &mut [f32], channels: usize) -> Option<String> {
    let colors = samples.chunks_exact(channels).flat_map(|pixel| &pixel[..3]);
    let brightest = colors.copied().filter(|v| v.is_finite()).fold(0.0, f32::max);
    let white = if brightest <= HIGHLIGHT {
        1.0
    } else {
        [255.0, 65_535.0].into_iter().find(|white| brightest <= *white).unwrap_or(1.0)
    };
    if white > 1.0 {
        for pixel in samples.chunks_exact_mut(channels) {
            pixel[..3].iter_mut().for_each(|v| *v /= white);
        }
    }
    let clipped = if brightest > white {
        format!("; those above it, up to {brightest}, are clipped")
    } else {
        String::new()
    };
    Some(format!(
        "floating-point samples are read as sRGB with the white {white}{clipped} (convert a picture in linear light \
         to sRGB first)"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageBuffer;

    fn deep(samples: &[u16], file: &[u8]) -> (Vec<u16>, Option<String>) {
        let mut pixels = DynamicImage::ImageLuma16(
            ImageBuffer::from_raw(samples.len() as u32, 1, samples.to_vec()).unwrap(),
        );
        let line = to_full_range(&mut pixels, file);
        (pixels.into_luma16().into_raw(), line)
    }

    /// A TIFF with `MaxSampleValue` alone.
    fn tiff(value: u16) -> Vec<u8> {
        let [low, high] = value.to_le_bytes();
        [
            b"II*\0\x08\0\0\0\x01\0\x19\x01\x03\0\x01\0\0\0".as_slice(),
            &[low, high, 0, 0, 0, 0, 0, 0],
        ]
        .concat()
    }

    #[test]
    fn bits_in_sixteen_are_recognised() {
        for (brightest, white) in
            [(4095, 4095), (2048, 4095), (1023, 1023), (512, 1023), (200, 255)]
        {
            let (found, line) = deep(&[0, brightest / 2, brightest], b"");
            let scale = |v: u16| (f64::from(v) * 65_535.0 / f64::from(white)).round() as u16;
            assert_eq!(found, [0, scale(brightest / 2), scale(brightest)], "{brightest}");
            assert!(line.unwrap().contains(&format!("{white},")), "{brightest}");
        }
        // The full range, and a picture that is dark for each of the others.
        for brightest in [65_535, 4096, 2047, 500, 127, 0] {
            let (found, line) = deep(&[0, brightest], b"");
            assert_eq!(found, [0, brightest]);
            let little = line.is_some_and(|line| line.contains("almost no contrast"));
            assert_eq!(little, (1..2056).contains(&brightest), "{brightest}");
        }
        // A thermal picture.
        let (found, line) = deep(&[29_000, 30_500], b"");
        assert!(found == [29_000, 30_500] && line.unwrap().contains("between 29000 and 30500"));
        assert_eq!(deep(&[29_000, 31_056], b"").1, None);
    }

    #[test]
    fn files_state_their_range() {
        let (found, line) = deep(&[0, 16_383], &tiff(16_383));
        assert_eq!(found, [0, 65_535]);
        assert!(line.unwrap().contains("14 bits, 16383, as the file states"));
        // The full range; not 2^n - 1; below a sample.
        assert_eq!(deep(&[0, 3000], &tiff(65_535)), (vec![0, 3000], None));
        for stated in [3000, 1023] {
            let (found, line) = deep(&[0, 3000], &tiff(stated));
            assert_eq!(found[1], 48_011, "{stated}");
            assert!(line.unwrap().contains("no sample exceeds it"));
        }
        // PNG writers scale what they state as significant.
        let chunk = |name: &[u8; 4], data: &[u8]| {
            [&(data.len() as u32).to_be_bytes()[..], name, data, &[0; 4]].concat()
        };
        let head = [&b"\x89PNG\r\n\x1a\n"[..], &chunk(b"IHDR", &[0; 13])].concat();
        let with = [&head[..], &chunk(b"sBIT", &[12]), &chunk(b"IDAT", b"x")].concat();
        let without = [&head[..], &chunk(b"IDAT", b"x"), &chunk(b"sBIT", &[12])].concat();
        assert_eq!(deep(&[0, 4095], &with).0, [0, 4095]);
        assert_eq!(deep(&[0, 4095], &without).0, [0, 65_535]);
    }

    #[test]
    fn an_alpha_follows_its_own_range() {
        for (alpha, expected) in [([0, 4095], [0, 65_535]), ([0, 65_535], [0, 65_535])] {
            let samples = vec![4095, alpha[0], 0, alpha[1]];
            let buffer = ImageBuffer::from_raw(2, 1, samples).unwrap();
            let mut pixels = DynamicImage::ImageLumaA16(buffer);
            assert!(to_full_range(&mut pixels, b"").is_some());
            let found = pixels.into_luma_alpha16().into_raw();
            assert_eq!(found, [65_535, expected[0], 0, expected[1]]);
        }
    }

    #[test]
    fn floats_have_a_range() {
        for (top, white) in
            [(1.0, 1.0), (0.2, 1.0), (3.5, 1.0), (255.0, 255.0), (60_000.0, 65_535.0), (1e6, 1.0)]
        {
            let samples = vec![0.0, f32::NAN, -1.0, top, top / 2.0, 0.0];
            let mut pixels =
                DynamicImage::ImageRgb32F(ImageBuffer::from_raw(2, 1, samples).unwrap());
            let line = to_full_range(&mut pixels, b"").unwrap();
            let found = pixels.into_rgb32f().into_raw();
            assert_eq!([found[0], found[3], found[4]], [0.0, top / white, top / 2.0 / white]);
            assert_eq!(line.contains("clipped"), top > white, "{line}");
            assert!(line.contains(&format!("white {white}")), "{line}");
        }
    }
}
