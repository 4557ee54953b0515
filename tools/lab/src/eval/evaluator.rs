//! Scores the pictures of every method on the targets of a case.

use super::pictures::PictureMaker;
use super::preparation::{photos, whole_photos};
use super::{
    Benchmark, Case, CaseScores, Disturbance, GaussianReport, InputReport, Loaded, Method,
    Preparation, Score, Scores, TargetScores,
};
use crate::lpips::Lpips;
use std::path::Path;
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule, Cropped, LrFrom};
use subsplat::reconstruct::{
    Density, DepthBounds, DepthRange, Error, Photo, Reconstructor, Result, TargetSize,
};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::splats::SplatStatistics;
use subsplat_kernels::camera::{Camera, Size};
use subsplat_kernels::clock::Instant;

/// Default side of the inputs, px.
const SIDE: usize = 256;

/// Options of an evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Target side over input side, 1 to 8. The model's children fill the grid of the next whole
    /// number.
    pub upscale: f32,
    /// Width and height of the inputs, px. Default: the protocol's, else 256×256.
    pub input_size: Option<(usize, usize)>,
    /// Methods, in the order of the tables.
    pub methods: Vec<Method>,
    /// Principal points after the crop.
    pub rule: CropRule,
    /// Source of the inputs' pixels.
    pub lr_from: LrFrom,
    /// Disturbances of the inputs, in order.
    pub disturbances: Vec<Disturbance>,
    /// Preparation of the inputs, after their disturbances.
    pub preparation: Preparation,
    /// Number of the model's Gaussians.
    pub density: Density,
    /// Length of the refinement.
    pub refine: subsplat::Refine,
}

impl Options {
    /// The model, its Gaussians after the fit and the refinement of
    /// [`Reconstructor::run`](subsplat::reconstruct::Reconstructor::run), and every baseline that differs
    /// from the others at this `upscale`.
    pub fn new(upscale: f32) -> Self {
        use Method::{
            Backbone, Bilinear, Copy, Enlarged, Fit, Half, Lowpass, Mean, Refine, Subsplat, Uniform,
        };
        let enlarged: &[Method] = match upscale {
            _ if upscale > 2.0 => &[Half, Enlarged],
            _ if upscale > 1.0 => &[Enlarged],
            _ => &[],
        };
        let model: &[Method] = &[Subsplat, Fit, Refine];
        let rest: &[Method] = if upscale > 1.0 {
            &[Backbone, Lowpass, Bilinear, Uniform, Copy, Mean]
        } else {
            &[Backbone, Copy, Mean]
        };
        let methods = [model, enlarged, rest].concat();
        Self {
            upscale,
            input_size: None,
            methods,
            rule: CropRule::Exact,
            lr_from: LrFrom::HrCrop,
            disturbances: Vec::new(),
            preparation: Preparation::default(),
            density: Density::Auto,
            refine: subsplat::Refine::Auto,
        }
    }
}

/// Pictures of one target.
#[derive(Clone, Debug)]
pub struct TargetPictures {
    /// The photograph.
    pub truth: Rgb,
    /// One for each method, in their order.
    pub methods: Vec<Rgb>,
}

/// Scores and pictures of one case.
#[derive(Clone, Debug)]
pub struct CaseResult {
    /// The scores.
    pub scores: CaseScores,
    /// The inputs at the network's size.
    pub inputs: Vec<Rgb>,
    /// One set of pictures for each target.
    pub pictures: Vec<TargetPictures>,
    /// Seconds of each method from the cropped inputs to one picture: network, Gaussians, one view.
    /// 0 for pictures of other programs, and where the platform has no clock.
    pub seconds: Vec<f64>,
}

/// Scores methods on cases.
pub struct Evaluator {
    options: Options,
    lpips: Option<Lpips>,
}

/// Cropped inputs and targets of a case.
pub(super) struct Crops {
    pub(super) inputs: Vec<Cropped>,
    pub(super) targets: Vec<Cropped>,
    pub(super) bounds: DepthBounds,
    pub(super) depth_range: DepthRange,
}

impl Evaluator {
    /// An evaluator without LPIPS.
    pub fn new(options: Options) -> Self {
        Self { options, lpips: None }
    }

    /// Adds LPIPS with a weight file ([`Lpips::load`]).
    ///
    /// # Errors
    /// A file that holds no such weights.
    pub fn with_lpips(mut self, path: &Path) -> Result<Self> {
        self.lpips = Some(Lpips::load(path)?);
        Ok(self)
    }

    /// The options.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Names of the methods, in their order.
    pub fn methods(&self) -> Vec<String> {
        self.options.methods.iter().map(|m| m.name().to_owned()).collect()
    }

