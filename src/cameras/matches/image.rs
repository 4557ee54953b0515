//! Grey pictures for matching: access, Gaussian blur, area reduction, resampling by 2.
//!
//! Values are in [0, 1], row-major. The centre of pixel (i, j) is (i + 0.5, j + 0.5), as in
//! `camera.rs`. Blurred, doubled and decimated pictures have no mask: features are those of the picture from which
//! they are made.

use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use rayon::prelude::*;

/// A grey picture, `height` rows of `width` values in [0, 1].
#[derive(Clone, Debug, PartialEq)]
pub struct GrayImage {
    width: usize,
    height: usize,
    pixels: Vec<f32>,
    /// Pixels in which points may be matched; `None` for all.
    mask: Option<Mask>,
}

/// Rec. 709 luma weights, applied to the stored (gamma-encoded) values.
const LUMA: [f32; 3] = [0.2126, 0.7152, 0.0722];

impl GrayImage {
    /// Builds a picture of `width × height` values. Returns `None` where the number of values
    /// differs, the picture is empty, or a value is not finite.
    pub fn new(width: usize, height: usize, pixels: Vec<f32>) -> Option<Self> {
        let fits = width.checked_mul(height) == Some(pixels.len()) && !pixels.is_empty();
        let finite = fits && pixels.iter().all(|v| v.is_finite());
        finite.then_some(Self { width, height, pixels, mask: None })
    }

    /// Computes the luma of a picture. With a mask, no points are matched at masked pixels, which are filled from
    /// those around ([`Mask::filled`]). Returns `None` for a picture whose data do not have its size, or for a mask
    /// of another size.
    pub fn from_picture(picture: &Rgb, mask: Option<&Mask>) -> Option<Self> {
        let Rgb { width, height, data } = picture;
        match mask {
            None => Self::from_rgb8(*width, *height, data),
            Some(mask) if mask.fits(picture) && data.len() == 3 * mask.kept().len() => {
                let grey = Self::from_rgb8(*width, *height, &mask.filled(picture).data)?;
                Some(grey.masked(mask.clone()))
            }
            Some(_) => None,
        }
    }

    /// The picture with a mask of its size; one of another size is ignored.
    pub(crate) fn masked(self, mask: Mask) -> Self {
        let fits = (mask.width(), mask.height()) == (self.width, self.height);
        Self { mask: fits.then_some(mask), ..self }
    }

    /// Computes the luma of interleaved 8-bit RGB. Returns `None` where the length is not 3·W·H.
    pub fn from_rgb8(width: usize, height: usize, rgb: &[u8]) -> Option<Self> {
        let grey = rgb
            .chunks_exact(3)
            .map(|p| (0..3).map(|c| LUMA[c] * f32::from(p[c])).sum::<f32>() / 255.0);
        rgb.len().is_multiple_of(3).then(|| Self::new(width, height, grey.collect()))?
    }

    /// Computes the luma of interleaved RGB floats in [0, 1]. Returns `None` where the length is
    /// not 3·W·H or a value is not finite.
    pub fn from_rgb(width: usize, height: usize, rgb: &[f32]) -> Option<Self> {
        let grey = rgb.chunks_exact(3).map(|p| (0..3).map(|c| LUMA[c] * p[c]).sum::<f32>());
        rgb.len().is_multiple_of(3).then(|| Self::new(width, height, grey.collect()))?
    }

    /// Pictures of one height side by side, without masks; `None` for others, and for none.
    pub(crate) fn side_by_side(pictures: &[Self]) -> Option<Self> {
        let height = pictures.first()?.height;
        if pictures.iter().any(|picture| picture.height != height) {
            return None;
        }
        let rows = (0..height).flat_map(|y| pictures.iter().flat_map(move |p| p.row(y)));
        let width = pictures.iter().map(Self::width).sum();
        Self::new(width, height, rows.copied().collect())
    }

    /// Returns the width, px.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns the height, px.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Returns all values, row-major.
    pub fn pixels(&self) -> &[f32] {
        &self.pixels
    }

    /// Returns the pixels in which points may be matched; `None` for all.
    pub(crate) fn mask(&self) -> Option<&Mask> {
        self.mask.as_ref()
    }

