//! Renders the targets of a case by every method, and scores the pictures.

use super::methods::{enlarged, mean, nearest};
use super::{
    Benchmark, Case, CaseScores, Disturbance, GaussianReport, InputReport, Loaded, Method, Score,
    Scores, TargetScores,
};
use crate::abi::RasterOptions;
use crate::camera::{Camera, Size};
use crate::clock::Instant;
use crate::config::LowpassRef;
use crate::cpu::Rasterizer;
use crate::data::crop::{CropOptions, CropRule, Cropped, LrFrom};
use crate::fit::FitOptions;
use crate::io::image::Rgb;
use crate::model::lpips::Lpips;
use crate::model::subsplat::feature_channels;
use crate::model::trunk::Trunk;
use crate::model::weights::Weights;
use crate::pipeline::{
    Density, DepthBounds, DepthRange, Encoded, Error, Photo, Reconstructor, Refine, Result,
    SceneChildren, TargetSize, add_detail, fit_to_inputs, refine_on_inputs, sides_of,
};
use crate::refine::Refiner;
use crate::render::{Renderer, render_with};
use crate::splats::{SplatStatistics, Splats};
use std::ops::ControlFlow;
use std::path::Path;

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
    /// Number of the model's Gaussians.
    pub density: Density,
}

impl Options {
    /// The model, its Gaussians after the fit and the refinement of
    /// [`Reconstructor::run`](crate::pipeline::Reconstructor::run), and every baseline that differs
    /// from the others at this `upscale`.
    pub fn new(upscale: f32) -> Self {
        use Method::{Backbone, Bilinear, Copy, Fit, Lowpass, Mean, Refine, Subsplat, Uniform};
        let methods = match upscale > 1.0 {
            false => vec![Subsplat, Fit, Refine, Backbone, Copy, Mean],
            true => vec![Subsplat, Fit, Refine, Backbone, Lowpass, Bilinear, Uniform, Copy, Mean],
        };
        Self {
            upscale,
            input_size: None,
            methods,
            rule: CropRule::Exact,
            lr_from: LrFrom::HrCrop,
            disturbances: Vec::new(),
            density: Density::Auto,
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
struct Crops {
    inputs: Vec<Cropped>,
    targets: Vec<Cropped>,
    bounds: DepthBounds,
    depth_range: DepthRange,
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
        let mut crops = self.crop(model, case, loaded)?;
        self.options.disturbances.iter().for_each(|d| d.apply(&mut crops.inputs));
        let place = format!("{} ({})", case.scene, case.pair());
        let mut pictures = PictureMaker::new(self, model, &crops)?;
        let mut result = self.empty(case, (&crops, &pictures.bounds), &names);
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
            coverage += pictures.coverage / crops.inputs.len() as f64;
        }
        let cameras: Vec<Camera> = crops.inputs.iter().map(|c| c.target_camera).collect();
        let statistics = pictures.splats.as_ref();
        let statistics = statistics.and_then(|c| SplatStatistics::new(&c.splats, &cameras));
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
        let target_size = TargetSize::Times(upscale).resolve(input_size, 1);
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

/// Makes the pictures of one case. One set of Gaussians is in memory at a time.
struct PictureMaker<'a> {
    /// Target side over input side.
    upscale: f32,
    /// Depth range of the network's candidates.
    bounds: DepthBounds,
    /// Mean colour of the inputs.
    colour: [f32; 3],
    network: Option<Network<'a>>,
    density: Density,
    /// The set that `splats` holds.
    current: Option<Set>,
    splats: Option<SceneChildren>,
    rasterizer: Rasterizer,
    /// Mean alpha of the last rendered picture.
    coverage: f64,
    /// Seconds of depth range, backbone and primaries.
    network_seconds: f64,
    /// Seconds of the current set, made of the primaries.
    set_seconds: f64,
}

/// The backbone's outputs of one case, and the model.
struct Network<'a> {
    model: &'a Reconstructor,
    views: crate::model::Views,
    output: crate::model::BackboneOutput,
    parents: crate::model::Primaries,
}

/// A set of Gaussians that methods share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Set {
    Children,
    Detailed,
    Fitted,
    Refined,
    /// The children of two inputs alone, with detail.
    Pair([usize; 2]),
    Opaque,
    Random,
    Parents,
    Uniform,
}

/// Sets of which each is made of the one before it.
const REFINED_IN_ORDER: [Set; 4] = [Set::Children, Set::Detailed, Set::Fitted, Set::Refined];

impl Set {
    /// The set of `method` for a picture seen by `camera`.
    fn of(method: &Method, inputs: &[Cropped], camera: &Camera) -> Option<Self> {
        match method {
            Method::Subsplat => Some(Self::Children),
            Method::Detail => Some(Self::Detailed),
            Method::Fit => Some(Self::Fitted),
            Method::Refine => Some(Self::Refined),
            Method::Pair => nearest_two(inputs, camera).map(Self::Pair),
            Method::Opaque => Some(Self::Opaque),
            Method::Random => Some(Self::Random),
            Method::Backbone | Method::Lowpass | Method::Bilinear => Some(Self::Parents),
            Method::Uniform => Some(Self::Uniform),
            Method::Copy | Method::Mean | Method::Other { .. } => None,
        }
    }
}

