//! Photographs without a pose file, from a phone or a camera.
//!
//! A [`Photograph`] is upright: its EXIF orientation is applied. `image.rs` keeps the stored
//! pixels instead, to which pose files refer. The EXIF block also gives the focal length
//! (`exif.rs`).
//!
//! ICC profiles are applied to both kinds of pictures: a wrong colour is wrong for every reader.

use super::decode::{self, Header, decode_photograph};
use super::exif::{ExifCamera, ExifReport, Shot, parse_exif};
use super::image::{LoadOptions, Probe};
use super::masks;
use crate::files::poses::assemble::list_images;
use crate::files::{Error, Result, read};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use image::metadata::Orientation;
use image::{DynamicImage, RgbImage};
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::Intrinsics;

/// A photograph with upright pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Photograph {
    /// Upright pixels, sRGB.
    pub image: Rgb,
    /// Pixels that count, of [`Photograph::image`]; `None` where all do. It comes from the alpha channel (128
    /// and above is kept), and from a file in a folder `masks` beside `images` or among the photographs:
    /// `masks/NAME.jpg.png` or `masks/NAME.png`, 0 is masked.
    pub mask: Option<Mask>,
    /// The EXIF orientation that was applied, 2 to 8; `None` if the stored pixels are upright.
    pub orientation: Option<u8>,
    /// The camera of the EXIF block. Its focal length is in px of [`Photograph::image`].
    pub camera: ExifCamera,
    /// Warnings for the user, one line each, with the file's path.
    pub warnings: Vec<String>,
}

/// Header of a photograph: everything but the pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotographHeader {
    /// Width after the orientation is applied, px.
    pub width: usize,
    /// Height after the orientation is applied, px.
    pub height: usize,
    /// The EXIF orientation that [`load_photograph`] applies, 2 to 8.
    pub orientation: Option<u8>,
    /// The camera of the EXIF block. Its focal length is in px of `width` × `height`.
    pub camera: ExifCamera,
    /// Time and exposure in the EXIF block.
    pub shot: Option<Shot>,
    /// The metadata state an equirectangular panorama, which has no focal length.
    pub panorama: bool,
    /// Warnings for the user, one line each, with the file's path.
    pub warnings: Vec<String>,
}

/// Makes intrinsics with square pixels and the principal point in the middle.
fn intrinsics(camera: &ExifCamera, width: usize, height: usize) -> Option<Intrinsics> {
    let f = camera.focal?.px as f32;
    let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
    Some(Intrinsics { fx: f, fy: f, cx, cy, width, height })
}

impl Photograph {
    /// Upright sRGB pixels (an [`Rgb`] or an `image::RgbImage`) of a photograph in memory, about whose
    /// camera nothing is known.
    pub fn from_pixels(image: impl Into<Rgb>) -> Self {
        let image = image.into();
        let camera = ExifCamera::default();
        Self { image, mask: None, orientation: None, camera, warnings: Vec::new() }
    }

    /// The same photograph with a mask of its pixels, in place of its own one.
    ///
    /// # Errors
    /// A mask of another size than the photograph's, or that keeps no pixel.
    pub fn with_mask(self, mask: Mask) -> Result<Self> {
        if !mask.fits(&self.image) {
            let expected = format!("a mask of {}x{}", self.image.width, self.image.height);
            let got = format!("{}x{}", mask.width(), mask.height());
            return Err(Error::format("photograph", expected, got));
        }
        Ok(Self { mask: masks::checked(Some(mask), Path::new("photograph"))?, ..self })
    }

    /// Returns intrinsics of EXIF's focal length, px, with the principal point in the middle;
    /// `None` if EXIF does not determine it.
    pub fn intrinsics(&self) -> Option<Intrinsics> {
        intrinsics(&self.camera, self.image.width, self.image.height)
    }
}

impl PhotographHeader {
    /// Returns the intrinsics as [`Photograph::intrinsics`] does.
    pub fn intrinsics(&self) -> Option<Intrinsics> {
        intrinsics(&self.camera, self.width, self.height)
    }
}

/// Lists the photographs of a folder, by name with numbers in numeric order; without any, those of
/// its folder `images`.
pub fn list_photographs(folder: impl AsRef<Path>) -> Vec<PathBuf> {
    let folder = folder.as_ref();
    let own = list_images(folder);
    if own.is_empty() { list_images(&folder.join("images")) } else { own }
}

/// Reads the header of a photograph.
///
/// # Errors
/// Those of [`super::image::probe`].
pub fn probe_photograph(path: impl AsRef<Path>) -> Result<PhotographHeader> {
    let path = path.as_ref();
    let Header { probe, exif, panorama, warnings: mut notes } = decode::header(path)?;
    let orientation = probe.orientation;
    let Probe { width, height, .. } = probe.upright();
    let ExifReport { mut camera, shot, warnings } = report(exif.as_deref(), width, height, path);
    notes.extend(warnings);
    if panorama {
        camera.focal = None;
    } else {
        notes.extend(panorama_shape(&camera, width, height, path));
    }
    Ok(PhotographHeader { width, height, orientation, camera, shot, panorama, warnings: notes })
}

