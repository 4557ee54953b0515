//! Decoding of picture files to stored sRGB pixels, with the metadata that photographs need.
//!
//! Steps: detect the format by content, refuse truncated JPEG files and CMYK of unknown
//! polarity, decode (`reduced.rs` beyond 100 megapixels, `converted.rs` what no decoder here reads), bring samples
//! of 16 bits and of floating point to one range (`ranges.rs` has the rule), convert an embedded ICC profile to
//! sRGB, make a mask of an alpha channel or blend transparency with black, round to 8 bits. Black bars of photographs
//! are masked (`bars.rs`).
//!
//! A fourth band of a TIFF is an alpha by its `ExtraSamples`: 0 (unspecified) is none, 1 is one by which the colours are
//! multiplied, 2 is one by which they are not. Without the tag it is read as 2, as OpenCV and others write it.

use super::bars::bars;
use super::gpano::Gpano;
use super::image::{LoadOptions, MAX_PIXELS, Probe, Truncated};
use super::programs::Kind;
use super::tiff_tags::{EXTRA_SAMPLES, is_tiff, numbers};
use super::{converted, heic, icc, jpeg, jxl, pages, ranges, raw, reduced};
use crate::files::{Error, Result, open_regular, read};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use image::error::UnsupportedErrorKind;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use std::borrow::Cow;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

/// The formats, for messages.
pub(super) const FORMATS: &str =
    "a picture: JPEG (also MPO), PNG, WebP, TIFF, BMP, HEIC, AVIF, JPEG XL or a camera's raw file";

/// A picture file, decoded.
pub(super) struct Decoded<'a> {
    /// Stored pixels, sRGB.
    pub picture: Rgb,
    /// Stored pixels that the alpha channel keeps, where it masks some.
    pub mask: Option<Mask>,
    /// EXIF orientation; `NoTransforms` for HEIC, AVIF and JPEG XL, whose decoders apply the file's rotation.
    pub orientation: Orientation,
    /// EXIF block: a TIFF structure.
    pub exif: Option<Cow<'a, [u8]>>,
    /// Metadata of an equirectangular panorama.
    pub panorama: Option<Gpano>,
    /// Warnings for the user, with the file's path.
    pub warnings: Vec<String>,
}

/// Metadata of a picture file.
pub(super) struct Header {
    /// Size and orientation.
    pub probe: Probe,
    /// EXIF block: a TIFF structure.
    pub exif: Option<Vec<u8>>,
    /// The metadata state an equirectangular panorama.
    pub panorama: bool,
    /// Warnings for the user, with the file's path.
    pub warnings: Vec<String>,
}

/// Decoded pixels of any type, with the metadata of their file.
pub(super) struct Raster<'a> {
    pub pixels: DynamicImage,
    /// ICC profile of the pixels.
    pub profile: Option<Vec<u8>>,
    pub orientation: Orientation,
    pub exif: Option<Cow<'a, [u8]>>,
    pub panorama: Option<Gpano>,
}

impl Raster<'_> {
    /// Upright pixels without metadata.
    pub fn of(pixels: DynamicImage) -> Self {
        let orientation = Orientation::NoTransforms;
        Self { pixels, profile: None, orientation, exif: None, panorama: None }
    }

    /// The same, with a copy of the EXIF block.
    pub fn into_owned(self) -> Raster<'static> {
        let Self { pixels, profile, orientation, exif, panorama } = self;
        let exif = exif.map(|block| Cow::Owned(block.into_owned()));
        Raster { pixels, profile, orientation, exif, panorama }
    }
}

/// A decoder of the `image` crate, and the file's format.
pub(super) struct Opened<'a> {
    pub decoder: Box<dyn ImageDecoder + 'a>,
    pub format: ImageFormat,
}

/// Makes an error of a decoder's error.
pub(super) fn refused(path: &Path, error: image::ImageError) -> Error {
    match error {
        image::ImageError::IoError(e) if e.raw_os_error().is_some() => Error::io(path, e),
        image::ImageError::Unsupported(e) => {
            let got = match e.kind() {
                UnsupportedErrorKind::Color(_) => format!(
                    "pixels of a kind that is not read, such as grey in floating point; convert the picture to 8 or \
                     16 bits, grey or RGB ({e})"
                ),
                UnsupportedErrorKind::Format(_) if is_gif(path) => {
                    "a GIF; a moving one is read as a clip where it is given alone".to_owned()
                }
                _ => e.to_string(),
            };
            Error::format(path, FORMATS, got)
        }
        e => Error::format(path, FORMATS, e.to_string()),
    }
}

