//! Masks: the pixels of a photograph that count.
//!
//! Programs that cut objects out or leave moving people out give a photograph a mask. Masked pixels make no
//! Gaussians, have no weight in the optimisation on the photographs, and no points are matched there. What
//! they show is filled from the pixels around ([`Mask::filled`]) before a photograph is resized, because a
//! resampling would mix it into its neighbours.

use super::pictures::Rgb;
use rayon::prelude::*;

/// Pixels that count, and pixels that are masked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    width: usize,
    height: usize,
    kept: Vec<bool>,
}

impl Mask {
    /// Makes a mask of `[H, W]` marks, rows from the top; true for pixels that count. `None` if `kept` is not
    /// W·H long, or without pixels.
    pub fn new(width: usize, height: usize, kept: Vec<bool>) -> Option<Self> {
        let fits = width.checked_mul(height) == Some(kept.len()) && !kept.is_empty();
        fits.then_some(Self { width, height, kept })
    }

    /// Width, px.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, px.
    pub fn height(&self) -> usize {
        self.height
    }

    /// `[H, W]`, rows from the top: true for pixels that count.
    pub fn kept(&self) -> &[bool] {
        &self.kept
    }

    /// Number of pixels that count.
    pub fn count(&self) -> usize {
        self.kept.iter().filter(|kept| **kept).count()
    }

    /// Returns whether every pixel counts.
    pub fn keeps_all(&self) -> bool {
        self.kept.iter().all(|kept| *kept)
    }

    /// Returns whether no pixel counts.
    pub fn keeps_none(&self) -> bool {
        !self.kept.contains(&true)
    }

    /// Returns whether the mask has the size of `picture`.
    pub fn fits(&self, picture: &Rgb) -> bool {
        (self.width, self.height) == (picture.width, picture.height)
    }

    /// The pixels that count in both masks; `None` if the sizes differ.
    pub fn and(&self, other: &Self) -> Option<Self> {
        let kept = self.kept.iter().zip(&other.kept).map(|(a, b)| *a && *b).collect();
        let same = (self.width, self.height) == (other.width, other.height);
        same.then_some(Self { kept, ..*self })
    }

    /// The mask at another size, which must not be zero: each pixel is that of the old one at its centre.
    pub fn nearest(&self, width: usize, height: usize) -> Self {
        let at = |i: usize, to: usize, from: usize| (2 * i + 1) * from / (2 * to);
        let row = |y: usize| {
            let from = at(y, height, self.height) * self.width;
            (0..width).map(move |x| self.kept[from + at(x, width, self.width)])
        };
        Self { width, height, kept: (0..height).flat_map(row).collect() }
    }

    /// The mask of the part of `extent` px at `origin` px as a picture of `width` × `height`, which must not
    /// be zero. A pixel counts if more than half of its area does. Areas outside the mask do not count.
    pub fn part(&self, origin: [f64; 2], extent: [f64; 2], width: usize, height: usize) -> Self {
        let edges = |axis: usize, count: usize| -> Vec<f64> {
            let step = extent[axis] / count as f64;
            (0..=count).map(|i| origin[axis] + step * i as f64).collect()
        };
        let (columns, rows) = (edges(0, width), edges(1, height));
        let area = extent[0] / width as f64 * (extent[1] / height as f64);
        let mut kept = vec![false; width * height];
        kept.par_chunks_mut(width).zip(rows.par_windows(2)).for_each_init(
            || (vec![0u32; self.width + 1], vec![0.0f64; width]),
            |(sums, cover), (out, row)| {
                cover.fill(0.0);
                let end = self.height as f64;
                let (top, bottom) = (row[0].clamp(0.0, end), row[1].clamp(0.0, end));
                for y in top as usize..(bottom.ceil() as usize).min(self.height) {
                    let share = bottom.min((y + 1) as f64) - top.max(y as f64);
                    let line = &self.kept[y * self.width..(y + 1) * self.width];
                    for (x, kept) in line.iter().enumerate() {
                        sums[x + 1] = sums[x] + u32::from(*kept);
                    }
                    // Number of kept pixels left of `x`, with a part of the pixel at `x`.
                    let before = |x: f64| {
                        let x = x.clamp(0.0, self.width as f64);
                        let whole = (x as usize).min(self.width - 1);
                        let inside = f64::from(u8::from(line[whole]));
                        f64::from(sums[whole]) + (x - whole as f64) * inside
                    };
                    for (cover, edges) in cover.iter_mut().zip(columns.windows(2)) {
                        *cover += share * (before(edges[1]) - before(edges[0]));
                    }
                }
                for (kept, cover) in out.iter_mut().zip(cover.iter()) {
                    *kept = *cover > 0.5 * area;
                }
            },
        );
        Self { width, height, kept }
    }

