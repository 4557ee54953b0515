//! Pictures in memory: 8-bit sRGB, rows from the top, and depth maps.
//!
//! 8 bits, because the evaluation protocol resizes uint8 (MVSplat, with PIL). The network reads
//! `[3, H, W]` floats in [0, 1]. [`crate::files::photos::image`] reads and writes files.

use super::mask::Mask;

/// An 8-bit RGB picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `[H, W, 3]`, rows from the top.
    pub data: Vec<u8>,
}

impl Rgb {
    /// Makes a black picture.
    pub fn black(width: usize, height: usize) -> Self {
        Self { width, height, data: vec![0; width * height * 3] }
    }

    /// Computes the mean of the mean colours of `pictures`, value / 255; black for none.
    pub fn mean_colour<'a>(pictures: impl IntoIterator<Item = &'a Self>) -> [f32; 3] {
        Self::mean_colour_of_kept(pictures.into_iter().map(|picture| (picture, None)))
    }

    /// [`Rgb::mean_colour`] of the pixels that the masks of the pictures keep. A mask of another size is
    /// ignored.
    pub fn mean_colour_of_kept<'a>(
        pictures: impl IntoIterator<Item = (&'a Self, Option<&'a Mask>)>,
    ) -> [f32; 3] {
        let (mut sum, mut count) = ([0f64; 3], 0u32);
        for (picture, mask) in pictures {
            let mut own = [0u64; 3];
            let mask = mask.filter(|mask| mask.fits(picture));
            let mut kept = mask.map(|mask| mask.kept().iter());
            for px in picture.data.chunks_exact(3) {
                if kept.as_mut().and_then(Iterator::next) != Some(&false) {
                    own.iter_mut().zip(px).for_each(|(sum, v)| *sum += u64::from(*v));
                }
            }
            let number = mask.map_or(picture.data.len() / 3, Mask::count);
            let pixels = (255 * number.max(1)) as f64;
            sum.iter_mut().zip(own).for_each(|(sum, v)| *sum += v as f64 / pixels);
            count += 1;
        }
        sum.map(|v| (v / f64::from(count.max(1))) as f32)
    }

    /// Converts to `[H, W, 3]` floats, value / 255.
    pub fn to_unit(&self) -> Vec<f32> {
        self.data.iter().map(|&v| f32::from(v) / 255.0).collect()
    }

    /// Converts `[H, W, 3]` floats as [`Rgb::from_planes`] does. `None` if `unit` is not
    /// 3·W·H long.
    pub fn from_unit(unit: &[f32], width: usize, height: usize) -> Option<Self> {
        let length = width.checked_mul(height)?.checked_mul(3)?;
        let data = || unit.iter().map(|&v| quantise(v)).collect();
        (unit.len() == length).then(|| Self { width, height, data: data() })
    }

    /// Converts to `[3, H, W]` floats, value / 255.
    pub fn to_planes(&self) -> Vec<f32> {
        let mut planes = Vec::with_capacity(self.data.len());
        for c in 0..3 {
            planes.extend(self.data[c..].iter().step_by(3).map(|&v| f32::from(v) / 255.0));
        }
        planes
    }

    /// Converts `[3, H, W]` floats: clamped to [0, 1] (NaN is 0), times 255, rounded to
    /// nearest. `None` if `planes` is not 3·W·H long.
    ///
    /// MVSplat truncates when it saves; rounding halves the error. Metrics are computed from
    /// the floats, never from a saved picture.
    pub fn from_planes(planes: &[f32], width: usize, height: usize) -> Option<Self> {
        let area = width.checked_mul(height)?;
        if planes.len() != area.checked_mul(3)? {
            return None;
        }
        let mut data = Vec::with_capacity(planes.len());
        for i in 0..area {
            data.extend((0..3).map(|c| quantise(planes[c * area + i])));
        }
        Some(Self { width, height, data })
    }

    /// Copies the window of `width` × `height` pixels at (`left`, `top`); `None` where it
    /// does not lie inside.
    pub fn window(&self, left: usize, top: usize, width: usize, height: usize) -> Option<Self> {
        if left.checked_add(width)? > self.width || top.checked_add(height)? > self.height {
            return None;
        }
        let mut data = Vec::with_capacity(3 * width * height);
        for y in top..top + height {
            let start = 3 * (y * self.width + left);
            data.extend_from_slice(&self.data[start..start + 3 * width]);
        }
        Some(Self { width, height, data })
    }
}

fn quantise(v: f32) -> u8 {
    // `as` saturates and maps NaN to 0.
    (v * 255.0 + 0.5) as u8
}

/// A depth map: camera z of each pixel centre, world units; 0 where there is none.
#[derive(Clone, Debug, PartialEq)]
pub struct Depth {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `[H, W]`, world units.
    pub data: Vec<f32>,
}
