//! A rendered view as an 8-bit picture.

use super::Picture;
use crate::scene::pictures::Rgb;
use image::RgbImage;

impl From<&Picture> for RgbImage {
    /// Clamps colours to [0, 1] and rounds them to 8 bits; NaN becomes 0.
    fn from(picture: &Picture) -> Self {
        let (width, height) = (picture.width as u32, picture.height as u32);
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        Self::from_fn(width, height, |x, y| {
            let first = 3 * (y as usize * picture.width + x as usize);
            let pixel = picture.rgb.get(first..first + 3).unwrap_or(&[0.0; 3]);
            image::Rgb([byte(pixel[0]), byte(pixel[1]), byte(pixel[2])])
        })
    }
}

impl From<&Picture> for Rgb {
    /// Clamps colours to [0, 1] and rounds them to 8 bits; NaN becomes 0.
    fn from(picture: &Picture) -> Self {
        RgbImage::from(picture).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_clamped_and_rounded() {
        let nan = f32::NAN;
        let picture = Picture {
            width: 1,
            height: 2,
            rgb: vec![-0.5, 0.5, 1.5, nan, 0.2 / 255.0, 0.6 / 255.0],
            ..Picture::default()
        };
        assert_eq!(Rgb::from(&picture).data, [0, 128, 255, 0, 0, 1]);
    }
}
