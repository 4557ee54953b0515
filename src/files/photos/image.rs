//! Reading of pictures (PNG, JPEG, WebP, TIFF, BMP; HEIC with feature `heic`, JPEG XL with feature `jxl`; these, AVIF
//! and raw files through programs of the computer), and writing (8-bit PNG, 16-bit depth PNG).
//!
//! In memory a picture is 8-bit sRGB, rows from the top, because the evaluation protocol
//! resizes uint8 (MVSplat, with PIL). The network reads `[3, H, W]` floats in [0, 1]. A
//! picture with an ICC profile of another colour space is converted to sRGB (`icc.rs`).
//!
//! EXIF orientation is reported here and never applied, because pose files refer to the
//! stored pixels. `photograph.rs` applies it.

use super::decode::{self, decode, decode_photograph, decoder};
use crate::files::{Error, Result, read, write_atomic};
use crate::scene::mask::Mask;
use crate::scene::pictures::{Depth, Rgb};
use image::ImageDecoder;
use std::io::Write;
use std::path::Path;

/// Largest number of pixels of a picture in memory; checked before anything is allocated. A JPEG, PNG or TIFF of up to 10
/// times as many is reduced by 2, 4 or 8 along both axes while it is read.
pub const MAX_PIXELS: u64 = 100_000_000;

/// Fields of a picture's header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// Stored width, px; of a picture beyond [`MAX_PIXELS`] the reduced width.
    pub width: usize,
    /// Stored height, px; of a picture beyond [`MAX_PIXELS`] the reduced height.
    pub height: usize,
    /// EXIF orientation 2 to 8; `None` for "as stored".
    pub orientation: Option<u8>,
}

impl Probe {
    /// Returns the size after [`Probe::orientation`] is applied: orientations 5 to 8 exchange
    /// width and height.
    #[must_use]
    pub fn upright(self) -> Self {
        let Self { width, height, orientation } = self;
        match orientation {
            Some(5..=8) => Self { width: height, height: width, orientation: None },
            _ => Self { width, height, orientation: None },
        }
    }
}

/// Treatment of a JPEG that ends before its end-of-image marker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Truncated {
    /// The file is an error.
    #[default]
    Refuse,
    /// The file gives a warning. Pixels without data are grey or coarse.
    Accept,
}

/// Options of [`load_with`] and of the photographs' loader.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// Treatment of truncated JPEG files. A truncated file of another format is always an
    /// error.
    pub truncated: Truncated,
}

/// A decoded picture and the warnings about its file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadedPicture {
    /// Stored pixels, sRGB.
    pub picture: Rgb,
    /// Pixels that the alpha channel keeps: those of an alpha from 128. `None` without one that masks pixels.
    pub mask: Option<Mask>,
    /// Warnings for the user, one line each, with the file's path.
    pub warnings: Vec<String>,
}

/// Reads size and orientation from the header.
///
/// # Errors
/// Missing, not a picture, too large ([`MAX_PIXELS`]); a format that neither this build nor a program of the
/// computer reads.
pub fn probe(path: impl AsRef<Path>) -> Result<Probe> {
    Ok(decode::header(path.as_ref())?.probe)
}

/// Decodes a picture. Grey becomes three equal channels, 16 bits are rounded to 8, and
/// transparency is blended with black, the renderer's background, but for pixels of an alpha from 128
/// beside masked ones ([`LoadedPicture::mask`]). An ICC profile other than sRGB's is applied. The rotation and the mirroring of a HEIC file belong to its format and
/// are applied as well.
///
/// # Errors
/// Missing, truncated, not a picture, too large ([`MAX_PIXELS`]); CMYK without Adobe's marker; a format that neither
/// this build nor a program of the computer reads.
pub fn load(path: impl AsRef<Path>) -> Result<Rgb> {
    Ok(load_with(path, &LoadOptions::default())?.picture)
}

/// Decodes a picture as [`load`] does, with options, and returns the warnings.
///
/// # Errors
/// As [`load`]; with [`Truncated::Accept`] only a truncated JPEG without any decodable pixel.
pub fn load_with(path: impl AsRef<Path>, options: &LoadOptions) -> Result<LoadedPicture> {
    let path = path.as_ref();
    let bytes = read(path)?;
    let decoded = decode_photograph(&bytes, options, path)?;
    Ok(LoadedPicture { picture: decoded.picture, mask: decoded.mask, warnings: decoded.warnings })
}

/// Decodes bytes in memory as [`load`] does; `path` is for errors.
///
/// # Errors
/// As [`load`].
pub fn parse_picture(bytes: &[u8], path: impl AsRef<Path>) -> Result<Rgb> {
    Ok(decode(bytes, &LoadOptions::default(), path.as_ref())?.picture)
}