    /// The whole mask at another size, by [`Mask::part`].
    pub fn resized(&self, width: usize, height: usize) -> Self {
        self.part([0.0; 2], [self.width as f64, self.height as f64], width, height)
    }

    /// Mirrors the mask left to right.
    pub(crate) fn flipped(&self) -> Self {
        let rows = self.kept.chunks_exact(self.width);
        Self { kept: rows.flat_map(|row| row.iter().rev().copied()).collect(), ..*self }
    }

    /// Returns whether every pixel counts whose centre has a distance of `reach` px at most from (x, y) along
    /// both axes, as far as the mask has pixels there.
    pub(crate) fn keeps_around(&self, [x, y]: [f32; 2], reach: f32) -> bool {
        // `as` saturates, also for NaN.
        let span = |at: f32, end: usize| {
            let first = (at - reach - 0.5).ceil().max(0.0) as usize;
            let last = (at + reach + 0.5).floor().max(0.0) as usize;
            first.min(end)..last.clamp(first.min(end), end)
        };
        let columns = span(x, self.width);
        span(y, self.height).all(|row| {
            let start = row * self.width;
            self.kept[start + columns.start..start + columns.end].iter().all(|kept| *kept)
        })
    }

    /// The values `[N, 3]` of the pixels of `[H, W, 3]` that count.
    pub fn kept_of(&self, picture: &[f32]) -> Vec<f32> {
        let pixels = picture.chunks_exact(3).zip(&self.kept);
        pixels.filter(|(_, kept)| **kept).flat_map(|(pixel, _)| pixel).copied().collect()
    }

    /// `picture` `[H, W, 3]` with the masked pixels of `other`, which has its size.
    pub fn merged(&self, picture: &[f32], other: &[f32]) -> Vec<f32> {
        let mut merged = picture.to_vec();
        let pixels = merged.chunks_exact_mut(3).zip(other.chunks_exact(3)).zip(&self.kept);
        for ((pixel, other), _) in pixels.filter(|(_, kept)| !**kept) {
            pixel.copy_from_slice(other);
        }
        merged
    }

    /// `picture` with masked pixels filled from those that count: each by a mean of the nearest ones, at the
    /// scale at which there are any (a pyramid of halves). A picture of another size stays, and one without
    /// pixels that count.
    pub fn filled(&self, picture: &Rgb) -> Rgb {
        let fits = self.fits(picture) && picture.data.len() == 3 * self.kept.len();
        if !fits || self.keeps_none() {
            return picture.clone();
        }
        let mut levels = vec![Level { picture: picture.clone(), kept: self.kept.clone() }];
        while let Some(coarser) = levels.last().and_then(Level::halved) {
            levels.push(coarser);
        }
        let mut coarser: Option<Rgb> = None;
        for mut level in levels.into_iter().rev() {
            if let Some(coarser) = &coarser {
                level.fill(coarser);
            }
            coarser = Some(level.picture);
        }
        coarser.unwrap_or_else(|| picture.clone())
    }
}

/// A picture of which some pixels are known.
struct Level {
    picture: Rgb,
    kept: Vec<bool>,
}