    /// Returns row `y`.
    pub(crate) fn row(&self, y: usize) -> &[f32] {
        &self.pixels[y * self.width..(y + 1) * self.width]
    }

    /// Returns the value at column `x`, row `y`.
    pub(crate) fn at(&self, x: usize, y: usize) -> f32 {
        self.pixels[y * self.width + x]
    }

    /// Returns the mean value.
    pub(crate) fn mean(&self) -> f32 {
        (self.pixels.iter().map(|&v| f64::from(v)).sum::<f64>() / self.pixels.len() as f64) as f32
    }

    /// Returns the mean over the square of `2·radius + 1` pixels around (x, y), cut at the border.
    pub(crate) fn mean_around(&self, x: f32, y: f32, radius: usize) -> f32 {
        let (cx, cy) =
            ((x.max(0.0) as usize).min(self.width - 1), (y.max(0.0) as usize).min(self.height - 1));
        let columns = cx.saturating_sub(radius)..(cx + radius + 1).min(self.width);
        let rows = cy.saturating_sub(radius)..(cy + radius + 1).min(self.height);
        let count = (columns.len() * rows.len()) as f32;
        rows.map(|r| self.row(r)[columns.clone()].iter().sum::<f32>()).sum::<f32>() / count
    }

    /// Applies a Gaussian blur of `sigma` px. Border pixels are repeated; the kernel is cut at
    /// 3.5σ.
    pub(crate) fn blurred(&self, sigma: f32) -> Self {
        let radius = (3.5 * sigma).ceil() as usize;
        let kernel = gaussian(sigma, radius);
        let (w, h) = (self.width, self.height);
        let mut across = vec![0.0f32; w * h];
        across.par_chunks_mut(w).enumerate().for_each_init(
            || vec![0.0f32; w + 2 * radius],
            |padded, (y, out)| {
                let row = self.row(y);
                padded[..radius].fill(row[0]);
                padded[radius..radius + w].copy_from_slice(row);
                padded[radius + w..].fill(row[w - 1]);
                for (k, &weight) in kernel.iter().enumerate() {
                    accumulate(out, &padded[k..k + w], weight);
                }
            },
        );
        let mut pixels = vec![0.0f32; w * h];
        pixels.par_chunks_mut(w).enumerate().for_each(|(y, out)| {
            for (k, &weight) in kernel.iter().enumerate() {
                let from = (y + k).saturating_sub(radius).min(h - 1);
                accumulate(out, &across[from * w..(from + 1) * w], weight);
            }
        });
        Self { width: w, height: h, pixels, mask: None }
    }

    /// Returns every second pixel of both directions. The source is already blurred for the next
    /// octave. The centre of pixel (i, j) of the result is the centre of pixel (2i, 2j) of the
    /// source.
    pub(crate) fn decimated(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let pixels = (0..height).flat_map(|y| self.row(2 * y).iter().step_by(2).copied()).collect();
        Self { width, height, pixels, mask: None }
    }

    /// Returns the picture mirrored left to right.
    pub(crate) fn flipped(&self) -> Self {
        let rows = self.pixels.chunks_exact(self.width);
        let pixels = rows.flat_map(|row| row.iter().rev().copied()).collect();
        Self { pixels, mask: self.mask.as_ref().map(Mask::flipped), ..*self }
    }

    /// Doubles the size by bilinear interpolation. The centre of pixel (2i, 2j) is the centre of
    /// pixel (i, j) of the source.
    pub(crate) fn doubled(&self) -> Self {
        let (w, h) = (self.width, self.height);
        let (width, height) = (2 * w, 2 * h);
        let mut pixels = vec![0.0f32; width * height];
        pixels.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let top = self.row(y / 2);
            let bottom = self.row((y / 2 + y % 2).min(h - 1));
            for (x, o) in out.iter_mut().enumerate() {
                let l = x / 2;
                let r = (x / 2 + x % 2).min(w - 1);
                *o = 0.25 * (top[l] + top[r] + bottom[l] + bottom[r]);
            }
        });
        Self { width, height, pixels, mask: None }
    }

    /// Averages areas down to `width × height`, each at most the size of this picture.
    pub(crate) fn reduced(&self, width: usize, height: usize) -> Self {
        let columns = area_weights(self.width, width);
        let rows = area_weights(self.height, height);
        let mut across = vec![0.0f32; width * self.height];
        across.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let row = self.row(y);
            for (o, (first, weights)) in out.iter_mut().zip(&columns) {
                *o = weights.iter().zip(&row[*first..]).map(|(w, v)| w * v).sum();
            }
        });
        let mut pixels = vec![0.0f32; width * height];
        pixels.par_chunks_mut(width).zip(&rows).for_each(|(out, (first, weights))| {
            for (k, &weight) in weights.iter().enumerate() {
                let from = first + k;
                accumulate(out, &across[from * width..(from + 1) * width], weight);
            }
        });
        Self { width, height, pixels, mask: self.mask.as_ref().map(|m| m.resized(width, height)) }
    }
}

