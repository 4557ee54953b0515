//! Scores of pictures, and their means.

use crate::camera::NearFar;
use crate::io::image::Rgb;
use crate::metrics::{MetricsError, gmsd, mean_gradient, psnr, ssim};
use crate::splats::SplatStatistics;
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
        let (own, theirs) = (mean_gradient(picture, w, h)?, mean_gradient(&truth, w, h)?);
        Ok(Self {
            psnr: psnr(picture, &truth, w, h)?,
            ssim: ssim(picture, &truth, w, h)?,
            lpips: None,
            sharpness: (theirs > 0.0).then(|| own / theirs),
            gmsd: gmsd(picture, &truth, w, h)?,
        })
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

/// Every method's score of one target.
#[derive(Clone, Debug, PartialEq)]
pub struct TargetScores {
    /// Frame of the scene.
    pub frame: usize,
    /// Its name.
    pub name: String,
    /// In the order of [`Scores::methods`].
    pub scores: Vec<Score>,
}

/// Every method's scores of one case.
#[derive(Clone, Debug, PartialEq)]
pub struct CaseScores {
    /// Name of the scene.
    pub scene: String,
    /// Frames of the inputs.
    pub context: Vec<usize>,
    /// Width and height of the inputs and of the targets, px.
    pub sizes: [(usize, usize); 2],
    /// Nearest and farthest depth candidate, world units.
    pub near_far: NearFar,
    /// True if a photograph was enlarged to the target's size.
    pub enlarged: bool,
    /// One for each target.
    pub targets: Vec<TargetScores>,
    /// One for each method, in the order of [`Scores::methods`].
    pub inputs: Vec<InputReport>,
}

impl CaseScores {
    /// Averages the scores of the method with this index over the targets.
    pub fn mean(&self, method: usize) -> Option<Score> {
        Score::mean(self.targets.iter().filter_map(|t| t.scores.get(method)))
    }
}

/// All scores of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Names of the methods.
    pub methods: Vec<String>,
    /// In the order of the data.
    pub cases: Vec<CaseScores>,
}

impl Scores {
    /// Averages each case's mean over all cases.
    pub fn mean(&self, method: &str) -> Option<Score> {
        self.mean_of(self.cases.iter(), method)
    }

    /// Averages each case's mean over the cases of one scene.
    pub fn scene_mean(&self, scene: &str, method: &str) -> Option<Score> {
        self.mean_of(self.cases.iter().filter(|c| c.scene == scene), method)
    }

    fn mean_of<'a>(
        &self,
        cases: impl Iterator<Item = &'a CaseScores>,
        method: &str,
    ) -> Option<Score> {
        let place = self.methods.iter().position(|m| m == method)?;
        let means: Vec<Score> = cases.filter_map(|c| c.mean(place)).collect();
        Score::mean(&means)
    }

    /// Averages the reports on the inputs over all cases, or over those of one scene.
    pub fn input_mean(&self, scene: Option<&str>, method: &str) -> InputReport {
        let Some(place) = self.methods.iter().position(|m| m == method) else {
            return InputReport::default();
        };
        let cases = self.cases.iter().filter(|c| scene.is_none_or(|s| c.scene == s));
        let found: Vec<InputReport> = cases.filter_map(|c| c.inputs.get(place).copied()).collect();
        let gaussians: Vec<GaussianReport> = found.iter().filter_map(|r| r.gaussians).collect();
        InputReport {
            inputs: Score::mean(found.iter().filter_map(|r| r.inputs.as_ref())),
            gaussians: GaussianReport::mean(&gaussians),
        }
    }

    /// Names of the scenes, once each, in the order of the data.
    pub fn scenes(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for case in &self.cases {
            if !names.contains(&case.scene.as_str()) {
                names.push(&case.scene);
            }
        }
        names
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_first_then_cases() {
        let score = |psnr: f64| {
            let (ssim, gmsd) = (psnr / 100.0, 0.1);
            Score { psnr, ssim, lpips: None, sharpness: None, gmsd }
        };
        let report = |psnr: f64| {
            let (sigma_px, opacity) = ([psnr; 3], [0.5; 3]);
            let gaussians = GaussianReport { count: psnr, sigma_px, opacity, coverage: 1.0 };
            InputReport { inputs: Some(score(psnr)), gaussians: Some(gaussians) }
        };
        let target = |psnr: f64| TargetScores {
            frame: 0,
            name: String::new(),
            scores: vec![score(0.0), score(psnr)],
        };
        let case = |scene: &str, values: &[f64]| CaseScores {
            scene: scene.to_owned(),
            context: vec![0, 1],
            sizes: [(1, 1); 2],
            near_far: NearFar::new(1.0, 2.0),
            enlarged: false,
            targets: values.iter().map(|v| target(*v)).collect(),
            inputs: vec![InputReport::default(), report(values[0])],
        };
        let cases = vec![case("a", &[10.0]), case("a", &[10.0, 30.0]), case("b", &[30.0])];
        let all = Scores { methods: vec!["x".into(), "y".into()], cases };
        assert_eq!(all.mean("y").unwrap().psnr, 20.0);
        assert_eq!(all.mean("x").unwrap().psnr, 0.0);
        assert_eq!(all.scene_mean("a", "y").unwrap().psnr, 15.0);
        assert_eq!((all.mean("z"), all.scene_mean("c", "y")), (None, None));
        assert_eq!(all.scenes(), ["a", "b"]);
        assert_eq!(all.input_mean(None, "x"), InputReport::default());
        let mean = all.input_mean(None, "y");
        assert!((mean.inputs.unwrap().psnr - 50.0 / 3.0).abs() < 1e-12);
        assert!((mean.gaussians.unwrap().sigma_px[1] - 50.0 / 3.0).abs() < 1e-12);
        assert_eq!(all.input_mean(Some("b"), "y"), report(30.0));
        let some = Score { lpips: Some(0.5), ..score(1.0) };
        assert_eq!(Score::mean([&some, &score(3.0)]).unwrap().lpips, Some(0.5));
    }
}