impl Level {
    /// The picture at half its size: means of the known pixels. `None` where all are known.
    fn halved(&self) -> Option<Self> {
        if self.kept.iter().all(|kept| *kept) {
            return None;
        }
        let (w, h) = (self.picture.width, self.picture.height);
        let (width, height) = (w.div_ceil(2), h.div_ceil(2));
        let mut picture = Rgb::black(width, height);
        let mut kept = vec![false; width * height];
        let lines = picture.data.par_chunks_mut(3 * width).zip(kept.par_chunks_mut(width));
        lines.enumerate().for_each(|(y, (line, kept))| {
            for (x, (pixel, kept)) in line.chunks_exact_mut(3).zip(kept).enumerate() {
                let (mut sum, mut count) = ([0u32; 3], 0);
                for row in 2 * y..(2 * y + 2).min(h) {
                    for i in (row * w + 2 * x)..(row * w + (2 * x + 2).min(w)) {
                        if self.kept[i] {
                            let own = &self.picture.data[3 * i..3 * i + 3];
                            sum.iter_mut().zip(own).for_each(|(sum, v)| *sum += u32::from(*v));
                            count += 1;
                        }
                    }
                }
                if count > 0 {
                    let mean = sum.map(|sum| ((sum + count / 2) / count) as u8);
                    pixel.copy_from_slice(&mean);
                    *kept = true;
                }
            }
        });
        Some(Self { picture, kept })
    }

    /// Fills the unknown pixels from a picture of half the size (bilinear).
    fn fill(&mut self, coarser: &Rgb) {
        let width = self.picture.width;
        let lines = self.picture.data.par_chunks_mut(3 * width).zip(self.kept.par_chunks(width));
        lines.enumerate().for_each(|(y, (line, kept))| {
            for (x, (pixel, kept)) in line.chunks_exact_mut(3).zip(kept).enumerate() {
                if !kept {
                    pixel.copy_from_slice(&between(coarser, x, y));
                }
            }
        });
    }
}