fn is_gif(path: &Path) -> bool {
    crate::files::first_bytes(path, 4).is_ok_and(|start| start == *b"GIF8")
}

/// Checks the size of a picture before anything is allocated.
pub(super) fn check_size(width: u32, height: u32, path: &Path) -> Result<()> {
    let pixels = u64::from(width) * u64::from(height);
    if pixels == 0 || pixels > MAX_PIXELS {
        let expected = format!("1 to {} megapixels", MAX_PIXELS / 1_000_000);
        return Err(Error::format(path, expected, format!("{width}x{height} pixels")));
    }
    Ok(())
}

/// Checks the size of a picture that can be reduced while it is read, and returns the factor.
fn reduction(width: u32, height: u32, path: &Path) -> Result<u32> {
    if u64::from(width) * u64::from(height) <= MAX_PIXELS {
        return check_size(width, height, path).map(|()| 1);
    }
    reduced::factor(width, height).ok_or_else(|| {
        let expected = format!("1 to {} megapixels", reduced::MAX_STORED_PIXELS / 1_000_000);
        Error::format(path, expected, format!("{width}x{height} pixels"))
    })
}

/// A file or its bytes. One type for both: the decoders are generic, and are then compiled once.
pub(super) trait Input: BufRead + Seek {}

impl<R: BufRead + Seek> Input for R {}

/// Opens a decoder and checks the size ([`reduced::MAX_STORED_PIXELS`]). The content selects the decoder, not the
/// file's extension.
pub(super) fn decoder<'a>(input: Box<dyn Input + 'a>, path: &Path) -> Result<Opened<'a>> {
    let mut reader = ImageReader::new(input);
    let mut limits = Limits::default();
    // 16-bit RGBA of the largest size, and as much again for the decoder.
    limits.max_alloc = Some(MAX_PIXELS * 16);
    reader.limits(limits);
    let reader = reader.with_guessed_format().map_err(|e| Error::io(path, e))?;
    let Some(format) = reader.format() else {
        return Err(Error::format(path, FORMATS, "bytes of no known picture format"));
    };
    let decoder = reader.into_decoder().map_err(|e| refused(path, e))?;
    let (w, h) = decoder.dimensions();
    reduction(w, h, path)?;
    Ok(Opened { decoder: Box::new(decoder), format })
}

/// The kind of a picture for which `image` has no decoder; refuses empty files. `bytes` may be the start of a
/// file, but of a TIFF.
fn kind(bytes: &[u8], path: &Path) -> Result<Option<Kind>> {
    if bytes.is_empty() {
        return Err(Error::format(path, FORMATS, "an empty file"));
    }
    Ok(match heic::brand(bytes) {
        Some(heic::Brand::Avif) => Some(Kind::Avif),
        Some(heic::Brand::Heic) => Some(Kind::Heic),
        None if jxl::is_jxl(bytes) => Some(Kind::Jxl),
        None => raw::is_raw(bytes, path).then_some(Kind::Raw),
    })
}

/// Reads size, orientation and EXIF of a file without decoding its pixels.
pub(super) fn header(path: &Path) -> Result<Header> {
    let file = open_regular(path).map_err(|e| Error::io(path, e))?;
    let mut reader = BufReader::new(file);
    let start = reader.fill_buf().map_err(|e| Error::io(path, e))?;
    // The directory of a TIFF may lie anywhere, and holds its EXIF tags.
    let whole = if is_tiff(start) { Some(read(path)?) } else { None };
    match kind(whole.as_deref().unwrap_or(start), path)? {
        #[cfg(feature = "heic")]
        Some(Kind::Heic) => return heic::header(&read(path)?, path),
        #[cfg(feature = "jxl")]
        Some(Kind::Jxl) => return jxl::header(&read(path)?, path),
        Some(kind) => return converted::header(kind, &whole.map_or_else(|| read(path), Ok)?, path),
        None => {}
    }
    let Opened { mut decoder, format } = decoder(Box::new(reader), path)?;
    let (width, height) = decoder.dimensions();
    let factor = reduction(width, height, path)?;
    let warnings = match factor {
        1 => Vec::new(),
        _ => vec![reduced::note(width, height, factor, path)],
    };
    let [width, height] = reduced::size(width, height, factor).map(|side| side as usize);
    // A picture with a malformed EXIF block still decodes.
    let orientation = decoder.orientation().map_or(1, Orientation::to_exif);
    let exif = match format {
        ImageFormat::Tiff => whole,
        _ => decoder.exif_metadata().ok().flatten(),
    };
    let orientation = (orientation > 1).then_some(orientation);
    let probe = Probe { width, height, orientation };
    let panorama = panorama(&mut *decoder).is_some();
    Ok(Header { probe, exif, panorama, warnings })
}

