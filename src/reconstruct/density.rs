//! Numbers of children where the photographs need them (ours; the paper names a fixed number as its
//! limit).
//!
//! A parent's pixel is divided along a chain of grids: 1, then 2, 4, … where they divide r, then r.
//! Each finer grid gains the variance between its cells' mean colours within the coarser cells,
//! weighted by the parent's share of the photographs, and costs its further children. Grids are taken
//! by gain over cost until the number of Gaussians is reached. A number below that of the parents
//! keeps those with the largest shares, one Gaussian each.
//!
//! A grid's gain is the photograph's variance that its children can show. Children are chosen before the fit, which
//! makes up for those that are missing. `Splats` then hold an SH set for each Gaussian: an index of parents would be
//! read by every kernel.
//!
//! Of three photographs or more, parents with less than 0.3 of an average parent's share of all photographs are
//! removed, and the photographs share the Gaussians of two and a half. Other fusions were tried and left
//! out: lowering the opacity of contradicted points costs 0.3 dB with sources weighed by visibility, and
//! agreement merges only a tenth of the Gaussians. The shares are gradients by colour offsets.

use crate::files::photos::resize::{Filter, resize};
use crate::reconstruct::inputs::crop::Cropped;
use rayon::prelude::*;

/// Number of Gaussians of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum Density {
    /// [`Density::Full`] of two photographs, at most 950,000. More photographs share the
    /// Gaussians of two and a half.
    #[default]
    Auto,
    /// r² for each pixel of the network's input.
    Full,
    /// This share of [`Density::Full`], 0 to 1: more where the photographs have detail.
    Share(f32),
    /// At most this number: more where the photographs have detail.
    Count(usize),
    /// This number for each pixel of the network's input, 1 to 64, a square or not.
    Each(usize),
}

impl Density {
    /// Returns whether a scene may have Gaussians beside those of the pixels, because the caller gives no number.
    pub fn has_room(self) -> bool {
        matches!(self, Self::Auto | Self::Full)
    }

    /// Returns whether each of `parents` parents of `photographs` photographs has r² children,
    /// r = `upscale`.
    pub(crate) fn is_full(self, parents: usize, photographs: usize, upscale: usize) -> bool {
        let full = parents.saturating_mul(upscale * upscale);
        self.has_room() && self.limit(parents, photographs, upscale) == full
    }

    /// Returns the largest number of Gaussians for `parents` of `photographs` photographs and
    /// r = `upscale`.
    pub fn limit(self, parents: usize, photographs: usize, upscale: usize) -> usize {
        let full = parents.saturating_mul(upscale * upscale);
        match self {
            Self::Auto => {
                let shared = full as f64 * AUTO_PHOTOGRAPHS / photographs as f64;
                (shared.round() as usize).min(full).min(AUTO_GAUSSIANS)
            }
            Self::Full => full,
            Self::Share(share) => (f64::from(share.clamp(0.0, 1.0)) * full as f64).round() as usize,
            Self::Count(count) => count.min(full),
            Self::Each(children) => parents.saturating_mul(children),
        }
    }
}

/// Photographs whose Gaussians [`Density::Auto`] allows in all. Of five photographs of eight scenes at
/// 128 → 256, refined, as many Gaussians as 1.25, 2.5 and 5 of them have give 22.51, 22.59 and 22.50 dB.
const AUTO_PHOTOGRAPHS: f64 = 2.5;

/// Most Gaussians of [`Density::Auto`]: a .ply of degree 1 then stays below 100 MB, and the refinement of
/// two photographs to 1024² takes 1.1 GiB instead of 1.6. Generated rooms 4 and 1 at 256 → 1024
/// (`make_rooms` with seed 78), refined, PSNR / SSIM of new views: with 600,000 Gaussians 33.18 / .954 and
/// 35.05 / .960, with a million 33.57 / .954 and 35.09 / .960, with all 2.1 million 33.63 / .954 and 35.31 / .960;
/// in 36, 43 and 70 s on two cores.
const AUTO_GAUSSIANS: usize = 950_000;

/// Grids of a pixel, by their sides: 1, the powers of two below r that divide r, and r.
pub(crate) fn grids(r: usize) -> Vec<usize> {
    let powers = std::iter::successors(Some(1usize), |side| Some(2 * side));
    let mut grids: Vec<usize> =
        powers.take_while(|side| *side < r).filter(|side| r.is_multiple_of(*side)).collect();
    grids.push(r.max(1));
    grids
}

/// A finer grid for one parent.
struct Step {
    parent: u32,
    children: u8,
    /// Further children.
    cost: usize,
    /// Gain over cost.
    slope: f32,
}

