//! Pictures beyond [`MAX_PIXELS`], reduced while they are read: by 2, 4 or 8 along both axes, the least factor
//! that gives at most [`MAX_PIXELS`]. The reduced size is the picture's size for every caller, so that focal
//! lengths and the cameras of pose files follow it as they follow any reduced copy.
//!
//! JPEG: `jpeg-decoder` (image-rs; no dependency) has a transform for blocks of 4, 2 and 1 px, which `zune-jpeg` has not.
//! PNG and TIFF: rows are averaged in squares as they are decoded; a sample keeps its bits. Other formats, PNG with
//! interlacing and TIFF with separate planes hold the whole picture and are refused.
//!
//! Memory beside the file: the reduced picture (at most 100 megapixels, of JPEG 6 bytes each, else up to 8) and
//! [`WORKING_LIMIT`], which the coefficients of a progressive JPEG, and a strip or a row of tiles of a TIFF have to
//! fit.

use super::image::MAX_PIXELS;
use super::jpeg;
use crate::files::{Error, Result};
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, LumaA, Pixel, Primitive, Rgb, Rgba};
use std::io::Cursor;
use std::path::Path;

/// Largest number of stored pixels.
pub(super) const MAX_STORED_PIXELS: u64 = 1_000_000_000;
/// Largest memory of what is decoded and not yet averaged, bytes.
const WORKING_LIMIT: u64 = 1 << 30;
/// Factors of the reduction.
const FACTORS: [u32; 4] = [1, 2, 4, 8];

/// The factor by which a picture is reduced; `None` beyond [`MAX_STORED_PIXELS`].
pub(super) fn factor(width: u32, height: u32) -> Option<u32> {
    let pixels = |f: &u32| u64::from(width.div_ceil(*f)) * u64::from(height.div_ceil(*f));
    let factor = FACTORS.into_iter().find(|f| pixels(f) <= MAX_PIXELS)?;
    (pixels(&1) <= MAX_STORED_PIXELS).then_some(factor)
}

/// The size after a reduction, px.
pub(super) fn size(width: u32, height: u32, factor: u32) -> [u32; 2] {
    [width.div_ceil(factor), height.div_ceil(factor)]
}

/// The line about a reduction.
pub(super) fn note(width: u32, height: u32, factor: u32, path: &Path) -> String {
    let [w, h] = size(width, height, factor);
    format!(
        "{}: {width}x{height} pixels are reduced to {w}x{h} while they are read",
        path.display()
    )
}

/// Decodes a picture, reduced by `factor`.
///
/// # Errors
/// A format or a kind of it that is not read in parts; a malformed file; [`WORKING_LIMIT`].
pub(super) fn decode(
    bytes: &[u8],
    format: ImageFormat,
    factor: u32,
    path: &Path,
) -> Result<DynamicImage> {
    let decoded = match format {
        ImageFormat::Jpeg => decode_jpeg(bytes, factor),
        ImageFormat::Png => decode_png(bytes, factor),
        ImageFormat::Tiff => decode_tiff(bytes, factor),
        other => Err(format!("{other:?}, which is decoded as a whole")),
    };
    let expected = format!(
        "at most {} megapixels, or a JPEG, PNG or TIFF that can be reduced while it is read",
        MAX_PIXELS / 1_000_000
    );
    decoded.map_err(|got| Error::format(path, expected, got))
}

type Decoded = std::result::Result<DynamicImage, String>;

fn decode_jpeg(bytes: &[u8], factor: u32) -> Decoded {
    let layout = jpeg::layout(bytes);
    let (true, Some(components @ (1 | 3)), Some([w, h])) =
        (layout.lossy, layout.components, layout.size)
    else {
        return Err("a JPEG that is lossless, or neither grey nor in colour".to_owned());
    };
    let coefficients = 2 * u64::from(components) * u64::from(w) * u64::from(h);
    if layout.progressive && coefficients > WORKING_LIMIT {
        return Err(format!(
            "a progressive JPEG of {w}x{h} pixels, which needs {} MiB while it is read (save it without progression)",
            coefficients >> 20
        ));
    }
    let [width, height] = size(w, h, factor);
    let side = |v: u32| u16::try_from(v).map_err(|e| e.to_string());
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    let found = decoder.scale(side(width)?, side(height)?).map_err(|e| e.to_string())?;
    if found != (side(width)?, side(height)?) {
        return Err(format!("{}x{} pixels in place of {width}x{height}", found.0, found.1));
    }
    let pixels = decoder.decode().map_err(|e| e.to_string())?;
    picture([width, height], usize::from(components), pixels)
}

