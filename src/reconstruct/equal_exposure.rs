//! Equal exposure and white balance of the photographs: each follows the one of middle brightness.
//!
//! A gain and an offset a photograph as parameters of the refinement changed nothing (−0.02 dB), so exposure
//! is equalised here, from matched points, before the network.

use super::{Photo, Warning};
use crate::cameras::check::PairReport;
use crate::reconstruct::inputs::crop::Cropped;
use crate::reconstruct::inputs::exposure::{Exposure, PointPair, estimate_exposure};

/// Smallest correction of a middle grey that is applied, 8-bit levels. View-dependent light changes
/// matched points by about as much.
const MIN_LEVELS: f32 = 5.0;
/// Largest median difference after the correction over that before it.
const MAX_RESIDUAL: f32 = 0.7;

/// A line from levels of one photograph to those of another: gain and offset of R, G and B.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Tone {
    gain: [f32; 3],
    offset: [f32; 3],
}

impl Tone {
    const IDENTITY: Self = Self { gain: [1.0; 3], offset: [0.0; 3] };

    /// The levels of `inner`, then those of `self`.
    fn after(&self, inner: &Self) -> Self {
        let offset = |c: usize| self.gain[c] * inner.offset[c] + self.offset[c];
        Self {
            gain: std::array::from_fn(|c| self.gain[c] * inner.gain[c]),
            offset: std::array::from_fn(offset),
        }
    }

    /// The other direction. Gains are positive.
    fn inverse(&self) -> Self {
        Self {
            gain: self.gain.map(|g| 1.0 / g),
            offset: std::array::from_fn(|c| -self.offset[c] / self.gain[c]),
        }
    }

    /// Level of a middle grey, mean over the channels.
    fn of_grey(&self) -> f32 {
        (0..3).map(|c| self.gain[c] * 128.0 + self.offset[c]).sum::<f32>() / 3.0
    }
}

/// Corrects the inputs to the exposure of one of them. Each photograph is compared with the one
/// before it at the matched points of their report; a pair without an estimate counts as equal.
///
/// The reference is the photograph of middle brightness. The first one would be an arbitrary
/// choice, and the errors of a chain of estimates would grow with the distance from it.
pub fn equalise(photos: &[Photo], inputs: &mut [Cropped], reports: &[PairReport]) -> Vec<Warning> {
    // Levels of each photograph to those of the first.
    let mut to_first = vec![Tone::IDENTITY];
    for (i, report) in reports.iter().enumerate() {
        let Some([a, b]) = photos.get(i..i + 2) else { break };
        let matched = report.points.iter().filter(|p| p.consistent);
        let matched: Vec<PointPair> = matched.map(|p| PointPair { a: p.a, b: p.b }).collect();
        let step = match estimate_exposure(a.image(), b.image(), &matched) {
            Ok(e) if is_worth(&e) => Tone { gain: e.gain, offset: e.offset },
            _ => Tone::IDENTITY,
        };
        to_first.push(to_first[i].after(&step));
    }
    let reference = middle(&to_first);
    let from_first = to_first[reference].inverse();
    let mut warnings = Vec::new();
    for (photo, (input, tone)) in inputs.iter_mut().zip(&to_first).enumerate() {
        if *tone == to_first[reference] {
            continue;
        }
        let Tone { gain, offset } = from_first.after(tone);
        let (before, residual, samples) = ([0.0; 3], [0.0; 3], [0; 3]);
        let correction = Exposure { gain, offset, before, residual, samples };
        correction.apply(&mut input.input);
        correction.apply(&mut input.target);
        warnings.push(Warning::ExposureCorrected { photo, reference, gain, offset });
    }
    warnings
}

/// The photograph whose middle grey is the median; the earlier one of two.
fn middle(to_first: &[Tone]) -> usize {
    // A photograph whose levels map to bright ones is dark itself.
    let mut order: Vec<usize> = (0..to_first.len()).collect();
    order.sort_by(|a, b| to_first[*a].of_grey().total_cmp(&to_first[*b].of_grey()));
    let [low, high] = [(order.len() - 1) / 2, order.len() / 2].map(|i| order[i]);
    low.min(high)
}

/// Returns whether a correction is large and removes most of the difference.
fn is_worth(exposure: &Exposure) -> bool {
    let grey = |c: usize| (exposure.gain[c] * 128.0 + exposure.offset[c] - 128.0).abs();
    let large = (0..3).any(|c| grey(c) >= MIN_LEVELS);
    let sum = |v: &[f32; 3]| v.iter().sum::<f32>();
    large && sum(&exposure.residual) < MAX_RESIDUAL * sum(&exposure.before)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::check::MatchedPoint;
    use crate::reconstruct::inputs::crop::{CropOptions, crop};
    use crate::scene::pictures::Rgb;
    use glam::Mat4;
    use subsplat_kernels::camera::{Camera, Intrinsics};

    /// A photograph of smooth colour ramps, its levels times `gain`.
    fn photo(gain: f32) -> Photo {
        let mut image = Rgb::black(96, 96);
        for (i, p) in image.data.chunks_exact_mut(3).enumerate() {
            let x = (i % 96) as f32;
            let y = (i / 96) as f32;
            let levels = [40.0 + 1.3 * x, 50.0 + 1.2 * y, 60.0 + 0.6 * (x + y)];
            p.iter_mut().zip(levels).for_each(|(p, v)| *p = (gain * v).round() as u8);
        }
        let k = Intrinsics::from_fov_x(1.0, 96, 96);
        Photo::new(image, Camera::new(k, Mat4::IDENTITY).unwrap()).unwrap()
    }

    fn report() -> PairReport {
        let at = |i: usize| [(6 + i % 10 * 9) as f32, (6 + i / 10 * 9) as f32];
        let points =
            (0..100).map(|i| MatchedPoint { a: at(i), b: at(i), consistent: true }).collect();
        PairReport { points, ..PairReport::default() }
    }

    #[test]
    fn photographs_follow_the_middle_one_and_equal_ones_stay() {
        let photos = [photo(1.0), photo(0.7), photo(0.85)];
        let options = CropOptions::square(64, 1, 16);
        let crops = |photos: &[Photo]| -> Vec<Cropped> {
            photos.iter().map(|p| crop(p.image(), p.camera(), &options).unwrap()).collect()
        };
        let mut inputs = crops(&photos);
        let warnings = equalise(&photos, &mut inputs, &[report(), report()]);
        assert_eq!(warnings.len(), 2, "{warnings:?}");
        assert_eq!(inputs[2], crops(&photos)[2]);
        for input in &inputs[..2] {
            let pairs = input.target.data.iter().zip(&inputs[2].target.data);
            let worst = pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(worst <= 3, "{worst}");
        }
        // Of two, the first stays.
        let two = [photo(0.7), photo(1.0)];
        let mut inputs = crops(&two);
        assert_eq!(equalise(&two, &mut inputs, &[report()]).len(), 1);
        assert_eq!(inputs[0], crops(&two)[0]);
        let same = [photo(1.0), photo(1.0)];
        let mut inputs = crops(&same);
        assert!(equalise(&same, &mut inputs, &[report()]).is_empty());
        assert_eq!(inputs, crops(&same));
    }
}