impl<'a> PictureMaker<'a> {
    fn new(evaluator: &Evaluator, model: Option<&'a Reconstructor>, crops: &Crops) -> Result<Self> {
        let begin = Instant::now();
        let needed = evaluator.options.methods.iter().find(|m| m.needs_model());
        let mut bounds = crops.bounds.clone();
        let network = match (needed, model) {
            (None, _) => None,
            (Some(method), None) => return Err(Error::argument(method.name(), "a model", "none")),
            (Some(_), Some(model)) => {
                let (views, found) = model.views(&crops.inputs, bounds, crops.depth_range)?;
                bounds = found;
                let output = model.model().encode(&views)?;
                let parents = model.model().primaries(&views, &output)?;
                Some(Network { model, views, output, parents })
            }
        };
        Ok(Self {
            upscale: evaluator.options.upscale,
            bounds,
            colour: Rgb::mean_colour(crops.inputs.iter().map(|c| &c.input)),
            network,
            density: evaluator.options.density,
            current: None,
            splats: None,
            rasterizer: Rasterizer::new(),
            coverage: 0.0,
            network_seconds: begin.elapsed().as_secs_f64(),
            set_seconds: 0.0,
        })
    }

    /// Seconds from the inputs to the current Gaussians.
    fn seconds(&self) -> f64 {
        self.network_seconds + self.set_seconds
    }

    /// Makes the Gaussians of `method` for a picture seen by `camera`, unless they are in memory.
    fn select(&mut self, method: &Method, crops: &Crops, camera: &Camera) -> Result<()> {
        let set = Set::of(method, &crops.inputs, camera);
        let (Some(set), Some(network)) = (set, &self.network) else { return Ok(()) };
        if self.current == Some(set) {
            return Ok(());
        }
        let begin = Instant::now();
        let place = |set: Set| REFINED_IN_ORDER.iter().position(|s| *s == set);
        let mut before = 0.0;
        let (from, to) = (self.current.and_then(place), place(set));
        let splats = match (from, to, self.splats.take()) {
            (Some(from), Some(to), Some(splats)) if from < to => {
                before = self.set_seconds;
                self.refined(network, splats, crops, &REFINED_IN_ORDER[from + 1..=to])?
            }
            (_, Some(to), _) => {
                let raster = self.raster_options(network, 1.0, None);
                let children = network.children(&crops.inputs, self.density, &raster)?;
                self.refined(network, children, crops, &REFINED_IN_ORDER[1..=to])?
            }
            (_, None, _) => SceneChildren::of_splats(match set {
                Set::Pair(pair) => network.splats_of_pair(pair, crops)?,
                Set::Opaque | Set::Random => self.reduced(network, crops, set)?,
                _ => network.splats(set, self.upscale.ceil() as usize)?,
            }),
        };
        self.set_seconds = before + begin.elapsed().as_secs_f64();
        (self.current, self.splats) = (Some(set), Some(splats));
        Ok(())
    }

    /// Takes `splats` through the steps `sets` of [`REFINED_IN_ORDER`].
    fn refined(
        &self,
        network: &Network<'_>,
        mut children: SceneChildren,
        crops: &Crops,
        sets: &[Set],
    ) -> Result<SceneChildren> {
        let (inputs, upscale) = (&crops.inputs, network.model.config().upscale);
        let raster = self.raster_options(network, self.upscale, None);
        let mut renderer = Renderer::default();
        for set in sets {
            let renderer = &mut renderer;
            match set {
                Set::Detailed => {
                    children.add_detail(inputs, upscale)?;
                }
                Set::Fitted => {
                    let options = FitOptions::default();
                    let mut progress = |_: usize| ControlFlow::Continue(());
                    let splats = &mut children.splats;
                    fit_to_inputs(splats, inputs, &raster, &options, renderer, &mut progress)?;
                }
                _ => {
                    // As `run`: none of more Gaussians than `Auto` refines.
                    let SceneChildren { splats, groups, .. } = &mut children;
                    let options = Refine::Auto.options_for(inputs.len(), splats.len(), true);
                    let (raster, how) = (&raster, &options);
                    let mut progress = |_: &Refiner<'_>| ControlFlow::Continue(());
                    refine_on_inputs(splats, groups, inputs, raster, how, renderer, &mut progress)?;
                }
            }
        }
        Ok(children)
    }