/// A picture of 1 to 4 channels.
fn picture<T: Primitive>([width, height]: [u32; 2], channels: usize, data: Vec<T>) -> Decoded
where
    Rgb<T>: Pixel<Subpixel = T>,
    Rgba<T>: Pixel<Subpixel = T>,
    DynamicImage: From<ImageBuffer<Luma<T>, Vec<T>>>
        + From<ImageBuffer<LumaA<T>, Vec<T>>>
        + From<ImageBuffer<Rgb<T>, Vec<T>>>
        + From<ImageBuffer<Rgba<T>, Vec<T>>>,
{
    let made = match channels {
        1 => ImageBuffer::<Luma<T>, _>::from_raw(width, height, data).map(DynamicImage::from),
        2 => ImageBuffer::<LumaA<T>, _>::from_raw(width, height, data).map(DynamicImage::from),
        3 => ImageBuffer::<Rgb<T>, _>::from_raw(width, height, data).map(DynamicImage::from),
        _ => ImageBuffer::<Rgba<T>, _>::from_raw(width, height, data).map(DynamicImage::from),
    };
    made.ok_or_else(|| "another number of pixels than the file states".to_owned())
}

/// Means of squares of samples, whose rows come one by one. Those at the right and the lower edge may be smaller.
struct Means<T> {
    width: usize,
    channels: usize,
    factor: usize,
    /// Sums of the squares of a row, and the number of rows in them. 64 samples of 16 bits fit.
    sums: Vec<u32>,
    rows: usize,
    means: Vec<T>,
}

impl<T: Copy + Into<u32> + TryFrom<u32> + Default> Means<T> {
    fn new(width: u32, height: u32, channels: usize, factor: u32) -> Self {
        let [w, h] = size(width, height, factor).map(|side| side as usize);
        Self {
            width: width as usize,
            channels,
            factor: factor as usize,
            sums: vec![0; w * channels],
            rows: 0,
            means: Vec::with_capacity(w * h * channels),
        }
    }

    fn push(&mut self, row: &[T]) {
        let squares = row.chunks(self.factor * self.channels);
        for (sums, square) in self.sums.chunks_exact_mut(self.channels).zip(squares) {
            for pixel in square.chunks_exact(self.channels) {
                for (sum, sample) in sums.iter_mut().zip(pixel) {
                    *sum += (*sample).into();
                }
            }
        }
        self.rows += 1;
        if self.rows == self.factor {
            self.flush();
        }
    }

    fn flush(&mut self) {
        for (x, sums) in self.sums.chunks_exact_mut(self.channels).enumerate() {
            let columns = self.factor.min(self.width - x * self.factor);
            let count = (columns * self.rows) as u32;
            let mean = |sum: &u32| T::try_from((sum + count / 2) / count).unwrap_or_default();
            self.means.extend(sums.iter().map(mean));
            sums.fill(0);
        }
        self.rows = 0;
    }

    fn finish(mut self) -> Vec<T> {
        if self.rows > 0 {
            self.flush();
        }
        self.means
    }
}

/// Means of samples of either depth.
enum AnyMeans {
    Eight(Means<u8>),
    Sixteen(Means<u16>),
}

impl AnyMeans {
    fn new(width: u32, height: u32, channels: usize, factor: u32, sixteen: bool) -> Self {
        if sixteen {
            Self::Sixteen(Means::new(width, height, channels, factor))
        } else {
            Self::Eight(Means::new(width, height, channels, factor))
        }
    }