/// Decodes the bytes of a picture file; `path` is for messages.
pub(super) fn decode<'a>(
    bytes: &'a [u8],
    options: &LoadOptions,
    path: &Path,
) -> Result<Decoded<'a>> {
    let mut warnings = Vec::new();
    let kind = kind(bytes, path)?;
    // Tags of a raw file describe other pixels than those that are read.
    let tags = if kind.is_none() { bytes } else { Default::default() };
    let raster = match kind {
        #[cfg(feature = "heic")]
        Some(Kind::Heic) => heic::decode(bytes, path, &mut warnings)?,
        #[cfg(feature = "jxl")]
        Some(Kind::Jxl) => jxl::decode(bytes, path)?,
        Some(kind) => converted::decode(kind, bytes, path, &mut warnings)?,
        None => native(bytes, options, path, &mut warnings)?,
    };
    let Raster { mut pixels, profile, orientation, exif, panorama } = raster;
    let mut note = |line: &str| warnings.push(format!("{}: {line}", path.display()));
    if let Some(line) = pages::note(tags) {
        note(&line);
    }
    if let Some(line) = fourth_band(&mut pixels, tags) {
        note(line);
    }
    if let Some(line) = ranges::to_full_range(&mut pixels, tags) {
        note(&line);
    }
    if let Some(profile) = profile
        && let Err(reason) = icc::to_srgb(&mut pixels, &profile)
    {
        note(&format!("the ICC profile is ignored and the colours are read as sRGB: {reason}"));
    }
    let (picture, mask) = to_rgb(pixels);
    if mask.is_some() {
        note("the alpha channel is used as a mask: pixels with an alpha below 128 are left out");
    }
    Ok(Decoded { picture, mask, orientation, exif, panorama, warnings })
}

/// [`decode`] of a photograph: black bars at its edges are masked.
pub(super) fn decode_photograph<'a>(
    bytes: &'a [u8],
    options: &LoadOptions,
    path: &Path,
) -> Result<Decoded<'a>> {
    let mut decoded = decode(bytes, options, path)?;
    let Rgb { width, height, .. } = decoded.picture;
    if decoded.mask.is_none()
        && let Some((bars, line)) = bars(&decoded.picture).mask(width, height)
    {
        decoded.warnings.push(format!("{}: {line}", path.display()));
        decoded.mask = Some(bars);
    }
    Ok(decoded)
}

/// Decodes a format of the `image` crate.
pub(super) fn native<'a>(
    bytes: &'a [u8],
    options: &LoadOptions,
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<Raster<'a>> {
    if jpeg::is_jpeg(bytes) {
        check_jpeg(bytes, options, path, warnings)?;
    }
    let Opened { mut decoder, format } = decoder(Box::new(Cursor::new(bytes)), path)?;
    let profile = decoder.icc_profile().unwrap_or_else(|e| {
        warnings.push(format!("{}: the ICC profile is ignored: {e}", path.display()));
        None
    });
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let exif = match format {
        ImageFormat::Tiff => Some(Cow::Borrowed(bytes)),
        _ => decoder.exif_metadata().ok().flatten().map(Cow::Owned),
    };
    let panorama = panorama(&mut *decoder);
    let (width, height) = decoder.dimensions();
    let pixels = match reduction(width, height, path)? {
        1 => DynamicImage::from_decoder(decoder).map_err(|e| refused(path, e))?,
        factor => {
            drop(decoder);
            warnings.push(reduced::note(width, height, factor, path));
            reduced::decode(bytes, format, factor, path)?
        }
    };
    Ok(Raster { pixels, profile, orientation, exif, panorama })
}