/// Decodes a photograph with its mask and turns it upright. A mask file that is missing, cannot be read or has
/// another shape gives a warning.
///
/// # Errors
/// Those of [`super::image::load_with`]; a photograph that is masked entirely; a panorama, by its metadata.
pub fn load_photograph(path: impl AsRef<Path>, options: &LoadOptions) -> Result<Photograph> {
    let path = path.as_ref();
    let mask = masks::of_photograph(path);
    no_panorama(decode_upright(&read(path)?, options, path, mask.as_deref())?, path)
}

/// A photograph with what the file says of its projection.
pub(crate) type PhotographOrPanorama = (Photograph, bool);

/// [`load_photograph`] of photographs and panoramas; `true` for a panorama by its metadata. A part of a panorama becomes
/// the whole, masked around it. There is no warning of the shape of a panorama.
///
/// # Errors
/// Those of [`load_photograph`] but for panoramas.
pub(crate) fn load_photograph_or_panorama(
    path: &Path,
    options: &LoadOptions,
) -> Result<PhotographOrPanorama> {
    decode_upright(&read(path)?, options, path, masks::of_photograph(path).as_deref())
}

/// The photograph with a warning of the shape of a panorama.
///
/// # Errors
/// A panorama by its metadata.
fn no_panorama(
    (mut photograph, panorama): PhotographOrPanorama,
    path: &Path,
) -> Result<Photograph> {
    if panorama {
        return Err(Error::format(
            path,
            "a photograph with straight lines",
            "a panorama (equirectangular), which cannot have given cameras here: leave them out so that they are \
             estimated, or give transforms.json with camera_model EQUIRECTANGULAR",
        ));
    }
    let Rgb { width, height, .. } = photograph.image;
    photograph.warnings.extend(panorama_shape(&photograph.camera, width, height, path));
    Ok(photograph)
}

/// Decodes bytes in memory as [`load_photograph`] does, without a mask file; `path` is for messages.
///
/// # Errors
/// As [`load_photograph`].
pub fn parse_photograph(
    bytes: &[u8],
    options: &LoadOptions,
    path: impl AsRef<Path>,
) -> Result<Photograph> {
    let path = path.as_ref();
    no_panorama(decode_upright(bytes, options, path, None)?, path)
}

fn decode_upright(
    bytes: &[u8],
    options: &LoadOptions,
    path: &Path,
    mask_file: Option<&Path>,
) -> Result<PhotographOrPanorama> {
    let decoded = decode_photograph(bytes, options, path)?;
    let Rgb { width, height, .. } = decoded.picture;
    let mut report = report(decoded.exif.as_deref(), width, height, path);
    if decoded.panorama.is_some() {
        report.camera.focal = None;
    }
    let image = upright(decoded.picture, decoded.orientation)?;
    let orientation = Some(decoded.orientation.to_exif()).filter(|o| *o > 1);
    let mut warnings = decoded.warnings;
    warnings.extend(report.warnings);
    let probe = Probe { width, height, orientation };
    let mask = match mask_file.map(|file| masks::load(file, &probe)) {
        Some(Ok((mask, line))) => {
            warnings.extend(line.map(|line| format!("{}: {line}", path.display())));
            masks::both(decoded.mask, Some(mask))
        }
        Some(Err(error)) => {
            warnings.push(format!("{}: all of its pixels are used: {error}", path.display()));
            decoded.mask
        }
        None => decoded.mask,
    };
    let mask = mask.and_then(|mask| match orientation {
        Some(_) => masks::oriented(&mask, decoded.orientation),
        None => Some(mask),
    });
    let mask = masks::checked(mask, path)?;
    let camera = report.camera;
    let place = decoded.panorama.and_then(|of| of.place(width, height));
    let (image, mask) = match place.filter(|_| orientation.is_none()) {
        Some(place) => place.whole(&image, mask.as_ref()),
        None => (image, mask),
    };
    let panorama = decoded.panorama.is_some();
    Ok((Photograph { image, mask, orientation, camera, warnings }, panorama))
}

/// Applies an EXIF orientation.
fn upright(picture: Rgb, orientation: Orientation) -> Result<Rgb> {
    if orientation == Orientation::NoTransforms {
        return Ok(picture);
    }
    let mut pixels = DynamicImage::ImageRgb8(RgbImage::try_from(picture)?);
    pixels.apply_orientation(orientation);
    Ok(pixels.into_rgb8().into())
}

/// Least width of a picture that may be a panorama, px.
const PANORAMA_MIN: usize = 1000;

/// A warning of the shape of a panorama, of a photograph whose focal length is not known.
pub(crate) fn panorama_shape(
    camera: &ExifCamera,
    width: usize,
    height: usize,
    path: &Path,
) -> Option<String> {
    let panorama = width == 2 * height && width >= PANORAMA_MIN && camera.focal.is_none();
    panorama.then(|| {
        format!(
            "{}: {width}x{height} pixels are the shape of a panorama, but nothing else says so: it is read as a \
             photograph; --lens panorama reads it as a panorama",
            path.display()
        )
    })
}

/// Reads the EXIF block and adds the path to its warnings.
fn report(block: Option<&[u8]>, width: usize, height: usize, path: &Path) -> ExifReport {
    let mut report = block.map(|b| parse_exif(b, width, height)).unwrap_or_default();
    for warning in &mut report.warnings {
        *warning = format!("{}: {warning}", path.display());
    }
    report
}
