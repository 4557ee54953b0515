//! A rendered view as an 8-bit picture.

use super::Picture;
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