fn encode(
    path: &Path,
    data: &[u8],
    w: usize,
    h: usize,
    kind: image::ExtendedColorType,
) -> Result<Vec<u8>> {
    use image::ImageEncoder;
    let size = |v: usize| {
        u32::try_from(v).map_err(|_| Error::format(path, "a side below 2^32", v.to_string()))
    };
    let mut bytes = Vec::new();
    image::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(data, size(w)?, size(h)?, kind)
        .map_err(|e| Error::io(path, std::io::Error::other(e)))?;
    Ok(bytes)
}

/// Writes an 8-bit RGB PNG.
///
/// # Errors
/// A buffer whose length does not match the size; errors of [`write_atomic`].
pub fn save_png(path: impl AsRef<Path>, picture: &Rgb) -> Result<()> {
    let path = path.as_ref();
    let bytes = png_bytes(picture, path)?;
    write_atomic(path, |f| f.write_all(&bytes))
}

/// Encodes the file of [`save_png`]; `path` is for errors.
///
/// # Errors
/// A buffer whose length does not match the size.
pub fn png_bytes(picture: &Rgb, path: impl AsRef<Path>) -> Result<Vec<u8>> {
    encode_rgb(picture, path.as_ref())
}

fn encode_rgb(picture: &Rgb, path: &Path) -> Result<Vec<u8>> {
    let expected = 3 * picture.width * picture.height;
    if picture.data.len() != expected || expected == 0 {
        let got = format!("{} for {}x{}", picture.data.len(), picture.width, picture.height);
        return Err(Error::format(path, format!("{expected} bytes of pixels"), got));
    }
    let kind = image::ExtendedColorType::Rgb8;
    encode(path, &picture.data, picture.width, picture.height, kind)
}

/// Key of the PNG text chunk that holds [`save_depth_png`]'s unit.
const DEPTH_UNIT_KEY: &[u8] = b"depth_unit";

/// Writes depth as a 16-bit grey PNG and returns the unit: world units per step.
///
/// The unit is the smallest power of ten with which the largest depth fits 65535: metres up
/// to 65 become millimetres. A tEXt chunk `depth_unit` stores it. 0 means no depth, for
/// values that are not finite or not above half a unit.
///
/// # Errors
/// A buffer whose length does not match the size; errors of [`write_atomic`].
pub fn save_depth_png(path: impl AsRef<Path>, depth: &Depth) -> Result<f32> {
    write_depth_png(path.as_ref(), depth)
}

fn write_depth_png(path: &Path, depth: &Depth) -> Result<f32> {
    let area = depth.width * depth.height;
    if depth.data.len() != area || area == 0 {
        let got = format!("{} for {}x{}", depth.data.len(), depth.width, depth.height);
        return Err(Error::format(path, format!("{area} depths"), got));
    }
    let greatest = depth.data.iter().copied().filter(|d| d.is_finite()).fold(0.0f32, f32::max);
    let exponent =
        if greatest > 0.0 { (f64::from(greatest) / 65535.0).log10().ceil() } else { -3.0 };
    let unit = 10f64.powi(exponent as i32);
    let steps = |d: f32| if d.is_finite() { (f64::from(d) / unit).round() as u16 } else { 0 };
    // The encoder reads native-endian samples.
    let samples: Vec<u8> = depth.data.iter().flat_map(|&d| steps(d).to_ne_bytes()).collect();
    let kind = image::ExtendedColorType::L16;
    let png = encode(path, &samples, depth.width, depth.height, kind)?;
    let unit = unit as f32;
    let mut text = DEPTH_UNIT_KEY.to_vec();
    text.push(0);
    text.extend(unit.to_string().bytes());
    // Signature 8 bytes, then IHDR: 4 length, 4 name, 13 data, 4 checksum.
    let (head, rest) = png.split_at(33);
    write_atomic(path, |f| {
        f.write_all(head)?;
        f.write_all(&png_chunk(*b"tEXt", &text))?;
        f.write_all(rest)
    })?;
    Ok(unit)
}

fn png_chunk(name: [u8; 4], data: &[u8]) -> Vec<u8> {
    let mut chunk = (data.len() as u32).to_be_bytes().to_vec();
    chunk.extend(name);
    chunk.extend(data);
    let mut crc = flate2::Crc::new();
    crc.update(&chunk[4..]);
    chunk.extend(crc.sum().to_be_bytes());
    chunk
}

/// Reads the `depth_unit` text of a PNG, if it has one.
fn depth_unit(png: &[u8]) -> Option<f32> {
    let mut rest = png.get(8..)?;
    loop {
        let length = u32::from_be_bytes(rest.get(..4)?.try_into().ok()?) as usize;
        let data = rest.get(8..length.checked_add(8)?)?;
        if rest.get(4..8)? == b"tEXt"
            && let Some(value) =
                data.strip_prefix(DEPTH_UNIT_KEY).and_then(|d| d.strip_prefix(&[0]))
        {
            return std::str::from_utf8(value).ok()?.parse().ok();
        }
        rest = rest.get(length.checked_add(12)?..)?;
    }
}

