//! Size of the network's input for photographs of any shape.
//!
//! The input keeps the photographs' shape. Its area may deviate by a quarter from the one asked for, because the
//! stride is 32 px and photographs are cropped, never stretched. A larger input is no default. It gains
//! 1 to 3 dB at the inputs' cameras, but new views of pairs with little overlap lose as much
//! (`tools/lab/tried.md`, "Size of the input").

use subsplat_kernels::camera::Size;

/// Size of the network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum InputSize {
    /// These sides, cut to multiples of the model's stride. The photographs are cropped to the
    /// middle of this shape.
    #[non_exhaustive]
    Exact {
        /// Width, px.
        width: usize,
        /// Height, px.
        height: usize,
    },
    /// About this many pixels, in the shape of the photographs: 0.8 to 1.25 times as many, in
    /// sides that are multiples of the model's stride. Photographs are cropped, never stretched.
    /// All of a scene get one shape; it cuts as little as possible of the photograph that loses
    /// most.
    Area(usize),
    /// [`InputSize::Area`] of this number, but less where the photographs are small: an input pixel
    /// is divided into r² Gaussians, one for each pixel of a photograph. At least the default's
    /// number, and never more than this one.
    AtMost(usize),
}

/// Pixels of the default input.
const DEFAULT_AREA: usize = 256 * 256;

/// Range of the input's area over the one that was asked for. A narrower range cuts more of the
/// photographs, because the sides are multiples of the stride.
const AREA_RATIO: std::ops::RangeInclusive<f64> = 0.8..=1.25;

impl Default for InputSize {
    /// The area of 256×256.
    fn default() -> Self {
        Self::Area(DEFAULT_AREA)
    }
}

impl InputSize {
    /// Sides `width` and `height`, px.
    pub fn exact(width: usize, height: usize) -> Self {
        Self::Exact { width, height }
    }

    /// Replaces [`InputSize::AtMost`] by the area for photographs of the sizes `photos`, px, and
    /// `upscale`² Gaussians a pixel. Other sizes stay.
    #[must_use]
    pub fn limited_to(self, photos: &[Size], upscale: usize) -> Self {
        let Self::AtMost(most) = self else { return self };
        let pixels = photos.iter().map(|photo| photo.width.saturating_mul(photo.height)).min();
        let useful = pixels.unwrap_or(usize::MAX) / (upscale * upscale).max(1);
        Self::Area(useful.max(DEFAULT_AREA).min(most))
    }

    /// The size for photographs of the sizes `photos` and a model of `stride`, px. An exact size is
    /// returned as it is, and [`InputSize::AtMost`] counts as [`InputSize::Area`]. Without
    /// photographs the shape is square.
    pub fn resolve(self, photos: &[Size], stride: usize) -> Size {
        let area = match self {
            Self::Exact { width, height } => return Size { width, height },
            Self::Area(area) | Self::AtMost(area) => area.max(1) as f64,
        };
        let stride = stride.max(1);
        let cells = (AREA_RATIO.end() * area / (stride * stride) as f64) as usize;
        let mut best = Candidate::new(Size::new(stride, stride), area, photos);
        for columns in 1..=cells {
            for rows in 1..=cells / columns {
                let size = Size::new(columns * stride, rows * stride);
                let candidate = Candidate::new(size, area, photos);
                if candidate.rank > best.rank {
                    best = candidate;
                }
            }
        }
        best.size
    }
}

/// A size with its rank; the higher the better.
struct Candidate {
    size: Size,
    /// True if the area is in range; share kept of the photograph that loses most, mean share,
    /// closeness of the area. Shares are in ppm, so that rounding decides nothing.
    rank: (bool, i64, i64, i64),
}

impl Candidate {
    fn new(size: Size, area: f64, photos: &[Size]) -> Self {
        let ppm = |v: f64| (v * 1e6).round() as i64;
        let square = [Size::new(1, 1)];
        let photos = if photos.is_empty() { &square } else { photos };
        let shares = photos.iter().map(|photo| kept_share(*photo, size));
        let least = shares.clone().fold(f64::INFINITY, f64::min);
        let mean = shares.sum::<f64>() / photos.len() as f64;
        let ratio = (size.width * size.height) as f64 / area;
        let inside = AREA_RATIO.contains(&ratio);
        // Outside the range the nearest area counts alone: the input is smaller than a few cells.
        let (least, mean) = if inside { (ppm(least), ppm(mean)) } else { (0, 0) };
        Self { size, rank: (inside, least, mean, -ppm(ratio.ln().abs())) }
    }
}

/// Share of a photograph of `photo` px that the largest window of the shape of `size` shows.
fn kept_share(photo: Size, size: Size) -> f64 {
    let aspect = |s: Size| s.width.max(1) as f64 / s.height.max(1) as f64;
    let ratio = aspect(photo) / aspect(size);
    ratio.min(1.0 / ratio)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of((width, height): (usize, usize)) -> Size {
        Size { width, height }
    }

    fn size_of(input: InputSize, photos: &[(usize, usize)], stride: usize) -> (usize, usize) {
        let photos: Vec<Size> = photos.iter().copied().map(of).collect();
        let size = input.resolve(&photos, stride);
        (size.width, size.height)
    }

    fn resolved(photos: &[(usize, usize)], stride: usize) -> (usize, usize) {
        size_of(InputSize::default(), photos, stride)
    }

    #[test]
    fn the_input_keeps_the_shape_of_the_photographs() {
        for (photo, stride, expected) in [
            ((640, 640), 32, (256, 256)),
            ((1920, 1080), 32, (352, 192)),
            ((1080, 1920), 32, (192, 352)),
            ((540, 360), 32, (288, 192)),
            ((4032, 3024), 32, (288, 224)),
            ((3024, 4032), 32, (224, 288)),
            ((4032, 3024), 16, (320, 240)),
        ] {
            let size = resolved(&[photo, photo], stride);
            assert_eq!(size, expected, "{photo:?}");
            assert!(AREA_RATIO.contains(&((size.0 * size.1) as f64 / 65536.0)), "{size:?}");
            assert!(kept_share(of(photo), of(size)) > 0.95, "{photo:?} {size:?}");
        }
    }

    #[test]
    fn mixed_shapes_lose_evenly() {
        // 3:2 both ways: a square keeps two thirds of each; either shape keeps 4/9 of the other.
        assert_eq!(resolved(&[(600, 400), (400, 600)], 32), (256, 256));
        let size = resolved(&[(1600, 900), (1600, 900), (1200, 900)], 32);
        let shares = [(1600, 900), (1200, 900)].map(|p| kept_share(of(p), of(size)));
        assert!(shares.iter().all(|s| *s > 0.83), "{size:?} {shares:?}");
    }

    #[test]
    fn exact_and_tiny_sizes() {
        assert_eq!(size_of(InputSize::exact(100, 75), &[(9, 5)], 32), (100, 75));
        assert_eq!(size_of(InputSize::Area(1), &[(9, 5)], 32), (32, 32));
        assert_eq!(size_of(InputSize::Area(0), &[], 32), (32, 32));
        assert_eq!(size_of(InputSize::Area(96 * 96), &[], 32), (96, 96));
        let (w, h) = size_of(InputSize::Area(1 << 20), &[(10_000, 100)], 32);
        assert!(w > 40 * h && w * h < 1_300_000, "{w}x{h}");
    }
}
