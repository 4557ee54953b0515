//! Decoding of picture files to stored sRGB pixels, with the metadata that photographs need.
//!
//! Steps: detect the format by content, refuse truncated JPEG files and CMYK of unknown
//! polarity, decode, convert an embedded ICC profile to sRGB, make a mask of an alpha channel or blend
//! transparency with black, round to 8 bits.

use super::image::{LoadOptions, MAX_PIXELS, Probe, Truncated};
use super::{heic, icc, jpeg};
use crate::files::{Error, Result, read};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

/// The formats, for messages.
const FORMATS: &str = if cfg!(feature = "heic") {
    "a PNG, JPEG, WebP, TIFF, BMP or HEIC picture"
} else {
    "a PNG, JPEG, WebP, TIFF or BMP picture"
};

/// A picture file, decoded.
pub(super) struct Decoded<'a> {
    /// Stored pixels, sRGB.
    pub picture: Rgb,
    /// Stored pixels that the alpha channel keeps, where it masks some.
    pub mask: Option<Mask>,
    /// EXIF orientation; `NoTransforms` for HEIC, whose decoder applies the file's rotation.
    pub orientation: Orientation,
    /// EXIF block: a TIFF structure.
    pub exif: Option<Cow<'a, [u8]>>,
    /// The metadata state an equirectangular panorama.
    pub panorama: bool,
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
        e => Error::format(path, FORMATS, e.to_string()),
    }
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

/// A file or its bytes. One type for both: the decoders are generic, and are then compiled once.
pub(super) trait Input: BufRead + Seek {}

impl<R: BufRead + Seek> Input for R {}

/// Opens a decoder and checks the size. The content selects the decoder, not the file's
/// extension.
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
    check_size(w, h, path)?;
    Ok(Opened { decoder: Box::new(decoder), format })
}

/// Refuses empty files and formats that no decoder reads. Returns `true` for HEIC.
fn is_heic(start: &[u8], path: &Path) -> Result<bool> {
    if start.is_empty() {
        return Err(Error::format(path, FORMATS, "an empty file"));
    }
    match heic::brand(start) {
        Some(heic::Brand::Avif) => {
            Err(Error::format(path, FORMATS, "an AVIF picture (convert it to JPEG or PNG first)"))
        }
        Some(heic::Brand::Heic) => Ok(true),
        None => Ok(false),
    }
}

/// Reads size, orientation and EXIF of a file without decoding its pixels.
pub(super) fn header(path: &Path) -> Result<Header> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let mut reader = BufReader::new(file);
    let heic = is_heic(reader.fill_buf().map_err(|e| Error::io(path, e))?, path)?;
    if heic {
        return heic::header(&read(path)?, path);
    }
    let Opened { mut decoder, format } = decoder(Box::new(reader), path)?;
    let (width, height) = decoder.dimensions();
    // A picture with a malformed EXIF block still decodes.
    let orientation = decoder.orientation().map_or(1, Orientation::to_exif);
    let exif = match format {
        ImageFormat::Tiff => Some(read(path)?),
        _ => decoder.exif_metadata().ok().flatten(),
    };
    let orientation = (orientation > 1).then_some(orientation);
    let probe = Probe { width: width as usize, height: height as usize, orientation };
    let panorama = is_panorama(&mut *decoder);
    Ok(Header { probe, exif, panorama })
}

/// Decodes the bytes of a picture file; `path` is for messages.
pub(super) fn decode<'a>(
    bytes: &'a [u8],
    options: &LoadOptions,
    path: &Path,
) -> Result<Decoded<'a>> {
    let mut warnings = Vec::new();
    let heic = is_heic(bytes, path)?;
    let mut panorama = false;
    let (mut pixels, profile, orientation, exif) = if heic {
        let heic::Pixels { pixels, profile, exif } = heic::decode(bytes, path, &mut warnings)?;
        (pixels, profile, Orientation::NoTransforms, exif.map(Cow::Owned))
    } else {
        if jpeg::is_jpeg(bytes) {
            check_jpeg(bytes, options, path, &mut warnings)?;
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
        panorama = is_panorama(&mut *decoder);
        let pixels = DynamicImage::from_decoder(decoder).map_err(|e| refused(path, e))?;
        (pixels, profile, orientation, exif)
    };
    if let Some(profile) = profile
        && let Err(reason) = icc::to_srgb(&mut pixels, &profile)
    {
        warnings.push(format!(
            "{}: the ICC profile is ignored and the colours are read as sRGB: {reason}",
            path.display()
        ));
    }
    let (picture, mask) = to_rgb(pixels);
    Ok(Decoded { picture, mask, orientation, exif, panorama, warnings })
}

/// Returns whether the XMP block states an equirectangular panorama: GPano's `ProjectionType`, which cameras,
/// phones and stitchers write (Google, "Photo Sphere XMP Metadata").
fn is_panorama(decoder: &mut dyn ImageDecoder) -> bool {
    let block = decoder.xmp_metadata().ok().flatten().unwrap_or_default();
    let text = String::from_utf8_lossy(&block);
    let value = text.split("ProjectionType").nth(1).unwrap_or_default();
    value.trim_start_matches(['=', '>', '"', '\'', ' ']).starts_with("equirectangular")
}

/// Checks what the JPEG decoder does not: the end of the file and the kind of CMYK.
fn check_jpeg(
    bytes: &[u8],
    options: &LoadOptions,
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let layout = jpeg::layout(bytes);
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

/// Rounds to 8 bits, and makes a mask of an alpha channel. An alpha of 0 everywhere is no alpha: some writers
/// of BMP and TIFF leave a fourth band of zeros. A mask is an alpha that is not the same everywhere and masks
/// a pixel. Transparency is blended with black, but for pixels that a mask keeps: those at the rim of an
/// object would be darker than it.
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
    if most == 0 {
        return opaque(pixels);
    }
    let masks = least < ALPHA_KEPT && least < most;
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