/// Reads a 16-bit grey depth PNG. The unit is the file's `depth_unit`, else `unit` (0.001
/// for millimetres).
///
/// # Errors
/// Missing, truncated, not 16-bit grey, a unit that is not above zero.
pub fn load_depth_png(path: impl AsRef<Path>, unit: f32) -> Result<Depth> {
    let path = path.as_ref();
    parse_depth_png(&read(path)?, unit, path)
}

/// Decodes bytes in memory as [`load_depth_png`] does; `path` is for errors.
///
/// # Errors
/// As [`load_depth_png`].
pub fn parse_depth_png(bytes: &[u8], unit: f32, path: impl AsRef<Path>) -> Result<Depth> {
    decode_depth_png(bytes, unit, path.as_ref())
}

fn decode_depth_png(bytes: &[u8], unit: f32, path: &Path) -> Result<Depth> {
    let decoder = decoder(Box::new(std::io::Cursor::new(bytes)), path)?.decoder;
    let (width, height) = decoder.dimensions();
    decode::check_size(width, height, path)?;
    let decoded =
        image::DynamicImage::from_decoder(decoder).map_err(|e| decode::refused(path, e))?;
    let image::DynamicImage::ImageLuma16(grey) = decoded else {
        let got = format!("{:?}", decoded.color());
        return Err(Error::format(path, "16-bit grey depth", got));
    };
    let unit = depth_unit(bytes).unwrap_or(unit);
    if !(unit > 0.0 && unit.is_finite()) {
        return Err(Error::format(path, "a depth unit above 0", unit.to_string()));
    }
    let (width, height) = (grey.width() as usize, grey.height() as usize);
    let data = grey.into_raw().into_iter().map(|v| f32::from(v) * unit).collect();
    Ok(Depth { width, height, data })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_survives_and_floats_round() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let data: Vec<u8> = (0..5 * 4 * 3).map(|i| (i * 41 % 256) as u8).collect();
        let picture = Rgb { width: 5, height: 4, data };
        save_png(&path, &picture).unwrap();
        assert_eq!(load(&path).unwrap(), picture);
        assert_eq!(Rgb::from_planes(&picture.to_planes(), 5, 4).unwrap(), picture);
        let odd = Rgb::from_planes(&[0.5001 / 255.0, f32::NAN, 7.0], 1, 1).unwrap();
        assert_eq!(odd.data, [1, 0, 255]);
        assert!(Rgb::from_planes(&[0.0; 4], 1, 1).is_none());
        assert_eq!(picture.window(1, 2, 3, 2).unwrap().data[..3], picture.data[3 * 11..3 * 12]);
        assert!(picture.window(3, 2, 3, 2).is_none());
    }

    #[test]
    fn depth_survives_with_its_unit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("d.png");
        let data = vec![0.0, 1.25, f32::NAN, 60.0, f32::INFINITY, 12.3456];
        let depth = Depth { width: 3, height: 2, data };
        let unit = save_depth_png(&path, &depth).unwrap();
        assert_eq!(unit, 0.001);
        // The file's own unit wins over the caller's.
        let back = load_depth_png(&path, 7.0).unwrap();
        for (b, d) in back.data.iter().zip([0.0, 1.25, 0.0, 60.0, 0.0, 12.346]) {
            assert!((b - d).abs() < 1e-5, "{b} {d}");
        }
        let far = Depth { width: 1, height: 1, data: vec![4000.0] };
        assert_eq!(save_depth_png(&path, &far).unwrap(), 0.1);
        assert_eq!(load_depth_png(&path, 7.0).unwrap().data[0], 4000.0);
        let empty = Depth { width: 1, height: 1, data: vec![0.0] };
        assert_eq!(save_depth_png(&path, &empty).unwrap(), 0.001);
    }

    #[test]
    fn grey_alpha_and_sixteen_bits_are_taken() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        image::GrayImage::from_raw(1, 1, vec![77]).unwrap().save(&path).unwrap();
        assert_eq!(load(&path).unwrap().data, [77; 3]);
        let colours = vec![200, 100, 255, 128, 9, 8, 7, 255];
        image::RgbaImage::from_raw(2, 1, colours).unwrap().save(&path).unwrap();
        assert_eq!(load(&path).unwrap().data, [100, 50, 128, 9, 8, 7]);
        let deep: image::ImageBuffer<image::Rgb<u16>, _> =
            image::ImageBuffer::from_raw(1, 1, vec![257u16 * 9, 257 * 9 + 200, 65535]).unwrap();
        image::DynamicImage::ImageRgb16(deep).save(&path).unwrap();
        assert_eq!(load(&path).unwrap().data, [9, 10, 255]);
    }
}