    /// Scores all cases of `benchmark`, and keeps no picture.
    ///
    /// # Errors
    /// As [`Evaluator::case`].
    pub fn run(&self, model: Option<&Reconstructor>, benchmark: &Benchmark) -> Result<Scores> {
        let one = |case: &Case| Ok(self.case(model, case, benchmark.load(case)?)?.scores);
        let cases = benchmark.cases().iter().map(one).collect::<Result<_>>()?;
        Ok(Scores { methods: self.methods(), cases })
    }

    /// Scores one case, and keeps its pictures.
    ///
    /// # Errors
    /// No model for a method that needs one; an error of the crop or of the network; a missing
    /// picture of another program; a picture that is not finite.
    pub fn case(
        &self,
        model: Option<&Reconstructor>,
        case: &Case,
        loaded: Loaded,
    ) -> Result<CaseResult> {
        let names = loaded.names.clone();
        let (whole, truth) = (loaded.context.clone(), loaded.targets.clone());
        let mut crops = self.crop(model, case, loaded)?;
        let given: Vec<Camera> = crops.inputs.iter().map(|c| c.target_camera).collect();
        for disturbance in &self.options.disturbances {
            disturbance.apply(&mut crops.inputs, &crops.bounds)?;
        }
        // `run` matches points in the whole photographs. Those of disturbed pictures are as given.
        let changed = self.options.disturbances.iter().any(|d| d.changes_pictures());
        let photos = |inputs: &[Cropped]| {
            if changed { photos(inputs) } else { whole_photos(&whole, &given, inputs) }
        };
        let Crops { inputs, targets, .. } = &mut crops;
        self.options.preparation.apply(&given, photos, inputs, &truth, targets)?;
        let place = format!("{} ({})", case.scene, case.pair());
        let mut pictures = PictureMaker::new(&self.options, model, &crops)?;
        let mut result = self.empty(case, (&crops, pictures.bounds()), &names);
        for (m, method) in self.options.methods.iter().enumerate() {
            let mut drawing = 0.0;
            for (t, target) in crops.targets.iter().enumerate() {
                pictures.select(method, &crops, &target.target_camera)?;
                let (w, h) = (target.target.width, target.target.height);
                let begin = Instant::now();
                let rgb = match method {
                    Method::Other { folder, .. } => {
                        let pair = case.pair();
                        let frame = (case.views.target[t], names[t].as_str());
                        let scene = (case.scene.as_str(), pair.as_str());
                        Method::other_picture(folder, scene, frame, (w, h))?.to_unit()
                    }
                    _ => pictures.picture(method, &crops, target),
                };
                drawing += begin.elapsed().as_secs_f64() / crops.targets.len() as f64;
                let place = format!("{place} target {} {}", names[t], method.name());
                let score = self.score(&rgb, &target.target, &place)?;
                result.scores.targets[t].scores.push(score);
                let Some(picture) = Rgb::from_unit(&rgb, w, h) else {
                    let expected = format!("a picture of {w}x{h}");
                    return Err(Error::argument(place, expected, rgb.len().to_string()));
                };
                debug_assert_eq!(result.pictures[t].methods.len(), m);
                result.pictures[t].methods.push(picture);
            }
            result.seconds.push(match method {
                Method::Other { .. } => 0.0,
                _ if method.needs_model() => pictures.seconds() + drawing,
                _ => drawing,
            });
            result.scores.inputs.push(self.input_report(&mut pictures, method, &crops, &place)?);
        }
        Ok(result)
    }

    /// Scores the pictures of `method` at the inputs' own cameras, and describes its Gaussians.
    fn input_report(
        &self,
        pictures: &mut PictureMaker<'_>,
        method: &Method,
        crops: &Crops,
        place: &str,
    ) -> Result<InputReport> {
        if !method.needs_model() {
            return Ok(InputReport::default());
        }
        let (mut scores, mut coverage) = (Vec::new(), 0.0);
        for (i, input) in crops.inputs.iter().enumerate() {
            let place = format!("{place} input {i} {}", method.name());
            pictures.select(method, crops, &input.target_camera)?;
            let rgb = pictures.picture(method, crops, input);
            scores.push(self.score(&rgb, &input.target, &place)?);
            coverage += pictures.coverage() / crops.inputs.len() as f64;
        }
        let cameras: Vec<Camera> = crops.inputs.iter().map(|c| c.target_camera).collect();
        let statistics = pictures.splats().and_then(|s| SplatStatistics::new(s, &cameras));
        Ok(InputReport {
            inputs: Score::mean(&scores),
            gaussians: statistics.map(|s| GaussianReport::new(&s, coverage)),
        })
    }

