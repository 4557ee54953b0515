//! Pictures of formats that this build does not decode: HEIC without feature `heic`, AVIF, JPEG XL without feature
//! `jxl`, and raw files. A program of the computer converts them (`programs.rs`); of a raw file the camera's own
//! JPEG is read where it is large enough (`raw.rs`).
//!
//! AVIF has no feature: `zenavif` and `rav1d-safe` are AGPL-3.0; `image`'s `avif-native` links to the C library
//! dav1d.
//!
//! Size, rotation, profile and EXIF come from the picture itself, never from the program: its result has to have
//! the size that the picture states, and is turned exactly once.

use super::decode::{Header, Raster, check_size, native};
use super::image::{LoadOptions, Probe};
use super::programs::{Installed, Kind, Output, Turned, installed};
use super::{heif, jxl, raw};
use crate::files::{Error, Result};
use image::DynamicImage;
use image::metadata::Orientation;
use std::borrow::Cow;
use std::io::Cursor;
use std::path::Path;

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Heic => "a HEIC picture",
            Self::Avif => "an AVIF picture",
            Self::Jxl => "a JPEG XL picture",
            Self::Raw => "a raw file of a camera without a large JPEG inside",
        }
    }

    /// Advice for a person without a program.
    fn advice(self) -> &'static str {
        match self {
            Self::Heic => {
                "install `libheif-examples` (heif-convert) or ImageMagick; or convert it to JPEG, on an iPhone for \
                 all further photographs by Settings > Camera > Formats > Most Compatible; or build with the \
                 feature `heic`"
            }
            Self::Avif => {
                "install `libavif-bin` (avifdec), `libheif-examples` (heif-convert) or ffmpeg; or convert it to \
                 JPEG or PNG"
            }
            Self::Jxl => {
                "install `libjxl-tools` (djxl) or ffmpeg; or convert it to JPEG or PNG; or build with the feature \
                 `jxl`"
            }
            Self::Raw => "install `libraw-bin` (dcraw_emu); or develop it to JPEG or TIFF",
        }
    }

    fn refused(self, got: impl std::fmt::Display, path: &Path) -> Error {
        Error::format(path, self.name(), got.to_string())
    }

    /// The programs.
    ///
    /// # Errors
    /// There is none.
    fn programs(self, path: &Path) -> Result<Installed> {
        let installed = installed(self);
        if !installed.is_empty() {
            return Ok(installed);
        }
        let got = format!("{}, which no program here converts ({})", self.name(), self.advice());
        Err(Error::format(path, super::decode::FORMATS, got))
    }
}

/// Reads size and EXIF without decoding the pixels, but for a raw file that a program has to develop.
pub(super) fn header(kind: Kind, bytes: &[u8], path: &Path) -> Result<Header> {
    let (size, exif) = match kind {
        Kind::Heic | Kind::Avif => {
            let primary = heif::primary(bytes).map_err(|got| kind.refused(got, path))?;
            (primary.upright, heif::exif(bytes))
        }
        Kind::Jxl => (jxl_size(bytes, path)?, jxl::exif(bytes).map(<[u8]>::to_vec)),
        Kind::Raw => return raw_header(bytes, path),
    };
    let [width, height] = size;
    check_size(width, height, path)?;
    kind.programs(path)?;
    let probe = Probe { width: width as usize, height: height as usize, orientation: None };
    Ok(Header { probe, exif, panorama: false, warnings: Vec::new() })
}

fn jxl_size(bytes: &[u8], path: &Path) -> Result<[u32; 2]> {
    let cut = || Kind::Jxl.refused("a file that ends before its size", path);
    jxl::upright_size(bytes).ok_or_else(cut)
}

fn raw_header(bytes: &[u8], path: &Path) -> Result<Header> {
    let (size, orientation, exif) = match raw::embedded(bytes) {
        Some(jpeg) => {
            let opened = super::decode::decoder(Box::new(Cursor::new(jpeg)), path)?;
            let mut decoder = opened.decoder;
            let Developed { orientation, exif } = developed(bytes, || {
                let exif = decoder.exif_metadata().ok().flatten();
                (decoder.orientation().unwrap_or(Orientation::NoTransforms), exif)
            });
            (decoder.dimensions(), orientation, exif.map(Cow::into_owned))
        }
        None => {
            let raster = decode(Kind::Raw, bytes, path, &mut Vec::new())?;
            let size = (raster.pixels.width(), raster.pixels.height());
            (size, raster.orientation, raster.exif.map(Cow::into_owned))
        }
    };
    let orientation = Some(orientation.to_exif()).filter(|o| *o > 1);
    let probe = Probe { width: size.0 as usize, height: size.1 as usize, orientation };
    Ok(Header { probe, exif, panorama: false, warnings: Vec::new() })
}

