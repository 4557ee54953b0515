//! Scores of pictures and figures of Gaussians, and their means.

use super::mask::Mask;
use super::metrics::{MetricsError, gmsd, mean_gradient, psnr, ssim};
use super::splats::SplatStatistics;
use crate::scene::pictures::Rgb;
use serde::Serialize;

/// Similarity of a picture to the photograph.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Peak signal-to-noise ratio, dB; infinite for the same picture (JSON: null).
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
    /// Perceptual distance; `None` without VGG16's weights.
    pub lpips: Option<f64>,
    /// Mean absolute gradient over the photograph's; `None` where that is 0.
    pub sharpness: Option<f64>,
    /// Gradient magnitude similarity deviation: 0 for the same picture, larger for worse ones.
    pub gmsd: f64,
}

impl Score {
    /// Compares a picture `[H, W, 3]`, display values, with a photograph of its size; no LPIPS.
    ///
    /// # Errors
    /// Another size; values that are not finite; a side below 11 px.
    pub fn of(picture: &[f32], truth: &Rgb) -> Result<Self, MetricsError> {
        let (w, h) = (truth.width, truth.height);
        let truth = truth.to_unit();
        let own = mean_gradient(picture, w, h)?;
        let theirs = mean_gradient(&truth, w, h)?;
        Ok(Self {
            psnr: psnr(picture, &truth, w, h)?,
            ssim: ssim(picture, &truth, w, h)?,
            lpips: None,
            sharpness: (theirs > 0.0).then(|| own / theirs),
            gmsd: gmsd(picture, &truth, w, h)?,
        })
    }

    /// [`Score::of`] where `mask`, of the photograph's size, keeps it: PSNR of the pixels that count. Masked pixels
    /// count as equal for the figures that compare surroundings.
    ///
    /// # Errors
    /// Those of [`Score::of`]; no pixel that counts.
    pub fn of_kept(
        picture: &[f32],
        truth: &Rgb,
        mask: Option<&Mask>,
    ) -> Result<Self, MetricsError> {
        let Some(mask) = mask.filter(|mask| mask.fits(truth)) else {
            return Self::of(picture, truth);
        };
        let unit = truth.to_unit();
        let psnr = psnr_of_kept(picture, &unit, (truth.width, truth.height), Some(mask))?;
        Ok(Self { psnr, ..Self::of(&mask.merged(picture, &unit), truth)? })
    }

    /// Averages each figure; an optional one over the scores that have it.
    pub fn mean<'a>(scores: impl IntoIterator<Item = &'a Score>) -> Option<Score> {
        let all: Vec<&Score> = scores.into_iter().collect();
        let mean = |values: Vec<f64>| {
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        Some(Self {
            psnr: mean(all.iter().map(|s| s.psnr).collect())?,
            ssim: mean(all.iter().map(|s| s.ssim).collect())?,
            lpips: mean(all.iter().filter_map(|s| s.lpips).collect()),
            sharpness: mean(all.iter().filter_map(|s| s.sharpness).collect()),
            gmsd: mean(all.iter().map(|s| s.gmsd).collect())?,
        })
    }
}

/// PSNR of the pixels of a picture `[H, W, 3]`, display values, of `width` × `height` pixels, that `mask` keeps, dB.
///
/// # Errors
/// Pictures of other sizes; values that are not finite; no pixel that counts.
pub fn psnr_of_kept(
    picture: &[f32],
    truth: &[f32],
    (width, height): (usize, usize),
    mask: Option<&Mask>,
) -> Result<f64, MetricsError> {
    match mask {
        None => psnr(picture, truth, width, height),
        Some(mask) => psnr(&mask.kept_of(picture), &mask.kept_of(truth), mask.count(), 1),
    }
}

/// Distribution of a method's Gaussians, or its mean over cases.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GaussianReport {
    /// Number of Gaussians.
    pub count: f64,
    /// σ in target px, the 10 %, 50 % and 90 % quantiles ([`SplatStatistics::sigma_px`]).
    pub sigma_px: [f64; 3],
    /// Opacity, the same quantiles.
    pub opacity: [f64; 3],
    /// Mean alpha of the pictures at the inputs' own cameras.
    pub coverage: f64,
}

impl GaussianReport {
    /// Joins statistics of Gaussians and the mean alpha of their pictures.
    pub fn new(statistics: &SplatStatistics, coverage: f64) -> Self {
        let [sigma_px, opacity] = [statistics.sigma_px, statistics.opacity]
            .map(|q| [q.low, q.middle, q.high].map(f64::from));
        Self { count: statistics.count as f64, sigma_px, opacity, coverage }
    }

    /// Averages each figure.
    pub fn mean(reports: &[Self]) -> Option<Self> {
        let n = reports.len() as f64;
        let mean = |value: &dyn Fn(&Self) -> f64| reports.iter().map(value).sum::<f64>() / n;
        (!reports.is_empty()).then(|| Self {
            count: mean(&|r| r.count),
            sigma_px: [0, 1, 2].map(|i| mean(&|r| r.sigma_px[i])),
            opacity: [0, 1, 2].map(|i| mean(&|r| r.opacity[i])),
            coverage: mean(&|r| r.coverage),
        })
    }
}

/// A method's pictures at the inputs' own cameras, and its Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct InputReport {
    /// Score of the pictures at the inputs' own cameras, at the targets' size; none for methods
    /// without a model.
    pub inputs: Option<Score>,
    /// The Gaussians; none for methods without a model.
    pub gaussians: Option<GaussianReport>,
}