/// Numbers of children of all parents of `inputs`, whose `shares` are given, for at most `limit`
/// children. `grids` are the sides that a parent's grid can have, in ascending order. Parents are in
/// the order of their pixels, the same number for each.
pub(crate) fn counts(inputs: &[Cropped], shares: &[f32], grids: &[usize], limit: usize) -> Vec<u8> {
    if limit < shares.len() {
        return largest(shares, limit);
    }
    let per_view = shares.len() / inputs.len().max(1);
    let mut steps: Vec<Step> = Vec::new();
    for (view, input) in inputs.iter().enumerate() {
        let variances = variances(input, grids);
        let pixels = (input.input.width * input.input.height).max(1);
        let per_pixel = (per_view / pixels).max(1);
        let shares = &shares[view * per_view..][..per_view];
        let of_parent = |(i, share): (usize, &f32)| {
            let pixel = (i / per_pixel).min(pixels - 1);
            let gains = variances.iter().map(|level| share * level[pixel]);
            steps_of((view * per_view + i) as u32, grids, gains)
        };
        let made: Vec<Vec<Step>> =
            shares.par_iter().enumerate().with_min_len(1024).map(of_parent).collect();
        steps.extend(made.into_iter().flatten());
    }
    // Stable: of equal slopes, a parent's coarser grid comes first.
    steps.par_sort_by(|a, b| b.slope.total_cmp(&a.slope));
    let mut counts = vec![1u8; shares.len()];
    let mut left = limit - shares.len();
    for step in &steps {
        // A parent's next grid costs more, so it does not fit either.
        if step.cost > left {
            continue;
        }
        counts[step.parent as usize] = step.children;
        left -= step.cost;
    }
    counts
}

/// 1 for the `limit` parents with the largest shares, 0 for the others.
fn largest(shares: &[f32], limit: usize) -> Vec<u8> {
    let mut order: Vec<usize> = (0..shares.len()).collect();
    order.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]));
    let mut counts = vec![0u8; shares.len()];
    order.iter().take(limit).for_each(|i| counts[*i] = 1);
    counts
}

/// Finer grids of one parent in order, with falling slopes: a grid that gains less than the next one
/// is skipped.
fn steps_of(parent: u32, grids: &[usize], gains: impl Iterator<Item = f32>) -> Vec<Step> {
    let mut steps: Vec<(Step, f32)> = Vec::new();
    for (pair, gain) in grids.windows(2).zip(gains) {
        let mut gain = gain.max(0.0);
        let mut cost = pair[1] * pair[1] - pair[0] * pair[0];
        while steps.last().is_some_and(|(last, _)| last.slope < gain / cost as f32) {
            if let Some((last, last_gain)) = steps.pop() {
                (gain, cost) = (gain + last_gain, cost + last.cost);
            }
        }
        let slope = gain / cost as f32;
        steps.push((Step { parent, children: (pair[1] * pair[1]) as u8, cost, slope }, gain));
    }
    steps.into_iter().map(|(step, _)| step).collect()
}