/// Orientation and EXIF block of a raw file.
struct Developed<'a> {
    orientation: Orientation,
    exif: Option<Cow<'a, [u8]>>,
}

/// The raw file's own, where it is a TIFF; else those of its JPEG.
fn developed<'a>(
    bytes: &'a [u8],
    of_jpeg: impl FnOnce() -> (Orientation, Option<Vec<u8>>),
) -> Developed<'a> {
    if super::tiff_tags::is_tiff(bytes) {
        let orientation = super::tiff_tags::numbers(bytes, super::tiff_tags::ORIENTATION);
        let code = orientation.and_then(|o| u8::try_from(*o.first()?).ok());
        let orientation = code.and_then(Orientation::from_exif);
        return Developed {
            orientation: orientation.unwrap_or(Orientation::NoTransforms),
            exif: Some(Cow::Borrowed(bytes)),
        };
    }
    let (orientation, exif) = of_jpeg();
    Developed { orientation, exif: exif.map(Cow::Owned) }
}

/// Decodes a picture.
pub(super) fn decode<'a>(
    kind: Kind,
    bytes: &'a [u8],
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<Raster<'a>> {
    match kind {
        Kind::Heic | Kind::Avif => heif_picture(kind, bytes, path, warnings),
        Kind::Jxl => jxl_picture(bytes, path, warnings),
        Kind::Raw => raw_picture(bytes, path, warnings),
    }
}

/// Converts a picture with a program, whose result `settle` brings to the upright pixels.
fn convert(
    kind: Kind,
    bytes: &[u8],
    path: &Path,
    warnings: &mut Vec<String>,
    settle: impl Fn(Raster<'static>, Turned) -> std::result::Result<Raster<'static>, String>,
) -> Result<Raster<'static>> {
    let accept = |output: Output| {
        // The path is in the error of all programs.
        let raster = native(&output.bytes, &LoadOptions::default(), path, &mut Vec::new());
        let raster = raster.map_err(|error| match error {
            Error::Format { got, .. } => got,
            Error::Io { source, .. } => source.to_string(),
        })?;
        settle(raster.into_owned(), output.turned).map(|raster| (raster, output.program))
    };
    let (raster, program) = kind.programs(path)?.convert(bytes, accept).map_err(|why| {
        kind.refused(format!("no conversion of it ({why}): {}", kind.advice()), path)
    })?;
    warnings.push(format!("{}: {} is converted by `{program}`", path.display(), kind.name()));
    Ok(raster)
}

fn size_of(pixels: &DynamicImage) -> [u32; 2] {
    [pixels.width(), pixels.height()]
}

/// Error of a result of the wrong size.
fn wrong_size(size: [u32; 2], expected: [u32; 2]) -> String {
    let ([w, h], [x, y]) = (size, expected);
    let tile = if w < x || h < y { ", a part of it" } else { "" };
    format!("it wrote {w}x{h} pixels of {x}x{y}{tile}")
}

/// The upright pixels of a program's result.
fn upright(
    raster: Raster<'_>,
    turned: Turned,
    primary: &heif::Primary,
) -> std::result::Result<DynamicImage, String> {
    let size = size_of(&raster.pixels);
    if turned == Turned::ByTag {
        let mut pixels = raster.pixels;
        let already = size == primary.upright && primary.size_tells();
        if !already {
            pixels.apply_orientation(raster.orientation);
        }
        let size = size_of(&pixels);
        return if size == primary.upright {
            Ok(pixels)
        } else {
            Err(wrong_size(size, primary.upright))
        };
    }
    if primary.size_tells() && size == primary.unturned {
        return Ok(primary.turn(raster.pixels));
    }
    if size != primary.upright {
        return Err(wrong_size(size, primary.upright));
    }
    if turned == Turned::Unknown && !primary.size_tells() && !primary.is_plain() {
        return Err("its rotation of this picture is uncertain".to_owned());
    }
    Ok(raster.pixels)
}