/// Takes a fourth band of a TIFF as its tag says. Returns the line about one that is left out.
fn fourth_band(pixels: &mut DynamicImage, bytes: &[u8]) -> Option<&'static str> {
    match numbers(bytes, EXTRA_SAMPLES)?.first()? {
        0 => {
            let found = std::mem::take(pixels);
            *pixels = match found {
                DynamicImage::ImageRgba8(_) => DynamicImage::ImageRgb8(found.into_rgb8()),
                DynamicImage::ImageRgba16(_) => DynamicImage::ImageRgb16(found.into_rgb16()),
                DynamicImage::ImageRgba32F(_) => DynamicImage::ImageRgb32F(found.into_rgb32f()),
                without => without,
            };
            Some(
                "a band beside the colours is left out: the file does not say that it is an alpha (ExtraSamples is 0)",
            )
        }
        1 => {
            divide_by_alpha(pixels);
            None
        }
        _ => None,
    }
}

/// Undoes the multiplication of the colours by their alpha. Colours without opacity stay.
fn divide_by_alpha(pixels: &mut DynamicImage) {
    match pixels {
        DynamicImage::ImageRgba8(pixels) => {
            for pixel in pixels.pixels_mut().filter(|p| p.0[3] > 0) {
                let [colors @ .., alpha] = &mut pixel.0;
                let divided = |v: u8| (u32::from(v) * 255 / u32::from(*alpha)).min(255) as u8;
                colors.iter_mut().for_each(|v| *v = divided(*v));
            }
        }
        DynamicImage::ImageRgba16(pixels) => {
            for pixel in pixels.pixels_mut().filter(|p| p.0[3] > 0) {
                let [colors @ .., alpha] = &mut pixel.0;
                let divided =
                    |v: u16| (u64::from(v) * 65_535 / u64::from(*alpha)).min(65_535) as u16;
                colors.iter_mut().for_each(|v| *v = divided(*v));
            }
        }
        DynamicImage::ImageRgba32F(pixels) => {
            for pixel in pixels.pixels_mut().filter(|p| p.0[3] > 0.0) {
                let [colors @ .., alpha] = &mut pixel.0;
                colors.iter_mut().for_each(|v| *v /= *alpha);
            }
        }
        _ => {}
    }
}

/// What the XMP block states of a panorama.
fn panorama(decoder: &mut dyn ImageDecoder) -> Option<Gpano> {
    let block = decoder.xmp_metadata().ok().flatten()?;
    Gpano::of_xmp(&String::from_utf8_lossy(&block))
}

/// Checks what the JPEG decoder does not: the end of the file and the kind of CMYK.
fn check_jpeg(
    bytes: &[u8],
    options: &LoadOptions,
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let layout = jpeg::layout(bytes);
    if layout.several && jpeg::second_of_size(bytes, &layout) {
        warnings.push(format!(
            "{}: the file has a second picture of the same size (MPO, stereo): the first one is read",
            path.display()
        ));
    }
    if let Some(part) = layout.cut_inside {
        match options.truncated {
            Truncated::Refuse => {
                let got = format!(
                    "a truncated file: its {} bytes end inside {part} (copy the file again)",
                    bytes.len()
                );
                return Err(Error::format(path, "a whole JPEG with an end-of-image marker", got));
            }
            Truncated::Accept => warnings.push(format!(
                "{}: the JPEG is truncated: its {} bytes end inside {part}; pixels without data \
                 are grey or coarse",
                path.display(),
                bytes.len()
            )),
        }
    }
    if layout.components == Some(4) {
        if !layout.adobe {
            return Err(Error::format(
                path,
                "a grey, RGB or YCbCr JPEG, or CMYK with Adobe's marker",
                "a CMYK JPEG without Adobe's marker (convert it to RGB first)",
            ));
        }
        warnings.push(format!(
            "{}: the picture is CMYK and is converted without its profile: its colours are \
             approximate",
            path.display()
        ));
    }
    Ok(())
}

/// Least alpha of a pixel that counts.
const ALPHA_KEPT: u8 = 128;

