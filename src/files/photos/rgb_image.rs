//! Conversions between [`Rgb`] and `image::RgbImage`.

use crate::files::{Error, Result};
use crate::scene::pictures::Rgb;
use image::RgbImage;

impl From<RgbImage> for Rgb {
    /// Takes the pixels over without a copy.
    fn from(image: RgbImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        Self { width, height, data: image.into_raw() }
    }
}

impl TryFrom<Rgb> for RgbImage {
    type Error = Error;

    /// Takes the pixels over without a copy.
    ///
    /// # Errors
    /// The buffer does not hold 3·W·H bytes, or a side exceeds `u32`.
    fn try_from(picture: Rgb) -> Result<Self> {
        let Rgb { width, height, data } = picture;
        let bytes = data.len();
        let sides = (u32::try_from(width), u32::try_from(height));
        let image = match sides {
            (Ok(w), Ok(h)) if width.checked_mul(3 * height) == Some(bytes) => {
                RgbImage::from_raw(w, h, data)
            }
            _ => None,
        };
        image.ok_or_else(|| {
            let expected = format!("3 bytes for each of {width}x{height} pixels");
            Error::format("picture", expected, format!("{bytes} bytes"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_convert_both_ways() {
        let rgb = Rgb { width: 2, height: 1, data: vec![1, 2, 3, 4, 5, 6] };
        let image = RgbImage::try_from(rgb.clone()).unwrap();
        assert_eq!((image.dimensions(), image.get_pixel(1, 0).0), ((2, 1), [4, 5, 6]));
        assert_eq!(Rgb::from(image), rgb);
        let cut = Rgb { width: 2, height: 2, ..rgb };
        assert!(RgbImage::try_from(cut).unwrap_err().to_string().contains("2x2"));
    }
}