fn heif_picture(
    kind: Kind,
    bytes: &[u8],
    path: &Path,
    warnings: &mut Vec<String>,
) -> Result<Raster<'static>> {
    let primary = heif::primary(bytes).map_err(|got| kind.refused(got, path))?;
    for [width, height] in [primary.coded, primary.upright] {
        check_size(width, height, path)?;
    }
    let settle = |raster: Raster<'static>, turned| {
        let profile = raster.profile.clone();
        let pixels = upright(raster, turned, &primary)?;
        Ok(Raster { profile, ..Raster::of(pixels) })
    };
    let raster = convert(kind, bytes, path, warnings, settle)?;
    let exif = heif::exif(bytes);
    if let Some([_, transfer]) = primary.coding {
        warnings.extend(heif::hdr_warning(transfer, path));
    }
    warnings.extend(heif::orientation_warning(exif.as_deref(), primary.is_plain(), path));
    // Programs that write no profile keep the values: the picture's own profile describes them.
    let profile = raster.profile.or(primary.profile).or_else(|| {
        let is_p3 = primary.coding.is_some_and(|[p, _]| p == heif::PRIMARIES_DISPLAY_P3);
        is_p3.then(heif::display_p3).flatten()
    });
    Ok(Raster { profile, exif: exif.map(Cow::Owned), ..Raster::of(raster.pixels) })
}

fn jxl_picture<'a>(bytes: &'a [u8], path: &Path, warnings: &mut Vec<String>) -> Result<Raster<'a>> {
    let size = jxl_size(bytes, path)?;
    check_size(size[0], size[1], path)?;
    let settle = |raster: Raster<'static>, _| {
        let (profile, found) = (raster.profile, size_of(&raster.pixels));
        if found != size {
            return Err(wrong_size(found, size));
        }
        Ok(Raster { profile, ..Raster::of(raster.pixels) })
    };
    let raster = convert(Kind::Jxl, bytes, path, warnings, settle)?;
    Ok(Raster { exif: jxl::exif(bytes).map(Cow::Borrowed), ..raster })
}

fn raw_picture<'a>(bytes: &'a [u8], path: &Path, warnings: &mut Vec<String>) -> Result<Raster<'a>> {
    if let Some(jpeg) = raw::embedded(bytes) {
        let raster = native(jpeg, &LoadOptions::default(), path, warnings)?.into_owned();
        let [width, height] = size_of(&raster.pixels);
        let Raster { pixels, profile, orientation, exif, panorama } = raster;
        let exif = exif.map(Cow::into_owned);
        let Developed { orientation, exif } = developed(bytes, || (orientation, exif));
        warnings.push(format!(
            "{}: of the raw file, the camera's own JPEG of {width}x{height} inside it is read",
            path.display()
        ));
        return Ok(Raster { pixels, profile, orientation, exif, panorama });
    }
    let settle = |raster: Raster<'static>, turned| {
        let (profile, mut pixels) = (raster.profile, raster.pixels);
        if turned == Turned::ByTag {
            pixels.apply_orientation(raster.orientation);
        }
        Ok(Raster { profile, ..Raster::of(pixels) })
    };
    let raster = convert(Kind::Raw, bytes, path, warnings, settle)?;
    // The EXIF block belongs to the unturned pixels; its focal length holds for both.
    let exif = super::tiff_tags::is_tiff(bytes).then_some(Cow::Borrowed(bytes));
    Ok(Raster { exif, ..raster })
}

#[cfg(all(test, unix))]
mod tests {
    use super::super::heif::tests::{container, file, part};
    use super::super::photograph::{parse_photograph, probe_photograph};
    use super::super::programs::TEST_PATH;
    use super::super::programs::tests::folder;
    use super::*;
    use image::{ImageEncoder, RgbImage};

