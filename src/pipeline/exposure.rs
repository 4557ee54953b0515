//! Equal exposure and white balance of the photographs: each follows the first one.

use super::{Photo, Warning};
use crate::check::PairReport;
use crate::data::crop::Cropped;
use crate::data::exposure::{Exposure, PointPair, estimate_exposure};

/// Smallest correction of a middle grey that is applied, 8-bit levels. View-dependent light changes
/// matched points by about as much.
const MIN_LEVELS: f32 = 5.0;
/// Largest median difference after the correction over that before it.
const MAX_RESIDUAL: f32 = 0.7;

/// Corrects the inputs after the first to its exposure. Each photograph is compared with the one
/// before it at the matched points of their report; a pair without an estimate changes nothing.
pub(super) fn equalise(
    photos: &[Photo],
    inputs: &mut [Cropped],
    reports: &[PairReport],
) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let mut total = [[1.0f32, 0.0]; 3];
    for (i, report) in reports.iter().enumerate() {
        let (Some([a, b]), Some(input)) = (photos.get(i..i + 2), inputs.get_mut(i + 1)) else {
            break;
        };
        let matched = report.points.iter().filter(|p| p.consistent);
        let matched: Vec<PointPair> = matched.map(|p| PointPair { a: p.a, b: p.b }).collect();
        if let Ok(exposure) = estimate_exposure(a.image(), b.image(), &matched)
            && is_worth(&exposure)
        {
            for (c, [gain, offset]) in total.iter_mut().enumerate() {
                *offset += *gain * exposure.offset[c];
                *gain *= exposure.gain[c];
            }
        }
        if total != [[1.0, 0.0]; 3] {
            let (gain, offset) = (total.map(|t| t[0]), total.map(|t| t[1]));
            let zero = ([0.0; 3], [0.0; 3], [0; 3]);
            let correction =
                Exposure { gain, offset, before: zero.0, residual: zero.1, samples: zero.2 };
            correction.apply(&mut input.input);
            correction.apply(&mut input.target);
            warnings.push(Warning::ExposureCorrected { photo: i + 1, gain, offset });
        }
    }
    warnings
}

/// Whether a correction is large, and removes most of the difference.
fn is_worth(exposure: &Exposure) -> bool {
    let grey = |c: usize| (exposure.gain[c] * 128.0 + exposure.offset[c] - 128.0).abs();
    let large = (0..3).any(|c| grey(c) >= MIN_LEVELS);
    let sum = |v: &[f32; 3]| v.iter().sum::<f32>();
    large && sum(&exposure.residual) < MAX_RESIDUAL * sum(&exposure.before)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Intrinsics};
    use crate::check::MatchedPoint;
    use crate::data::crop::{CropOptions, crop};
    use crate::io::image::Rgb;
    use glam::Mat4;

    /// A photograph of smooth colour ramps, its levels times `gain`.
    fn photo(gain: f32) -> Photo {
        let mut image = Rgb::black(96, 96);
        for (i, p) in image.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = ((i % 96) as f32, (i / 96) as f32);
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
    fn darker_photographs_follow_the_first_and_equal_ones_stay() {
        let photos = [photo(1.0), photo(0.7), photo(0.7)];
        let options = CropOptions::square(64, 1, 16);
        let crops = |photos: &[Photo]| -> Vec<Cropped> {
            photos.iter().map(|p| crop(p.image(), p.camera(), &options).unwrap()).collect()
        };
        let mut inputs = crops(&photos);
        let warnings = equalise(&photos, &mut inputs, &[report(), report()]);
        assert_eq!(warnings.len(), 2, "{warnings:?}");
        for input in &inputs[1..] {
            let pairs = input.target.data.iter().zip(&inputs[0].target.data);
            let worst = pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(worst <= 3, "{worst}");
        }
        let same = [photo(1.0), photo(1.0)];
        let mut inputs = crops(&same);
        assert!(equalise(&same, &mut inputs, &[report()]).is_empty());
        assert_eq!(inputs, crops(&same));
    }
}
