//! Scores of pictures, and their means.

use crate::camera::NearFar;
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
}

impl Score {
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
        })
    }
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
        let score = |psnr: f64| Score { psnr, ssim: psnr / 100.0, lpips: None, sharpness: None };
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
        };
        let cases = vec![case("a", &[10.0]), case("a", &[10.0, 30.0]), case("b", &[30.0])];
        let all = Scores { methods: vec!["x".into(), "y".into()], cases };
        assert_eq!(all.mean("y").unwrap().psnr, 20.0);
        assert_eq!(all.mean("x").unwrap().psnr, 0.0);
        assert_eq!(all.scene_mean("a", "y").unwrap().psnr, 15.0);
        assert_eq!((all.mean("z"), all.scene_mean("c", "y")), (None, None));
        assert_eq!(all.scenes(), ["a", "b"]);
        let some = Score { lpips: Some(0.5), ..score(1.0) };
        assert_eq!(Score::mean([&some, &score(3.0)]).unwrap().lpips, Some(0.5));
    }
}