    /// The Gaussians of [`Set::Detailed`] at full density, as many as the density allows: those of
    /// the highest opacities ([`Set::Opaque`]), or random ones.
    fn reduced(&self, network: &Network<'_>, crops: &Crops, set: Set) -> Result<Splats> {
        let raster = self.raster_options(network, 1.0, None);
        let mut children = network.children(&crops.inputs, Density::Full, &raster)?;
        let upscale = network.model.config().upscale;
        children.add_detail(&crops.inputs, upscale)?;
        let splats = children.splats;
        let limit = self.density.limit(splats.parents(), crops.inputs.len(), upscale);
        let rank = |i: usize| match set {
            Set::Opaque => f64::from(splats.opacity(i)),
            // The fractional part of multiples of the golden ratio is spread evenly.
            _ => (i as f64 * 0.618_033_988_749_895).fract(),
        };
        let mut order: Vec<usize> = (0..splats.len()).collect();
        order.sort_by(|a, b| rank(*b).total_cmp(&rank(*a)));
        order.truncate(limit);
        order.sort_unstable();
        Ok(splats.selected(&order))
    }

    fn picture(&mut self, method: &Method, crops: &Crops, target: &Cropped) -> Vec<f32> {
        let (r, camera) = (self.upscale, &target.target_camera);
        let size = (target.target.width, target.target.height);
        match method {
            Method::Copy => nearest(&crops.inputs, camera, size),
            Method::Mean => mean(&crops.inputs, size),
            Method::Lowpass => self.render(camera, r, Some(LowpassRef::Input)),
            Method::Backbone => self.render(camera, r, Some(LowpassRef::Target)),
            Method::Bilinear => {
                let small = self.render(&target.input_camera, 1.0, None);
                enlarged(&small, (target.input.width, target.input.height), size)
            }
            _ => self.render(camera, r, None),
        }
    }

    /// The model's rules of rendering pictures whose pixels are 1/`ratio` input pixels.
    fn raster_options(
        &self,
        network: &Network<'_>,
        ratio: f32,
        reference: Option<LowpassRef>,
    ) -> RasterOptions {
        let mut config = network.model.config().clone();
        config.render.lowpass_ref = reference.unwrap_or(config.render.lowpass_ref);
        config.raster_options(ratio, self.bounds.near, self.colour)
    }

    /// Renders the current Gaussians from `camera`, whose pixels are 1/`ratio` input pixels.
    fn render(&mut self, camera: &Camera, ratio: f32, reference: Option<LowpassRef>) -> Vec<f32> {
        let (Some(network), Some(children)) = (&self.network, &self.splats) else {
            return Vec::new();
        };
        let options = self.raster_options(network, ratio, reference);
        let picture = render_with(&mut self.rasterizer, &children.splats, camera, &options);
        let alpha: f64 = picture.alpha.iter().copied().map(f64::from).sum();
        self.coverage = alpha / picture.alpha.len().max(1) as f64;
        picture.rgb
    }
}

impl Network<'_> {
    /// The model's Gaussians, without detail. `raster` renders pictures of the input's size.
    fn children(
        &self,
        inputs: &[Cropped],
        density: Density,
        raster: &RasterOptions,
    ) -> Result<SceneChildren> {
        let Self { views, output, parents: primaries, .. } = self;
        let (network, encoded) = (self.model.model(), Encoded { views, output, primaries });
        let mut renderer = Renderer::default();
        let sides = sides_of(network, &encoded, inputs, density, raster, &mut renderer)?;
        Ok(SceneChildren::new(network, &encoded, inputs.len(), sides, &|| Ok(()))?)
    }

    /// Gaussians of a baseline.
    fn splats(&self, set: Set, r: usize) -> Result<Splats> {
        let mut config = self.model.config().clone();
        let own;
        let trunk = match set {
            Set::Parents | Set::Uniform => {
                config.upscale = r;
                config.spgr.enabled = set == Set::Uniform;
                // Heads whose last layers are zero do not depend on their inputs.
                config.spgr.zero_init = true;
                config.agg.enabled = false;
                let start = Weights::seeded(0).builder();
                own = Trunk::new(&config, &feature_channels(&config), start)?;
                &own
            }
            _ => self.model.model().trunk(),
        };
        let children = trunk.forward(&self.views, &self.output, &self.parents);
        Ok(children.and_then(|c| c.to_splats())?)
    }

    /// The children of two inputs alone, with detail.
    fn splats_of_pair(&self, pair: [usize; 2], crops: &Crops) -> Result<Splats> {
        let inputs = pair.map(|i| crops.inputs[i].clone());
        let (model, network) = (self.model, self.model.model());
        let (views, _) = model.views(&inputs, crops.bounds.clone(), crops.depth_range)?;
        let output = network.encode(&views)?;
        let parents = network.primaries(&views, &output)?;
        let mut splats = network.trunk().forward(&views, &output, &parents)?.to_splats()?;
        add_detail(&mut splats, &inputs, model.config().upscale)?;
        Ok(splats)
    }
}

/// The two inputs whose cameras are nearest to `camera`, in ascending order.
fn nearest_two(inputs: &[Cropped], camera: &Camera) -> Option<[usize; 2]> {
    let distance = |i: usize| inputs[i].input_camera.position().distance(camera.position());
    let mut order: Vec<usize> = (0..inputs.len()).collect();
    order.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    let [a, b] = order.get(..2)?.try_into().ok()?;
    Some([a.min(b), a.max(b)])
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