    /// A PNG of `size` with a value in each pixel, and perhaps an EXIF orientation.
    fn png(size: [u32; 2], orientation: u16) -> Vec<u8> {
        let picture = RgbImage::from_fn(size[0], size[1], |x, y| image::Rgb([x as u8, y as u8, 7]));
        let mut bytes = Vec::new();
        let mut encoder = image::codecs::png::PngEncoder::new(&mut bytes);
        let [low, high] = orientation.to_le_bytes();
        let exif =
            [b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(), &[low, high], &[0; 6]];
        encoder.set_exif_metadata(exif.concat()).unwrap();
        let kind = image::ExtendedColorType::Rgb8;
        encoder.write_image(picture.as_raw(), size[0], size[1], kind).unwrap();
        bytes
    }

    /// Decodes `bytes` with one program that writes `result` as `output`.
    fn converted(
        kind: Kind,
        bytes: &[u8],
        [program, output]: [&str; 2],
        result: &[u8],
    ) -> std::result::Result<(RgbImage, Vec<String>), String> {
        let results = tempfile::tempdir().unwrap();
        let at = results.path().join("result");
        std::fs::write(&at, result).unwrap();
        let folder = folder(&[(program, &format!("cp '{}' {output}", at.display()))]);
        TEST_PATH.set(Some(folder.path().into()));
        let mut warnings = Vec::new();
        let found = decode(kind, bytes, Path::new("-photo"), &mut warnings);
        TEST_PATH.set(None);
        let raster = found.map_err(|e| e.to_string())?;
        assert_eq!(raster.orientation, Orientation::NoTransforms);
        Ok((raster.pixels.into_rgb8(), warnings))
    }

    #[test]
    fn without_a_program_the_error_says_what_to_do() {
        TEST_PATH.set(Some(Default::default()));
        let bytes = file("rotated.heic");
        let errors = [
            decode(Kind::Heic, &bytes, Path::new("-photo"), &mut Vec::new()).err().unwrap(),
            header(Kind::Heic, &bytes, Path::new("-photo")).err().unwrap(),
        ];
        TEST_PATH.set(None);
        for e in errors.map(|e| e.to_string()) {
            let words = ["-photo", "HEIC", "libheif-examples", "Most Compatible", "feature `heic`"];
            assert!(words.iter().all(|word| e.contains(word)), "{e}");
        }
    }

    #[test]
    fn a_picture_is_turned_once_and_has_its_own_size() {
        let rotated = file("rotated.heic");
        let upright = |x, y| image::Rgb([x, y, 7]);
        // Programs of libheif write upright pixels, whatever tag they leave in the result.
        for tag in [1, 6] {
            let program = ["heif-convert", "out.png"];
            let (found, warnings) =
                converted(Kind::Heic, &rotated, program, &png([48, 64], tag)).unwrap();
            assert_eq!((found.dimensions(), found.get_pixel(0, 5)), ((48, 64), &upright(0, 5)));
            assert_eq!(warnings, ["-photo: a HEIC picture is converted by `heif-convert`"]);
        }
        // The turn of the container (90 degrees clockwise), where the size tells that it is missing.
        for program in [["ffmpeg", "out.png"], ["avifdec", "out-1.png"]] {
            let kind = if program[0] == "ffmpeg" { Kind::Heic } else { Kind::Avif };
            let (found, _) = converted(kind, &rotated, program, &png([64, 48], 1)).unwrap();
            assert_eq!((found.dimensions(), found.get_pixel(0, 0)), ((48, 64), &upright(0, 47)));
            let (found, _) = converted(kind, &rotated, program, &png([48, 64], 1)).unwrap();
            assert_eq!(found.get_pixel(0, 0), &upright(0, 0));
        }
        // The tag of the result, unless it is upright already.
        for (size, corner) in [([64, 48], [0, 47]), ([48, 64], [0, 0])] {
            let program = ["sips", "out.tif"];
            let (found, _) = converted(Kind::Heic, &rotated, program, &png(size, 6)).unwrap();
            assert_eq!(
                (found.dimensions(), found.get_pixel(0, 0)),
                ((48, 64), &upright(corner[0], corner[1]))
            );
        }
        // A half turn, which no size tells.
        let half = container([64, 48], &[part(b"irot", &[2])]);
        let e = converted(Kind::Heic, &half, ["ffmpeg", "out.png"], &png([64, 48], 1)).unwrap_err();
        assert!(e.contains("ffmpeg: its rotation of this picture is uncertain"), "{e}");
        assert!(converted(Kind::Heic, &half, ["magick", "out.png"], &png([64, 48], 1)).is_ok());
    }