    fn finish(self, size: [u32; 2]) -> Decoded {
        match self {
            Self::Eight(m) => picture(size, m.channels, m.finish()),
            Self::Sixteen(m) => picture(size, m.channels, m.finish()),
        }
    }
}

fn decode_png(bytes: &[u8], factor: u32) -> Decoded {
    let text = |e: png::DecodingError| e.to_string();
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    // Palettes become colours, and 1 to 4 bits become 8.
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(text)?;
    let (width, height) = reader.info().size();
    if reader.info().interlaced {
        return Err("an interlaced PNG (save it without interlacing)".to_owned());
    }
    let (color, depth) = reader.output_color_type();
    let channels = color.samples();
    let mut means = AnyMeans::new(width, height, channels, factor, depth == png::BitDepth::Sixteen);
    let mut deep = Vec::new();
    while let Some(row) = reader.next_row().map_err(text)? {
        match &mut means {
            AnyMeans::Eight(means) => means.push(row.data()),
            AnyMeans::Sixteen(means) => {
                deep.clear();
                deep.extend(row.data().chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])));
                means.push(&deep);
            }
        }
    }
    means.finish(size(width, height, factor))
}

fn decode_tiff(bytes: &[u8], factor: u32) -> Decoded {
    use tiff::ColorType;
    use tiff::decoder::{Decoder, DecodingResult, Limits};
    let text = |e: tiff::TiffError| e.to_string();
    let mut limits = Limits::default();
    limits.decoding_buffer_size = WORKING_LIMIT as usize;
    limits.intermediate_buffer_size = WORKING_LIMIT as usize;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(text)?.with_limits(limits);
    let (width, height) = decoder.dimensions().map_err(text)?;
    let (channels, bits) = match decoder.colortype().map_err(text)? {
        ColorType::Gray(bits @ (8 | 16)) => (1, bits),
        ColorType::RGB(bits @ (8 | 16)) => (3, bits),
        ColorType::RGBA(bits @ (8 | 16)) => (4, bits),
        other => return Err(format!("a TIFF of {other:?}")),
    };
    let planar = decoder.find_tag_unsigned::<u16>(tiff::tags::Tag::PlanarConfiguration);
    if planar.map_err(text)?.unwrap_or(1) != 1 {
        return Err("a TIFF with a plane for each channel (save it interleaved)".to_owned());
    }
    let (chunk_width, chunk_height) = decoder.chunk_dimensions();
    if chunk_width == 0 || chunk_height == 0 {
        return Err("a TIFF with empty tiles".to_owned());
    }
    // The rows of one strip, or of one row of tiles.
    let rows = chunk_height.min(height) as usize;
    let line = width as usize * channels;
    let working = line as u64 * rows as u64 * u64::from(bits / 8);
    if working > WORKING_LIMIT {
        return Err(format!(
            "a TIFF with {} MiB in one strip (at most {} MiB; save it with strips of fewer rows)",
            working >> 20,
            WORKING_LIMIT >> 20
        ));
    }
    let mut band = vec![0u16; if bits == 16 { line * rows } else { 0 }];
    let mut band_8 = vec![0u8; if bits == 8 { line * rows } else { 0 }];
    let mut means = AnyMeans::new(width, height, channels, factor, bits == 16);
    let across = width.div_ceil(chunk_width);
    for down in 0..height.div_ceil(chunk_height) {
        let mut filled = 0;
        for x in 0..across {
            let index = down * across + x;
            let (w, h) = decoder.chunk_data_dimensions(index);
            let at = x as usize * chunk_width as usize * channels;
            let chunk = [w as usize * channels, h as usize, at, line];
            filled = match decoder.read_chunk(index).map_err(text)? {
                DecodingResult::U8(data) if bits == 8 => place(&data, &mut band_8, chunk),
                DecodingResult::U16(data) if bits == 16 => place(&data, &mut band, chunk),
                _ => None,
            }
            .ok_or("a TIFF with a tile of another size or kind than it states")?;
        }
        match &mut means {
            AnyMeans::Eight(means) => {
                band_8.chunks_exact(line).take(filled).for_each(|row| means.push(row));
            }
            AnyMeans::Sixteen(means) => {
                band.chunks_exact(line).take(filled).for_each(|row| means.push(row));
            }
        }
    }
    means.finish(size(width, height, factor))
}