/// For each grid after the first, and each input pixel: the mean squared difference of the cells'
/// mean colours from those of the coarser cells around them.
fn variances(input: &Cropped, grids: &[usize]) -> Vec<Vec<f32>> {
    let (w, h) = (input.input.width, input.input.height);
    let r = grids.last().copied().unwrap_or(1);
    let size = (w * r, h * r);
    let picture = if (input.target.width, input.target.height) == size {
        input.target.to_unit()
    } else {
        resize(&input.target, size.0, size.1, Filter::Lanczos).to_unit()
    };
    // Mean square of the cells' means. Cells nest, so differences are variances.
    let squares = |side: usize| -> Vec<f32> {
        let cell = r / side;
        let pixel = |i: usize| {
            let (x, y) = (i % w * r, i / w * r);
            let mut sum = 0.0;
            for at in 0..side * side {
                let left = x + at % side * cell;
                let top = y + at / side * cell;
                let mut mean = [0f32; 3];
                for row in top..top + cell {
                    let begin = 3 * (row * size.0 + left);
                    for rgb in picture[begin..begin + 3 * cell].chunks_exact(3) {
                        mean.iter_mut().zip(rgb).for_each(|(m, v)| *m += v);
                    }
                }
                sum += mean.iter().map(|m| (m / (cell * cell) as f32).powi(2)).sum::<f32>();
            }
            sum / (side * side) as f32
        };
        (0..w * h).into_par_iter().with_min_len(256).map(pixel).collect()
    };
    let levels: Vec<Vec<f32>> = grids.iter().map(|side| squares(*side)).collect();
    let difference = |pair: &[Vec<f32>]| pair[1].iter().zip(&pair[0]).map(|(b, a)| b - a).collect();
    levels.windows(2).map(difference).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::inputs::crop::{CropOptions, crop};
    use crate::scene::pictures::Rgb;
    use glam::Mat4;
    use subsplat_kernels::camera::{Camera, Intrinsics};

    /// Input 4x4, r = 4: the right half has stripes of one target pixel, the rest is grey.
    fn input() -> Cropped {
        let mut photo = Rgb { width: 16, height: 16, data: vec![128; 3 * 256] };
        for y in 0..16 {
            for x in 8..16 {
                let value = if x % 2 == 0 { 40 } else { 220 };
                photo.data[3 * (16 * y + x)..][..3].fill(value);
            }
        }
        let k = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0, width: 16, height: 16 };
        let camera = Camera::new(k, Mat4::IDENTITY).unwrap();
        crop(&photo, &camera, &CropOptions::square(4, 4, 1)).unwrap()
    }

    #[test]
    fn detail_gets_the_children() {
        assert_eq!(grids(4), [1, 2, 4]);
        assert_eq!((grids(1), grids(3), grids(6)), (vec![1], vec![1, 3], vec![1, 2, 6]));
        let inputs = [input()];
        // Eight pixels have detail; stripes of one pixel show in the grid of four only.
        let counts = counts(&inputs, &[1.0; 16], &grids(4), 8 + 8 * 16);
        for (i, k) in counts.iter().enumerate() {
            assert_eq!(*k, if i % 4 >= 2 { 16 } else { 1 }, "{i}");
        }
        // A parent that nothing shows gets none of them.
        let mut shares = [1.0; 16];
        shares[2] = 0.0;
        let fewer = super::counts(&inputs, &shares, &grids(4), 8 + 8 * 16);
        assert_eq!((fewer[2], fewer[3]), (1, 16));
    }

    #[test]
    fn the_number_is_kept() {
        let inputs = [input()];
        let shares: Vec<f32> = (0..16).map(|i| i as f32).collect();
        for limit in [0, 5, 16, 17, 40, 100, 256, 1000] {
            let counts = counts(&inputs, &shares, &grids(4), limit);
            let count: usize = counts.iter().map(|k| usize::from(*k)).sum();
            assert!(count <= limit && count + 15 >= limit.min(256), "{limit} {count}");
        }
        let few = counts(&inputs, &shares, &grids(4), 3);
        assert!(few[13..] == [1, 1, 1] && few[..13] == [0; 13]);
        assert_eq!(Density::Full.limit(10, 5, 4), 160);
        assert_eq!(Density::Share(0.25).limit(10, 5, 4), 40);
        assert_eq!(Density::Count(7).limit(10, 5, 4), 7);
        assert_eq!(Density::Each(3).limit(10, 2, 4), 30);
        assert_eq!((Density::Auto.limit(10, 2, 4), Density::Auto.limit(10, 5, 4)), (160, 80));
        assert!(Density::Auto.is_full(10, 2, 4) && !Density::Auto.is_full(10, 3, 4));
        assert_eq!(Density::Auto.limit(131_072, 2, 4), AUTO_GAUSSIANS);
        assert_eq!(Density::Auto.limit(1_000_000, 10, 4), AUTO_GAUSSIANS);
        assert!(!Density::Auto.is_full(131_072, 2, 4) && Density::Auto.is_full(131_072, 2, 2));
    }

    #[test]
    fn variances_are_those_of_the_definition() {
        let input = input();
        let of_input = variances(&input, &[1, 2, 4]);
        let picture = input.target.to_unit();
        for i in 0..16 {
            let value = |x: usize, y: usize| picture[3 * (16 * (i / 4 * 4 + y) + i % 4 * 4 + x)];
            let mean = |x: usize, y: usize, n: usize| {
                let all = (0..n * n).map(|j| value(x + j % n, y + j / n));
                all.sum::<f32>() / (n * n) as f32
            };
            let halves = (0..4).map(|j| (j % 2 * 2, j / 2 * 2));
            let coarse: f32 =
                halves.map(|(x, y)| (mean(x, y, 2) - mean(0, 0, 4)).powi(2)).sum::<f32>() / 4.0;
            let fine: f32 = (0..16)
                .map(|j| (j % 4, j / 4))
                .map(|(x, y)| (value(x, y) - mean(x / 2 * 2, y / 2 * 2, 2)).powi(2))
                .sum::<f32>()
                / 16.0;
            assert!((of_input[0][i] - 3.0 * coarse).abs() < 1e-5, "{i}");
            assert!((of_input[1][i] - 3.0 * fine).abs() < 1e-5, "{i}");
        }
    }
}