    #[test]
    fn a_tile_and_a_broken_result_are_refused() {
        let rotated = file("rotated.heic");
        for program in [["ffmpeg", "out.png"], ["heif-dec", "out.png"], ["sips", "out.tif"]] {
            let e = converted(Kind::Heic, &rotated, program, &png([32, 32], 1)).unwrap_err();
            let expected = format!("{}: it wrote 32x32 pixels of 48x64, a part of it", program[0]);
            assert!(e.contains(&expected) && e.contains("Most Compatible"), "{e}");
        }
        let whole = png([48, 64], 1);
        for result in [&b""[..], b"text", &whole[..whole.len() / 2]] {
            let e = converted(Kind::Heic, &rotated, ["heif-dec", "out.png"], result).unwrap_err();
            assert!(e.contains("-photo") && e.contains("heif-dec: "), "{e}");
        }
        // A container that states a size of a gigapixel starts no program.
        let large = container([40_000, 40_000], &[]);
        let e = converted(Kind::Heic, &large, ["heif-dec", "out.png"], &whole).unwrap_err();
        assert!(e.contains("megapixels") && e.contains("40000x40000"), "{e}");
    }

    #[test]
    fn jpeg_xl_has_the_size_of_its_start() {
        // 16 x 16: small sides, no ratio.
        let bytes = [0xff, 0x0a, 0b0000_0011, 0b0000_0010, 0, 0];
        let size = jxl::upright_size(&bytes).unwrap();
        let (found, warnings) =
            converted(Kind::Jxl, &bytes, ["djxl", "out.png"], &png(size, 1)).unwrap();
        assert_eq!(found.dimensions(), (size[0], size[1]));
        assert!(warnings[0].contains("`djxl`"));
        let e = converted(Kind::Jxl, &bytes, ["djxl", "out.png"], &png([5, 5], 1)).unwrap_err();
        assert!(e.contains("it wrote 5x5 pixels"), "{e}");
        assert!(converted(Kind::Jxl, &bytes[..3], ["djxl", "out.png"], b"").is_err());
    }

    #[test]
    fn of_a_raw_file_the_jpeg_of_the_camera_is_read() {
        let mut jpeg = Vec::new();
        let data: Vec<u8> = (0..1700 * 20).flat_map(|i| [(i % 1700 / 7) as u8; 3]).collect();
        let encoder = jpeg_encoder::Encoder::new(&mut jpeg, 90);
        encoder.encode(&data, 1700, 20, jpeg_encoder::ColorType::Rgb).unwrap();
        // Orientation 6 and DNGVersion.
        let mut raw = b"II*\0\x08\0\0\0\x02\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0".to_vec();
        raw.extend(b"\x12\xc6\x01\0\x04\0\0\0\x01\x04\0\0\0\0\0\0");
        raw.extend(&jpeg);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.dng");
        std::fs::write(&path, &raw).unwrap();
        TEST_PATH.set(Some(Default::default()));
        let found = parse_photograph(&raw, &LoadOptions::default(), &path);
        let header = probe_photograph(&path);
        // Without the JPEG, there is a program or an error.
        let cut = parse_photograph(&raw[..60], &LoadOptions::default(), &path);
        TEST_PATH.set(None);
        let (found, header) = (found.unwrap(), header.unwrap());
        assert_eq!((found.image.width, found.image.height, found.orientation), (20, 1700, Some(6)));
        assert_eq!((header.width, header.height, header.orientation), (20, 1700, Some(6)));
        assert!(
            found.warnings.iter().any(|w| w.contains("own JPEG of 1700x20")),
            "{:?}",
            found.warnings
        );
        let e = cut.unwrap_err().to_string();
        assert!(e.contains("a.dng") && e.contains("dcraw_emu"), "{e}");
        let developed = png([30, 20], 1);
        let program = ["dcraw_emu", "in.raw.tiff"];
        let (found, _) = converted(Kind::Raw, &raw[..60], program, &developed).unwrap();
        assert_eq!(found.dimensions(), (30, 20));
    }
}