/// Copies the rows of a tile to their place among the rows of `band`; returns their number. `None` where the tile
/// has another size. Samples: of a row of the tile, rows, first column, of a row of the band.
fn place<T: Copy>(
    data: &[T],
    band: &mut [T],
    [width, rows, at, line]: [usize; 4],
) -> Option<usize> {
    if data.len() != width * rows || rows * line > band.len() || at + width > line || width == 0 {
        return None;
    }
    for (from, to) in data.chunks_exact(width).zip(band.chunks_exact_mut(line)) {
        to[at..at + width].copy_from_slice(from);
    }
    Some(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ExtendedColorType, ImageEncoder};

    fn path() -> &'static Path {
        Path::new("large")
    }

    /// Means by the definition.
    fn expected(data: &[u32], [w, h, channels]: [usize; 3], factor: usize) -> Vec<u32> {
        let mut means = Vec::new();
        for y in (0..h).step_by(factor) {
            for x in (0..w).step_by(factor) {
                for c in 0..channels {
                    let rows = y..(y + factor).min(h);
                    let square = rows.flat_map(|y| (x..(x + factor).min(w)).map(move |x| (x, y)));
                    let values: Vec<u32> =
                        square.map(|(x, y)| data[(y * w + x) * channels + c]).collect();
                    let mean = values.iter().sum::<u32>() as f64 / values.len() as f64;
                    means.push(mean.round() as u32);
                }
            }
        }
        means
    }

    fn noise(count: usize, top: u32) -> Vec<u32> {
        let mut state = 1u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) % (top + 1)
        };
        (0..count).map(|_| next()).collect()
    }

    #[test]
    fn factors_and_limits() {
        assert_eq!(factor(10_000, 10_000), Some(1));
        assert_eq!(factor(10_001, 10_000), Some(2));
        // A phone's 200 megapixels, and the largest picture.
        assert_eq!(factor(16_320, 12_240), Some(2));
        assert_eq!(factor(40_000, 25_000), Some(4));
        assert_eq!(factor(40_000, 25_001), None);
        assert_eq!(factor(u32::MAX, u32::MAX), None);
        assert_eq!(size(16_321, 12_240, 2), [8161, 6120]);
    }

    #[test]
    fn png_and_tiff_are_averaged() {
        let [w, h] = [37usize, 21];
        for (channels, kind, deep) in [
            (1, ExtendedColorType::L8, false),
            (3, ExtendedColorType::Rgb16, true),
            (4, ExtendedColorType::Rgba8, false),
        ] {
            let data = noise(w * h * channels, if deep { 65_535 } else { 255 });
            let bytes: Vec<u8> = if deep {
                data.iter().flat_map(|v| (*v as u16).to_ne_bytes()).collect()
            } else {
                data.iter().map(|v| *v as u8).collect()
            };
            let mut png = Vec::new();
            let encoder = image::codecs::png::PngEncoder::new(&mut png);
            encoder.write_image(&bytes, w as u32, h as u32, kind).unwrap();
            let mut tiff = Cursor::new(Vec::new());
            let encoder = image::codecs::tiff::TiffEncoder::new(&mut tiff);
            encoder.write_image(&bytes, w as u32, h as u32, kind).unwrap();
            for (format, file) in [(ImageFormat::Png, &png), (ImageFormat::Tiff, tiff.get_ref())] {
                for factor in [2, 4, 8] {
                    let found = decode(file, format, factor, path()).unwrap();
                    let size = size(w as u32, h as u32, factor);
                    assert_eq!([found.width(), found.height()], size);
                    let samples: Vec<u32> = if deep {
                        found.into_rgb16().into_raw().into_iter().map(u32::from).collect()
                    } else {
                        found.as_bytes().iter().map(|v| u32::from(*v)).collect()
                    };
                    let means = expected(&data, [w, h, channels], factor as usize);
                    assert_eq!(samples, means, "{format:?} {channels} {factor}");
                }
                for cut in [30, file.len() / 2, file.len() - 20] {
                    assert!(decode(&file[..cut], format, 2, path()).is_err(), "{format:?} {cut}");
                }
            }
        }
    }

    #[test]
    fn tiles_are_placed() {
        let (a, b) = ([1u8, 2, 3, 4], [5u8, 6]);
        let mut band = vec![0; 6];
        assert_eq!(place(&a, &mut band, [2, 2, 0, 3]), Some(2));
        assert_eq!(place(&b, &mut band, [1, 2, 2, 3]), Some(2));
        assert_eq!(band, [1, 2, 5, 3, 4, 6]);
        assert_eq!(place(&a, &mut band, [2, 2, 2, 3]), None);
        assert_eq!(place(&a, &mut band, [2, 3, 0, 3]), None);
    }

    #[test]
    fn jpeg_is_scaled_by_its_transform() {
        let [w, h] = [203u16, 117];
        let smooth = |i: usize| {
            let (x, y) = (i % 203, i / 203);
            [x as u8, (2 * y) as u8, ((x + y) / 2) as u8]
        };
        let data: Vec<u8> = (0..203 * 117).flat_map(smooth).collect();
        let wide: Vec<u32> = data.iter().map(|v| u32::from(*v)).collect();
        for progressive in [false, true] {
            let mut bytes = Vec::new();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 95);
            encoder.set_progressive(progressive);
            encoder.encode(&data, w, h, jpeg_encoder::ColorType::Rgb).unwrap();
            for factor in [2, 4, 8] {
                let found = decode(&bytes, ImageFormat::Jpeg, factor, path()).unwrap();
                let [width, height] = size(203, 117, factor);
                assert_eq!([found.width(), found.height()], [width, height]);
                let means = expected(&wide, [203, 117, 3], factor as usize);
                // The last squares are filled up to whole blocks.
                let inner = |i: usize| {
                    let (x, y) = (i / 3 % width as usize, i / 3 / width as usize);
                    x + 2 < width as usize && y + 2 < height as usize
                };
                let worst = found.as_bytes().iter().zip(&means).enumerate();
                let worst =
                    worst.filter(|(i, _)| inner(*i)).map(|(_, (f, m))| u32::from(*f).abs_diff(*m));
                assert!(worst.max().unwrap() <= 4, "{factor}");
            }
            assert!(decode(&bytes[..200], ImageFormat::Jpeg, 2, path()).is_err());
        }
    }

    #[test]
    fn other_kinds_are_refused_by_name() {
        let refused =
            |bytes: &[u8], format| decode(bytes, format, 2, path()).unwrap_err().to_string();
        let e = refused(b"", ImageFormat::WebP);
        assert!(e.contains("large") && e.contains("100 megapixels") && e.contains("WebP"), "{e}");
        // A header of one strip of 30000 x 30000.
        let entry = |tag: u16, value: u32| {
            [&tag.to_le_bytes()[..], &[4, 0, 1, 0, 0, 0], &value.to_le_bytes()].concat()
        };
        let tags = [
            (256, 30_000),
            (257, 30_000),
            (258, 8),
            (259, 1),
            (262, 1),
            (273, 200),
            (277, 1),
            (278, 30_000),
            (279, 900_000_000),
        ];
        let mut tiff = b"II*\0\x08\0\0\0\x09\0".to_vec();
        tags.iter().for_each(|(tag, value)| tiff.extend(entry(*tag, *value)));
        tiff.extend([0; 100]);
        let e = refused(&tiff, ImageFormat::Tiff);
        assert!(e.contains("large"), "{e}");
        let e = refused(b"\xff\xd8\xff\xe0", ImageFormat::Jpeg);
        assert!(e.contains("JPEG"), "{e}");
    }
}