/// Returns samples of a Gaussian at −radius..=radius, normalised to sum 1.
fn gaussian(sigma: f32, radius: usize) -> Vec<f32> {
    let mut kernel: Vec<f32> = (0..=2 * radius)
        .map(|i| {
            let d = (i as f32 - radius as f32) / sigma;
            (-0.5 * d * d).exp()
        })
        .collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    kernel
}

/// Computes `out += weight · row`.
fn accumulate(out: &mut [f32], row: &[f32], weight: f32) {
    for (o, &v) in out.iter_mut().zip(row) {
        *o += weight * v;
    }
}

/// Returns, for every output pixel, the first input pixel that it covers and the weight of each
/// covered pixel. The weights sum to 1.
fn area_weights(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let ratio = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let start = i as f64 * ratio;
            let end = ((i + 1) as f64 * ratio).min(from as f64);
            let first = (start.floor() as usize).min(from - 1);
            let last = (end.ceil() as usize).clamp(first + 1, from);
            let cover = |p: usize| (end.min((p + 1) as f64) - start.max(p as f64)).max(0.0);
            let weights: Vec<f64> = (first..last).map(cover).collect();
            let sum: f64 = weights.iter().sum();
            (first, weights.iter().map(|w| (w / sum) as f32).collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_values_are_checked() {
        assert!(GrayImage::new(2, 2, vec![0.0; 3]).is_none());
        assert!(GrayImage::new(0, 0, vec![]).is_none());
        assert!(GrayImage::new(1, 1, vec![f32::NAN]).is_none());
        assert!(GrayImage::from_rgb8(1, 1, &[1, 2]).is_none());
        let white = GrayImage::from_rgb8(1, 1, &[255; 3]).unwrap();
        assert!((white.at(0, 0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn reduction_keeps_the_mean_and_splits_pixels_by_area() {
        let image = GrayImage::new(3, 1, vec![0.0, 1.0, 0.5]).unwrap();
        let half = image.reduced(2, 1);
        assert!((half.at(0, 0) - 1.0 / 3.0).abs() < 1e-6);
        assert!((half.at(1, 0) - 2.0 / 3.0).abs() < 1e-6);
        assert!((half.mean() - image.mean()).abs() < 1e-6);
    }

    #[test]
    fn blur_keeps_constants_and_centres() {
        let flat = GrayImage::new(9, 7, vec![0.25; 63]).unwrap().blurred(1.3);
        assert!(flat.pixels().iter().all(|v| (v - 0.25).abs() < 1e-6));
        let mut dot = vec![0.0; 21 * 21];
        dot[10 * 21 + 10] = 1.0;
        let spread = GrayImage::new(21, 21, dot).unwrap().blurred(2.0);
        assert!((spread.at(10, 10) - 1.0 / (2.0 * std::f32::consts::PI * 4.0)).abs() < 1e-4);
        assert_eq!(spread.at(8, 10), spread.at(12, 10));
        assert!((spread.at(8, 10) - spread.at(10, 8)).abs() < 1e-9);
    }

    #[test]
    fn doubling_keeps_every_second_pixel() {
        let image = GrayImage::new(2, 2, vec![0.0, 1.0, 0.5, 0.25]).unwrap();
        let large = image.doubled();
        assert_eq!((large.at(0, 0), large.at(2, 0), large.at(0, 2)), (0.0, 1.0, 0.5));
        assert_eq!(large.at(1, 0), 0.5);
        assert_eq!(large.decimated(), image);
    }
}