/// Rounds to 8 bits, and makes a mask of an alpha channel. An alpha that is the same everywhere is none: some writers
/// of BMP and TIFF leave a fourth band of zeros. A mask is an alpha that masks a pixel. Transparency is blended with
/// black, but for pixels that a mask keeps: those at the rim of an object would be darker than it.
fn to_rgb(pixels: DynamicImage) -> (Rgb, Option<Mask>) {
    let (width, height) = (pixels.width() as usize, pixels.height() as usize);
    let opaque =
        |pixels: DynamicImage| (Rgb { width, height, data: pixels.into_rgb8().into_raw() }, None);
    if !pixels.color().has_alpha() {
        return opaque(pixels);
    }
    let rgba = pixels.to_rgba8().into_raw();
    let alphas = || rgba.chunks_exact(4).map(|p| p[3]);
    let [least, most] = alphas().fold([u8::MAX, 0], |[least, most], a| [least.min(a), most.max(a)]);
    if least == most {
        return opaque(pixels);
    }
    let masks = least < ALPHA_KEPT;
    let over_black = |v: u8, a: u8| ((u32::from(v) * u32::from(a) + 127) / 255) as u8;
    let blend = |p: &[u8]| {
        let alpha = if masks && p[3] >= ALPHA_KEPT { u8::MAX } else { p[3] };
        [over_black(p[0], alpha), over_black(p[1], alpha), over_black(p[2], alpha)]
    };
    let data = rgba.chunks_exact(4).flat_map(blend).collect();
    let kept = || alphas().map(|alpha| alpha >= ALPHA_KEPT).collect();
    let mask = if masks { Mask::new(width, height, kept()) } else { None };
    (Rgb { width, height, data }, mask)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::image::probe;
    use crate::files::photos::photograph::{load_photograph, probe_photograph};

    fn read_bytes(bytes: &[u8]) -> (Rgb, Vec<String>, Option<Mask>) {
        let found = decode(bytes, &LoadOptions::default(), Path::new("a")).unwrap();
        (found.picture, found.warnings, found.mask)
    }

    /// An RGB TIFF of 2 pixels with a fourth band of 8 bits, and perhaps its `ExtraSamples`.
    fn four_bands(pixels: [[u8; 4]; 2], extra: Option<u16>) -> Vec<u8> {
        let mut entries = vec![
            [256, 3, 1, 2],
            [257, 3, 1, 1],
            [258, 3, 4, 0],
            [259, 3, 1, 1],
            [262, 3, 1, 2],
            [273, 4, 1, 0],
            [277, 3, 1, 4],
            [278, 3, 1, 1],
            [279, 4, 1, 8],
        ];
        entries.extend(extra.map(|value| [338, 3, 1, u32::from(value)]));
        let behind = 8 + 2 + 12 * entries.len() as u32 + 4;
        let mut bytes = b"II*\0\x08\0\0\0".to_vec();
        bytes.extend((entries.len() as u16).to_le_bytes());
        for [tag, kind, count, value] in entries {
            let value = match tag {
                258 => behind,
                273 => behind + 8,
                _ => value,
            };
            bytes.extend((tag as u16).to_le_bytes());
            bytes.extend((kind as u16).to_le_bytes());
            bytes.extend(count.to_le_bytes());
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([0, 0, 0, 0, 8, 0, 8, 0, 8, 0, 8, 0]);
        bytes.extend(pixels.as_flattened());
        bytes
    }

    #[test]
    fn a_fourth_band_is_an_alpha_by_its_tag() {
        let pixels = [[100, 60, 20, 200], [100, 60, 20, 0]];
        // Unspecified: near infrared, for example.
        let (picture, lines, mask) = read_bytes(&four_bands(pixels, Some(0)));
        assert_eq!((&picture.data[..], mask), (&[100, 60, 20, 100, 60, 20][..], None));
        assert!(lines.len() == 1 && lines[0].contains("is left out: the file"), "{lines:?}");
        for (extra, first) in
            [(Some(2), [100, 60, 20]), (None, [100, 60, 20]), (Some(1), [127, 76, 25])]
        {
            let (picture, lines, mask) = read_bytes(&four_bands(pixels, extra));
            assert_eq!(picture.data[..3], first, "{extra:?}");
            assert_eq!(mask.unwrap().kept(), [true, false], "{extra:?}");
            assert!(lines.len() == 1 && lines[0].contains("used as a mask"), "{lines:?}");
        }
    }

    #[test]
    fn an_alpha_that_is_the_same_everywhere_is_none() {
        for alpha in [0, 1, 128, 255] {
            let pixels = [[100, 60, 20, alpha], [90, 50, 10, alpha]];
            let (picture, lines, mask) = read_bytes(&four_bands(pixels, None));
            assert_eq!(picture.data, [100, 60, 20, 90, 50, 10], "{alpha}");
            assert!(mask.is_none() && lines.is_empty(), "{alpha}: {lines:?}");
        }
    }

    #[test]
    fn the_first_picture_of_a_stereo_file_is_read() {
        let jpeg = |size: u16, value: u8, mpf: bool| {
            let mut bytes = Vec::new();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
            if mpf {
                encoder.add_app_segment(2, b"MPF\0more".to_vec()).unwrap();
            }
            let data = vec![value; usize::from(size) * 8 * 3];
            encoder.encode(&data, size, 8, jpeg_encoder::ColorType::Rgb).unwrap();
            bytes
        };
        let stereo = [jpeg(16, 90, true), vec![0; 40], jpeg(16, 200, false)].concat();
        let (picture, lines, _) = read_bytes(&stereo);
        assert_eq!((picture.width, picture.data[0].abs_diff(90) < 2), (16, true));
        assert!(lines.len() == 1 && lines[0].contains("second picture"), "{lines:?}");
        // A smaller one is a preview or a gain map; without the segment, what follows is not looked at.
        for (first, second) in
            [(jpeg(16, 90, true), jpeg(8, 1, false)), (jpeg(16, 90, false), jpeg(16, 1, false))]
        {
            assert!(read_bytes(&[first, second].concat()).1.is_empty());
        }
    }

    /// A grey PNG of 1 bit, 16384 x 8192 (134 megapixels), white but for the left half of the upper half.
    fn large_png(path: &Path) {
        let file = std::fs::File::create(path).unwrap();
        let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), 16_384, 8192);
        encoder.set_depth(png::BitDepth::One);
        encoder.set_compression(png::Compression::Fastest);
        let mut writer = encoder.write_header().unwrap();
        let row = |y: usize| (0..2048).map(move |x| if y < 4096 && x < 1024 { 0 } else { 255 });
        writer.write_image_data(&(0..8192).flat_map(row).collect::<Vec<u8>>()).unwrap();
    }

    #[test]
    fn a_picture_beyond_100_megapixels_is_reduced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("large.png");
        large_png(&path);
        let found = load_photograph(&path, &LoadOptions::default()).unwrap();
        let at = |x: usize, y: usize| found.image.data[3 * (y * 8192 + x)];
        assert_eq!((found.image.width, found.image.height), (8192, 4096));
        assert_eq!([at(4095, 2047), at(4096, 2047), at(4095, 2048)], [0, 255, 255]);
        let line = "16384x8192 pixels are reduced to 8192x4096 while they are read";
        assert!(found.warnings.iter().any(|w| w.ends_with(line)), "{:?}", found.warnings);
        let header = probe_photograph(&path).unwrap();
        assert_eq!((header.width, header.height), (8192, 4096));
        assert!(header.warnings.iter().any(|w| w.ends_with(line)));
        // A header of more than a gigapixel, and a large picture without its pixels.
        let bytes = std::fs::read(&path).unwrap();
        let mut hostile = bytes.clone();
        hostile[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
        let crc = {
            let mut crc = flate2::Crc::new();
            crc.update(&hostile[12..29]);
            crc.sum()
        };
        hostile[29..33].copy_from_slice(&crc.to_be_bytes());
        std::fs::write(&path, &hostile).unwrap();
        for e in [
            probe(&path).unwrap_err(),
            load_photograph(&path, &LoadOptions::default()).unwrap_err(),
        ] {
            let e = e.to_string();
            assert!(e.contains("1000 megapixels") && e.contains("65536x65536"), "{e}");
        }
        let cut = decode(&bytes[..bytes.len() / 2], &LoadOptions::default(), Path::new("a"));
        assert!(cut.is_err());
    }
}
