//! Scores of methods by target, case and scene, and their means.

use subsplat::scene::score::{GaussianReport, InputReport, Score};
use subsplat_kernels::camera::NearFar;

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
