//! JPEG XL (ISO/IEC 18181): size and EXIF of a file, and its pixels with feature `jxl`.
//!
//! `jxl-oxide` decodes: pure Rust, MIT or Apache-2.0. Without the feature a program converts the file
//! (`programs.rs`).

use super::heif::find;

const CONTAINER: &[u8] = b"\0\0\0\x0cJXL \r\n\x87\n";
const CODESTREAM: &[u8] = b"\xff\x0a";

/// Returns whether `start` begins as a JPEG XL file does.
pub(super) fn is_jxl(start: &[u8]) -> bool {
    start.starts_with(CONTAINER) || start.starts_with(CODESTREAM)
}

/// Bits of a codestream, the lowest of each byte first.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Bits<'_> {
    fn take(&mut self, count: usize) -> Option<u32> {
        let mut value = 0;
        for i in 0..count {
            let byte = self.bytes.get(self.at / 8)?;
            value |= u32::from(byte >> (self.at % 8) & 1) << i;
            self.at += 1;
        }
        Some(value)
    }

    fn side(&mut self, small: bool) -> Option<u32> {
        if small {
            return Some(8 * (self.take(5)? + 1));
        }
        let count = [9, 13, 18, 30][self.take(2)? as usize];
        Some(self.take(count)? + 1)
    }
}

/// Reads the size after the orientation is applied, px; `None` for a file that is cut.
pub(super) fn upright_size(bytes: &[u8]) -> Option<[u32; 2]> {
    let stream = if bytes.starts_with(CODESTREAM) {
        bytes
    } else {
        // A part of a codestream begins with its number.
        find(bytes, b"jxlc").or_else(|| find(bytes, b"jxlp")?.get(4..))?
    };
    let mut bits = Bits { bytes: stream.strip_prefix(CODESTREAM)?, at: 0 };
    let small = bits.take(1)? == 1;
    let height = bits.side(small)?;
    let ratio = bits.take(3)? as usize;
    let width = match ratio {
        0 => bits.side(small)?,
        _ => {
            const RATIOS: [[u64; 2]; 7] =
                [[1, 1], [12, 10], [4, 3], [3, 2], [16, 9], [5, 4], [2, 1]];
            let [over, under] = RATIOS[ratio - 1];
            u32::try_from(u64::from(height) * over / under).ok()?
        }
    };
    // The metadata: all values are the usual ones, or some are given, or the orientation too.
    let turned = bits.take(1)? == 0 && bits.take(1)? == 1 && bits.take(3)? >= 4;
    Some(if turned { [height, width] } else { [width, height] })
}

/// EXIF block of a container: a TIFF structure.
pub(super) fn exif(bytes: &[u8]) -> Option<&[u8]> {
    let body = find(bytes, b"Exif").filter(|_| bytes.starts_with(CONTAINER))?;
    let offset = u32::from_be_bytes(body.get(..4)?.try_into().ok()?) as usize;
    body.get(offset.checked_add(4)?..)
}

#[cfg(feature = "jxl")]
pub(super) use supported::{decode, header};

#[cfg(feature = "jxl")]
mod supported {
    use super::super::decode::{Header, Raster, check_size};
    use super::super::image::{MAX_PIXELS, Probe};
    use super::exif;
    use crate::files::{Error, Result};
    use image::{DynamicImage, ImageDecoder, ImageError, Limits};
    use jxl_oxide::integration::JxlDecoder;
    use std::borrow::Cow;
    use std::path::Path;

    fn refused(path: &Path, error: &ImageError) -> Error {
        Error::format(path, "a JPEG XL picture", error.to_string())
    }

    fn decoder<'a>(bytes: &'a [u8], path: &Path) -> Result<JxlDecoder<&'a [u8]>> {
        // The size at the start is checked before the decoder sees the file.
        let cut = || Error::format(path, "a JPEG XL picture", "a file that ends before its size");
        let [width, height] = super::upright_size(bytes).ok_or_else(cut)?;
        check_size(width, height, path)?;
        let mut decoder = JxlDecoder::new(bytes).map_err(|e| refused(path, &e))?;
        let mut limits = Limits::default();
        limits.max_alloc = Some(MAX_PIXELS * 16);
        decoder.set_limits(limits).map_err(|e| refused(path, &e))?;
        let (width, height) = decoder.dimensions();
        check_size(width, height, path)?;
        Ok(decoder)
    }

    /// Reads size and EXIF without decoding the pixels.
    pub fn header(bytes: &[u8], path: &Path) -> Result<Header> {
        let (width, height) = decoder(bytes, path)?.dimensions();
        let probe = Probe { width: width as usize, height: height as usize, orientation: None };
        let exif = exif(bytes).map(<[u8]>::to_vec);
        Ok(Header { probe, exif, panorama: false, warnings: Vec::new() })
    }

    /// Decodes the first picture. The decoder turns it upright.
    pub fn decode<'a>(bytes: &'a [u8], path: &Path) -> Result<Raster<'a>> {
        let mut decoder = decoder(bytes, path)?;
        let profile = decoder.icc_profile().ok().flatten();
        let pixels = DynamicImage::from_decoder(decoder).map_err(|e| refused(path, &e))?;
        let exif = exif(bytes).map(Cow::Borrowed);
        Ok(Raster { profile, exif, ..Raster::of(pixels) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes of values, each with its number of bits.
    fn stream(values: &[[u32; 2]]) -> Vec<u8> {
        let bits: Vec<u32> =
            values.iter().flat_map(|[v, count]| (0..*count).map(move |i| v >> i & 1)).collect();
        let byte = |bits: &[u32]| bits.iter().enumerate().map(|(i, b)| (*b as u8) << i).sum();
        CODESTREAM.iter().copied().chain(bits.chunks(8).map(byte)).collect()
    }

    #[test]
    fn sizes_are_read() {
        // 640 x 480 by the ratio 4:3; then 48 x 64 in multiples of 8, turned by a quarter.
        let ratio = stream(&[[0, 1], [0, 2], [479, 9], [3, 3], [1, 1]]);
        assert_eq!(upright_size(&ratio), Some([640, 480]));
        let small = stream(&[[1, 1], [7, 5], [0, 3], [5, 5], [0, 1], [1, 1], [5, 3]]);
        assert_eq!(upright_size(&small), Some([64, 48]));
        let large =
            stream(&[[0, 1], [1, 2], [2999, 13], [0, 3], [2, 2], [69_999, 18], [0, 1], [0, 1]]);
        assert_eq!(upright_size(&large), Some([70_000, 3000]));
        for cut in 0..large.len() - 1 {
            assert_eq!(upright_size(&large[..cut]), None, "{cut}");
        }
        let part = |kind: &[u8], body: &[u8]| {
            [&(8 + body.len() as u32).to_be_bytes()[..], kind, body].concat()
        };
        let boxes =
            [CONTAINER, &part(b"Exif", b"\0\0\0\x02..II*"), &part(b"jxlc", &ratio)].concat();
        assert!(is_jxl(&boxes) && is_jxl(&ratio) && !is_jxl(b"\xff\xd8"));
        assert_eq!(upright_size(&boxes), Some([640, 480]));
        assert_eq!(exif(&boxes), Some(&b"II*"[..]));
        let parts = [CONTAINER, &part(b"jxlp", &[b"\0\0\0\0", &small[..]].concat())].concat();
        assert_eq!(upright_size(&parts), Some([64, 48]));
    }
}