    fn empty(
        &self,
        case: &Case,
        (crops, bounds): (&Crops, &DepthBounds),
        names: &[String],
    ) -> CaseResult {
        let size = |p: Option<&Rgb>| p.map_or((0, 0), |p| (p.width, p.height));
        let Crops { inputs, targets, .. } = crops;
        let target = |(&frame, name): (&usize, &String)| TargetScores {
            frame,
            name: name.clone(),
            scores: Vec::new(),
        };
        let pictures = targets.iter();
        let pictures =
            pictures.map(|t| TargetPictures { truth: t.target.clone(), methods: Vec::new() });
        CaseResult {
            scores: CaseScores {
                scene: case.scene.clone(),
                context: case.views.context.clone(),
                sizes: [
                    size(inputs.first().map(|c| &c.input)),
                    size(targets.first().map(|c| &c.target)),
                ],
                near_far: bounds.near_far(),
                enlarged: targets.iter().any(|c| c.window.scale.min_element() < 1.0),
                targets: case.views.target.iter().zip(names).map(target).collect(),
                inputs: Vec::new(),
            },
            inputs: inputs.iter().map(|c| c.input.clone()).collect(),
            pictures: pictures.collect(),
            seconds: Vec::new(),
        }
    }

    fn crop(&self, model: Option<&Reconstructor>, case: &Case, loaded: Loaded) -> Result<Crops> {
        let Options { upscale, rule, lr_from, .. } = self.options;
        let stride = model.map_or(1, |m| m.config().stride());
        let nominal = self.options.input_size;
        let nominal = nominal.or(case.resolution.map(|[w, h]| (w, h))).unwrap_or((SIDE, SIDE));
        let photos = || loaded.context.iter().chain(&loaded.targets);
        let least = |side: fn(&Photo) -> usize| photos().map(side).min().unwrap_or(0);
        let least = (least(|p| p.image().width), least(|p| p.image().height));
        let (width, height) = fitting(nominal, upscale, stride, least);
        let input_size = Size { width, height };
        let target_size = TargetSize::Times(upscale).resolve(input_size, 1, &[]);
        let options =
            CropOptions { rule, lr_from, target_size, ..CropOptions::new(input_size, 1, stride) };
        let cropped =
            |photos: &[Photo]| photos.iter().map(|p| p.crop(&options)).collect::<Result<Vec<_>>>();
        Ok(Crops {
            inputs: cropped(&loaded.context)?,
            targets: cropped(&loaded.targets)?,
            bounds: loaded.bounds,
            depth_range: loaded.depth_range,
        })
    }

    fn score(&self, picture: &[f32], truth: &Rgb, place: &str) -> Result<Score> {
        let unscored = |e| Error::Score { place: place.to_owned(), source: e };
        let mut score = Score::of(picture, truth).map_err(unscored)?;
        if let Some(lpips) = &self.lpips {
            let (w, h) = (truth.width, truth.height);
            score.lpips = Some(lpips.distance(picture, &truth.to_unit(), w, h)?);
        }
        Ok(score)
    }
}

/// The input size of a case. `nominal` is halved while the smallest photograph (`least`) does
/// not cover the target, and the target stays no smaller than `nominal`.
fn fitting(
    nominal: (usize, usize),
    upscale: f32,
    stride: usize,
    least: (usize, usize),
) -> (usize, usize) {
    let (mut size, mut ratio) = (nominal, upscale);
    let covers = |s: (usize, usize)| {
        s.0 as f32 * upscale <= least.0 as f32 && s.1 as f32 * upscale <= least.1 as f32
    };
    while ratio >= 2.0 && !covers(size) && size.0 / 2 >= stride && size.1 / 2 >= stride {
        size = (size.0 / 2, size.1 / 2);
        ratio /= 2.0;
    }
    size
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inputs_are_halved_where_photographs_are_small() {
        let side = |upscale: f32, least| fitting((256, 256), upscale, 32, least).0;
        assert_eq!(side(1.0, (256, 300)), 256);
        assert_eq!(side(2.0, (512, 600)), 256);
        assert_eq!(side(2.0, (540, 360)), 128);
        // The target is never smaller than the nominal input.
        assert_eq!(side(2.0, (200, 200)), 128);
        assert_eq!(side(1.0, (200, 200)), 256);
        assert_eq!(side(4.0, (1920, 1080)), 256);
        assert_eq!(side(4.0, (800, 600)), 128);
        assert_eq!(side(4.0, (400, 300)), 64);
        assert_eq!((side(3.0, (600, 600)), side(1.5, (300, 300))), (128, 256));
        assert_eq!(fitting((64, 48), 4.0, 32, (100, 100)), (64, 48));
    }
}
