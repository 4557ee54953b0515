//! HEIC pictures (HEVC in the HEIF container), through `heic-rs` with feature `heic`; without it a program converts
//! them (`converted.rs`).
//!
//! The decoder applies the container's crop, rotation and mirroring (`clap`, `irot`, `imir`).
//! The EXIF orientation of a HEIC file repeats them and is not applied (ISO/IEC 23008-12,
//! 6.5.10). "Stored pixels" of a HEIC file are therefore its upright pixels.

/// Kind of a HEIF container.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Brand {
    /// HEVC, or a container that does not name its codec.
    Heic,
    /// AV1.
    Avif,
}

/// Reads the brands of the `ftyp` box at the start of a file; `None` for other containers.
pub(super) fn brand(start: &[u8]) -> Option<Brand> {
    const HEVC: [&[u8]; 8] =
        [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs"];
    let length = u32::from_be_bytes(start.get(..4)?.try_into().ok()?) as usize;
    if start.get(4..8)? != b"ftyp" {
        return None;
    }
    let content = &start[8..length.clamp(8, start.len())];
    // The major brand, a version number, and the compatible brands.
    let mut brands = content.chunks_exact(4).enumerate().filter(|(i, _)| *i != 1).map(|(_, b)| b);
    if brands.clone().any(|b| b == b"avif" || b == b"avis") {
        return Some(Brand::Avif);
    }
    brands.any(|b| HEVC.contains(&b) || b == b"mif1" || b == b"msf1").then_some(Brand::Heic)
}

#[cfg(feature = "heic")]
pub(super) use supported::{decode, header};

#[cfg(feature = "heic")]
mod supported {
    use super::super::decode::{Header, Raster, check_size};
    use super::super::heif::{PRIMARIES_DISPLAY_P3, display_p3, hdr_warning, orientation_warning};
    use super::super::image::{MAX_PIXELS, Probe};
    use crate::files::{Error, Result};
    use heic_rs::context::Context;
    use heic_rs::hevc::{self, Frame};
    use heic_rs::{MatrixCoefficients, Mirror, Nclx, PixelLayout, Range, Transform};
    use image::{DynamicImage, ImageBuffer};
    use rayon::prelude::*;
    use std::borrow::Cow;
    use std::path::Path;

    fn refused(path: &Path, error: &heic_rs::Error) -> Error {
        Error::format(path, "a HEIC picture", error.to_string())
    }

    /// Reads size and EXIF without decoding the pixels.
    pub fn header(bytes: &[u8], path: &Path) -> Result<Header> {
        let info = heic_rs::probe(bytes).map_err(|e| refused(path, &e))?;
        check_size(info.width, info.height, path)?;
        let (width, height) = (info.width as usize, info.height as usize);
        let probe = Probe { width, height, orientation: None };
        let context = Context::open(bytes).map_err(|e| refused(path, &e))?;
        Ok(Header { probe, exif: exif(&context), panorama: false, warnings: Vec::new() })
    }

    /// A picture with a malformed EXIF block still decodes.
    fn exif(context: &Context<'_>) -> Option<Vec<u8>> {
        context.exif(context.meta.primary).ok().flatten().map(<[u8]>::to_vec)
    }

    /// Decodes one coded picture.
    fn decode_item(context: &Context<'_>, item: u32) -> heic_rs::Result<Frame> {
        let properties = context.props(item)?;
        let configuration = properties.hvcc.as_ref().ok_or(heic_rs::Error::MissingBox("hvcC"))?;
        let data = context.item_data(item)?;
        let frame =
            hevc::decode_still(&configuration.parameter_sets(), &configuration.split_nals(&data)?)?;
        frame.validate()?;
        Ok(frame)
    }

    /// Decodes the primary picture, or the tiles of which it consists.
    fn decode_primary(context: &Context<'_>, item: u32) -> heic_rs::Result<Frame> {
        let Some((grid, tiles)) = context.grid(item)? else { return decode_item(context, item) };
        let tiles: heic_rs::Result<Vec<Frame>> =
            tiles.par_iter().map(|tile| decode_item(context, *tile)).collect();
        heic_rs::grid::compose(&grid, &tiles?, MAX_PIXELS)
    }

    /// Matrix and range of the coded colours.
    ///
    /// `heic-rs` assumes BT.709 of limited range where the container does not tell, and does not
    /// read the bitstream's own tags. iPhones leave it to those tags: BT.601 of full range,
    /// which is libheif's default too. The file's ICC profile then describes the RGB colours.
    fn coding(nclx: Option<Nclx>) -> Nclx {
        let matrix = MatrixCoefficients::Bt601;
        match nclx {
            None => Nclx { matrix, matrix_code: 6, range: Range::Full, ..Nclx::default() },
            Some(nclx) if nclx.matrix == MatrixCoefficients::Unspecified => {
                Nclx { matrix, matrix_code: 6, ..nclx }
            }
            Some(nclx) => nclx,
        }
    }

    /// Exchanges the two kinds of mirroring.
    ///
    /// ISO/IEC 23008-12:2022 defines axis 0 of `imir` as the exchange of top and bottom, and
    /// iPhones and libheif write it so. `heic-rs` 0.1.4 follows the other reading of the edition
    /// of 2017.
    fn transform(transform: Transform) -> Transform {
        match transform {
            Transform::Mirror(Mirror::LeftRight) => Transform::Mirror(Mirror::TopBottom),
            Transform::Mirror(Mirror::TopBottom) => Transform::Mirror(Mirror::LeftRight),
            other => other,
        }
    }

    /// Decodes the primary picture.
    pub fn decode<'a>(bytes: &[u8], path: &Path, warnings: &mut Vec<String>) -> Result<Raster<'a>> {
        let refused = |e: heic_rs::Error| refused(path, &e);
        let info = heic_rs::probe(bytes).map_err(refused)?;
        check_size(info.width, info.height, path)?;
        check_size(info.coded_width, info.coded_height, path)?;
        let context = Context::open(bytes).map_err(refused)?;
        let item = context.meta.primary;
        let properties = context.props(item).map_err(refused)?;
        let transforms: Vec<_> = properties.transforms.iter().map(|t| transform(*t)).collect();
        let frame = decode_primary(&context, item).map_err(refused)?;
        let layout = PixelLayout::Rgb8;
        let limit = MAX_PIXELS;
        let coding = coding(properties.nclx);
        let decoded = heic_rs::color::convert(&frame, None, coding, layout, limit, None)
            .and_then(|image| heic_rs::transform::apply_all(image, &transforms))
            .map_err(refused)?;
        check_size(decoded.width, decoded.height, path)?;
        let (width, height, data) = (decoded.width, decoded.height, decoded.data);
        let pixels = ImageBuffer::from_raw(width, height, data).ok_or_else(|| {
            let expected = format!("the pixels of a {width}x{height} picture");
            Error::format(path, expected, "another number of them")
        })?;
        let pixels = DynamicImage::ImageRgb8(pixels);
        let exif = exif(&context);
        if info.has_exif && exif.is_none() {
            warnings.push(format!("{}: the EXIF block cannot be read", path.display()));
        }
        if info.has_alpha {
            warnings.push(format!("{}: the transparency is ignored", path.display()));
        }
        if let Some(nclx) = properties.nclx {
            warnings.extend(hdr_warning(nclx.transfer, path));
        }
        let is_plain = info.rotation == heic_rs::Rotation::None && info.mirror.is_none();
        warnings.extend(orientation_warning(exif.as_deref(), is_plain, path));
        let profile = match (properties.icc, properties.nclx) {
            (Some(icc), _) => Some(icc.to_vec()),
            (None, Some(nclx)) if nclx.primaries == PRIMARIES_DISPLAY_P3 => display_p3(),
            _ => None,
        };
        Ok(Raster { profile, exif: exif.map(Cow::Owned), ..Raster::of(pixels) })
    }
}