/// Colour of `picture` at pixel (x, y) of a picture of twice its size.
fn between(picture: &Rgb, x: usize, y: usize) -> [u8; 3] {
    // The centre of pixel i lies a quarter of a coarser pixel from the centre of pixel i / 2.
    let neighbours = |i: usize, end: usize| {
        let own = (i / 2).min(end - 1);
        let other =
            if i.is_multiple_of(2) { own.saturating_sub(1) } else { (own + 1).min(end - 1) };
        [(own, 3), (other, 1)]
    };
    let (columns, rows) = (neighbours(x, picture.width), neighbours(y, picture.height));
    let mut sum = [8u32; 3];
    for (row, down) in rows {
        for (column, across) in columns {
            let at = 3 * (row * picture.width + column);
            let own = &picture.data[at..at + 3];
            sum.iter_mut().zip(own).for_each(|(sum, v)| *sum += down * across * u32::from(*v));
        }
    }
    sum.map(|sum| (sum / 16) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(width: usize, rows: &str) -> Mask {
        let kept: Vec<bool> = rows.chars().filter(|c| *c != ' ').map(|c| c == '#').collect();
        Mask::new(width, kept.len() / width, kept).unwrap()
    }

    #[test]
    fn lengths_are_checked() {
        assert!(Mask::new(2, 2, vec![true; 3]).is_none());
        assert!(Mask::new(0, 0, vec![]).is_none());
        assert!(Mask::new(usize::MAX, 2, vec![true; 3]).is_none());
        let one = mask(2, "#. ..");
        assert_eq!((one.count(), one.keeps_all(), one.keeps_none()), (1, false, false));
        assert!(one.and(&mask(1, "#")).is_none());
        assert_eq!(one.and(&mask(2, ".# ##")), Some(mask(2, ".. ..")));
        assert_eq!(one.flipped(), mask(2, ".# .."));
    }

    #[test]
    fn a_pixel_counts_if_more_than_half_of_its_area_does() {
        let four = mask(4, "##.. #... ...# .###");
        assert_eq!(four.resized(2, 2), mask(2, "#. .#"));
        // Half of the area is too little.
        assert_eq!(mask(4, "##.. .... .##. ####").resized(2, 2), mask(2, ".. ##"));
        assert_eq!(four.resized(4, 4), four);
        assert_eq!(mask(2, "#. .#").resized(4, 4), mask(4, "##.. ##.. ..## ..##"));
        assert_eq!(four.part([2.0, 2.0], [2.0, 2.0], 2, 2), mask(2, ".# ##"));
        // A pixel of 1.5 px: 1 of 1.5 columns count in the first one.
        assert_eq!(mask(3, "#.#").resized(2, 1), mask(2, "##"));
        assert_eq!(mask(3, "#.#").part([-1.5, 0.0], [3.0, 1.0], 2, 1), mask(2, ".#"));
        // Areas by counting points agree.
        let odd = mask(7, "##..#.# #.####. ..##..# ###.... .#####.");
        for (width, height) in [(3, 2), (5, 4), (9, 11)] {
            let fine = 40;
            let of = |x: usize, y: usize| {
                let at = |i: usize, k: usize, from: usize, to: usize| {
                    ((i * fine + k) * 2 + 1) * from / (2 * to * fine)
                };
                let inside = (0..fine * fine).filter(|k| {
                    let row = at(y, k / fine, 5, height);
                    odd.kept()[row * 7 + at(x, k % fine, 7, width)]
                });
                inside.count() as f64 / (fine * fine) as f64
            };
            let got = odd.resized(width, height);
            for (i, kept) in got.kept().iter().enumerate() {
                let share = of(i % width, i / width);
                assert!((share - 0.5).abs() < 0.06 || *kept == (share > 0.5), "{i}: {share}");
            }
        }
    }

    #[test]
    fn the_nearest_pixel_is_the_one_at_the_centre() {
        let small = mask(2, "#. ##");
        assert_eq!(small.nearest(4, 2), mask(4, "##.. ####"));
        assert_eq!(small.nearest(4, 2).nearest(2, 2), small);
        assert_eq!(small.nearest(1, 1), mask(1, "#"));
    }

    #[test]
    fn the_surroundings_of_a_point_are_tested() {
        let whole = mask(5, "##### ##### ##### ##### ####.");
        assert!(whole.keeps_around([2.5, 2.5], 1.0));
        assert!(!whole.keeps_around([2.5, 2.5], 2.0));
        assert!(!whole.keeps_around([4.5, 4.5], 0.0) && whole.keeps_around([0.0, 0.0], 3.0));
        assert!(whole.keeps_around([-40.0, f32::NAN], 1.0) && whole.keeps_around([90.0; 2], 1.0));
    }

    #[test]
    fn masked_pixels_take_the_colours_around() {
        let mut picture = Rgb { width: 9, height: 6, data: vec![100; 3 * 54] };
        let mut kept = vec![true; 54];
        for (i, pixel) in picture.data.chunks_exact_mut(3).enumerate() {
            if i % 9 >= 4 && i < 36 {
                pixel.fill(255);
                kept[i] = false;
            }
        }
        let mask = Mask::new(9, 6, kept).unwrap();
        assert_eq!(mask.filled(&picture).data, vec![100; 3 * 54]);
        // Pixels that count stay, and the fill lies between the colours around.
        for (i, pixel) in picture.data.chunks_exact_mut(3).enumerate() {
            if mask.kept()[i] {
                pixel.fill((10 * (i % 9)) as u8);
            }
        }
        let filled = mask.filled(&picture);
        for (i, kept) in mask.kept().iter().enumerate() {
            let got = filled.data[3 * i];
            assert!(if *kept { got == picture.data[3 * i] } else { got <= 80 }, "{i}: {got}");
        }
        assert_eq!(mask.kept_of(&picture.to_unit()).len(), 3 * mask.count());
        let merged = mask.merged(&[2.0; 3 * 54], &[3.0; 3 * 54]);
        assert!(
            merged.iter().zip(0..).all(|(v, i)| *v == if mask.kept()[i / 3] { 2.0 } else { 3.0 })
        );
        // Nothing to fill from, or another size: as it was.
        let none = Mask::new(9, 6, vec![false; 54]).unwrap();
        assert_eq!(none.filled(&picture), picture);
        assert_eq!(none.filled(&Rgb::black(2, 2)), Rgb::black(2, 2));
    }
}
