//! The model that reconstructs scenes.

use super::progress::{Callback, StageCost, Tracker};
use super::warning::Warning;
use super::{
    Check, DepthBounds, DepthRange, DepthSource, Detail, Error, EstimateOptions, Options, Photo,
    Photographs, Poses, Prepared, Progress, Reconstruction, Refine, Result, Stage, check_pairs,
    check_refine, equal_exposure, estimate_cameras, is_mvsplat, poses,
};
use crate::cameras::check::PairReport;
use crate::cameras::estimation::PoseAdjustment;
use crate::network::config::{Config, Preset};
use crate::network::model::subsplat::SubSplat;
use crate::network::model::weights::{SUBSPLAT_PREFIX, Weights};
use crate::network::model::{Backend, Views};
use crate::reconstruct::inputs::crop::{CropOptions, Cropped};
use crate::reconstruct::inputs::pair::choose_sources;
use candle_core::{Device, Tensor};
use std::borrow::Cow;
use std::ops::ControlFlow;
use std::path::Path;
use subsplat_kernels::camera::{Camera, NearFar, Size};
use subsplat_kernels::cpu::SimdLevel;

/// A network with weights, ready to reconstruct scenes.
pub struct Reconstructor {
    model: SubSplat,
    weights: Weights,
    backend: Backend,
    /// SubSplat's tensors that the weight file lacks.
    missing: usize,
}

impl Reconstructor {
    /// Builds a model with seeded, untrained weights. The small backbone is then a plain plane
    /// sweep and gives a usable scene; MVSplat's gives noise.
    ///
    /// # Errors
    /// A configuration out of range; an environment variable `SUBSPLAT_SIMD` that names no level
    /// of this processor.
    pub fn untrained(config: &Config, seed: u64) -> Result<Self> {
        Self::build(config, Weights::seeded(seed))
    }

    /// Builds the model that ships at ×`upscale`, 1 to 8: each input pixel has `upscale`²
    /// Gaussians.
    ///
    /// # Errors
    /// An `upscale` out of range; `SUBSPLAT_SIMD` as in [`Reconstructor::untrained`].
    pub fn shipped(upscale: usize) -> Result<Self> {
        Self::from_weights(Weights::shipped(upscale)?, None)
    }

    /// Builds a model from a weight file. `config` replaces the file's own configuration. A
    /// file without one must fit `config`, by default MVSplat with the `tuned` preset and ×2.
    /// SubSplat's tensors may be missing (a converted MVSplat checkpoint): they start untrained,
    /// with a [`Warning::UntrainedTensors`].
    ///
    /// # Errors
    /// A file that holds no weights; a tensor that is missing or has another shape, named with
    /// both shapes; a configuration out of range; `SUBSPLAT_SIMD` as in
    /// [`Reconstructor::untrained`].
    pub fn load(path: impl AsRef<Path>, config: Option<&Config>) -> Result<Self> {
        Self::from_weights(Weights::load(path.as_ref())?, config)
    }

    /// [`Reconstructor::load`] from weights in memory.
    ///
    /// # Errors
    /// Those of [`Reconstructor::load`].
    pub fn from_weights(weights: Weights, config: Option<&Config>) -> Result<Self> {
        let weights = weights.allow_missing(SUBSPLAT_PREFIX, 0);
        let config = match (config, weights.config()) {
            (Some(config), _) | (None, Some(config)) => config.clone(),
            (None, None) => Config::re10k(Preset::Tuned, 2),
        };
        let mut built = Self::build(&config, weights)?;
        built.missing = built.untrained_tensors().len();
        Ok(built)
    }

    fn build(config: &Config, weights: Weights) -> Result<Self> {
        SimdLevel::requested()
            .map_err(|level| Error::argument(level.variable(), level.expected(), level.found()))?;
        let model = SubSplat::new(config, weights.builder())?;
        Ok(Self { model, weights, backend: Backend::Cpu, missing: 0 })
    }

    /// The same model on another backend ([`SubSplat::with_backend`]). Where a GPU fails, the CPU
    /// does the work, with a [`Warning::CpuInsteadOfGpu`].
    #[must_use]
    pub fn with_backend(self, backend: &Backend) -> Self {
        let model = self.model.with_backend(backend);
        Self { model, backend: backend.clone(), ..self }
    }

    /// The model's configuration.
    pub fn config(&self) -> &Config {
        self.model.config()
    }

    /// The network.
    pub fn model(&self) -> &SubSplat {
        &self.model
    }

    /// Names of the tensors that no file gave.
    pub fn untrained_tensors(&self) -> Vec<String> {
        self.weights.initialised()
    }

    /// Names in the weight file that the model does not have.
    pub fn unexpected_tensors(&self) -> Vec<String> {
        self.weights.unexpected()
    }

    /// Returns the model with r = `upscale`: `upscale`² children per primary.
    ///
    /// # Errors
    /// `upscale` is not in 1 to 8, or the weights hold heads for another number of children.
    pub fn with_upscale(self, upscale: usize) -> Result<Self> {
        Ok(Self { model: self.model.with_upscale(upscale)?, ..self })
    }

    /// Crop of a photograph for inputs of `input_size`, and targets of the model's upscale.
    pub fn crop_options(&self, input_size: Size) -> CropOptions {
        let config = self.config();
        CropOptions::new(input_size, config.upscale, config.stride())
    }

    /// Reconstructs the scene of two or more photographs, with cameras ([`Photo`]) or without
    /// ([`Photograph`](crate::Photograph)): cameras that are missing are estimated from points that the
    /// photographs share.
    ///
    /// # Errors
    /// Fewer than two photographs; options out of range; poses that [`Check::Refuse`] rejects;
    /// photographs that do not determine their cameras; an error of the network.
    pub fn run<'a>(
        &self,
        photos: impl Into<Photographs<'a>>,
        options: &Options,
    ) -> Result<Reconstruction> {
        self.run_with(photos, options, &mut |_| ControlFlow::Continue(()))
    }

    /// [`Reconstructor::run`] with a callback for progress. The callback runs on the
    /// calling thread: at the start of each stage, after each photograph and pair, within the
    /// network and after each step of the fit. [`ControlFlow::Break`] cancels. On a thread of a
    /// rayon pool the stages of the network give no reports of their own.
    ///
    /// # Errors
    /// Those of [`Reconstructor::run`]; [`Error::Cancelled`](super::Error::Cancelled).
    pub fn run_with<'a>(
        &self,
        photos: impl Into<Photographs<'a>>,
        options: &Options,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let prepared = match photos.into() {
            Photographs::WithCameras(photos) => self.prepare_with(photos, options, progress)?,
            Photographs::WithoutCameras(photographs) => {
                let estimated = estimate_cameras(photographs, &EstimateOptions::default())?;
                self.prepare_with(&estimated.photos, options, progress)?
            }
        };
        prepared.reconstruct_with(progress)
    }

    /// Crops the photographs, checks their poses and determines the depth range. The result
    /// holds no photograph at full size, so that the caller can free them before
    /// [`Prepared::reconstruct`].
    ///
    /// # Errors
    /// Those of [`Reconstructor::run`], but for the network's.
    pub fn prepare(&self, photos: &[Photo], options: &Options) -> Result<Prepared<'_>> {
        self.prepare_with(photos, options, &mut |_| ControlFlow::Continue(()))
    }

    /// [`Reconstructor::prepare`] with a callback for progress.
    ///
    /// # Errors
    /// Those of [`Reconstructor::prepare`]; [`Error::Cancelled`](super::Error::Cancelled).
    pub fn prepare_with(
        &self,
        photos: &[Photo],
        options: &Options,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    ) -> Result<Prepared<'_>> {
        check_refine(options.refine)?;
        let sizes: Vec<Size> = photos.iter().map(Photo::size).collect();
        let stride = self.config().stride();
        let upscale = self.config().upscale;
        let input_size = options.input_size_for(&sizes, stride, upscale);
        let target_size = options.target_size.resolve(input_size, upscale, &sizes);
        let crop = CropOptions { target_size, ..self.crop_options(input_size) };
        let mut tracker = Tracker::new(self.stage_costs(photos.len(), crop.input_size, options));
        let Posed { photos, guess, mut inputs, reports, adjustment } =
            posed(photos, options, &crop, &mut tracker, progress)?;
        let photos: &[Photo] = &photos;
        let corrected = equal_exposure::equalise(photos, &mut inputs, &reports);
        tracker.close();
        if options.check == Check::Refuse {
            poses::refuse_bad(&reports)?;
        }
        let mut warnings = Warning::of_reports(&reports);
        let cut_shares: Vec<f32> =
            inputs.iter().zip(sizes).map(|(c, size)| cut_share(c, size)).collect();
        warnings.extend(Warning::of_crops(photos, &inputs, &cut_shares, &crop));
        warnings.extend(corrected);
        warnings.extend(Warning::of_masks(photos));
        if self.missing > 0 {
            let upscale = self.config().upscale;
            warnings.push(Warning::UntrainedTensors { count: self.missing, upscale });
        }
        let bounds = guess.refined(options.depth_range, &reports);
        warnings.extend(Warning::of_points(&bounds, &reports));
        let options = options.clone();
        Ok(Prepared {
            model: self,
            options,
            inputs,
            adjustment,
            cut_shares,
            bounds,
            reports,
            warnings,
            tracker,
        })
    }

    /// The network's input of cropped photographs, and its depth range. The network estimates
    /// the range anew where `range` fixes no end.
    ///
    /// # Errors
    /// No photograph, or photographs of several sizes; an error of the network.
    pub fn views(
        &self,
        inputs: &[Cropped],
        bounds: DepthBounds,
        range: DepthRange,
    ) -> Result<(Views, DepthBounds)> {
        let estimate = |views: &Views| Ok(self.model.estimate_depth_range(views)?);
        self.views_with(inputs, bounds, range, estimate)
    }

    /// [`Reconstructor::views`]; `estimate` estimates the range.
    ///
    /// # Errors
    /// Those of [`Reconstructor::views`].
    pub(super) fn views_with(
        &self,
        inputs: &[Cropped],
        bounds: DepthBounds,
        range: DepthRange,
        estimate: impl FnOnce(&Views) -> Result<Views>,
    ) -> Result<(Views, DepthBounds)> {
        let views = views_of(inputs, bounds.near_far())?;
        if range != DepthRange::Auto {
            return Ok((views, bounds));
        }
        let views = estimate(&views)?;
        let estimate = views.near_far[0][0];
        if estimate == bounds.near_far() {
            return Ok((views, bounds));
        }
        let source = DepthSource::Estimated { from: Box::new(bounds.source) };
        Ok((views, DepthBounds::new(estimate.near, estimate.far, source)))
    }

    /// Reports whether the small backbone estimates near and far: MVSplat has no such stage.
    pub(super) fn estimates_depth_range(&self, options: &Options) -> bool {
        options.depth_range == DepthRange::Auto && !is_mvsplat(self.config())
    }

    /// The device of the network and the renderer.
    pub(super) fn backend(&self) -> &Backend {
        &self.backend
    }

    /// A warning where the GPU did not do all of its work.
    pub(super) fn backend_warning(&self) -> Option<Warning> {
        self.backend.warning().map(|reason| Warning::CpuInsteadOfGpu { reason })
    }

    /// Rough durations, seconds on two cores (two photographs, 256² to 512²); the check and the
    /// crop depend on the photographs, the rest on the input's pixels.
    fn stage_costs(
        &self,
        photos: usize,
        Size { width: w, height: h }: Size,
        options: &Options,
    ) -> Vec<StageCost> {
        let n = photos as f32;
        let pixels = n * w as f32 * h as f32 / (2.0 * 256.0 * 256.0);
        let mvsplat = is_mvsplat(self.config());
        let estimates = self.estimates_depth_range(options);
        let parents = photos * w * h;
        let gaussians = options.density.limit(parents, photos, self.config().upscale);
        // A quarter of a parent's mean number of children.
        let children = gaussians as f32 / (4 * parents.max(1)) as f32;
        let aggregates = self.config().agg.enabled;
        let refinement = match options.refine {
            // The number of steps in a second is not known.
            Refine::Seconds(seconds) => 10.0 * seconds as f32,
            _ => options.refine_options(photos).steps as f32,
        };
        let matches = options.matches_depth();
        let refinement_of_parents = match options.parents.unwrap_or(options.refine) {
            Refine::Seconds(seconds) => 2.0 * seconds as f32,
            _ => 2.0 * options.parents_options(photos).steps as f32,
        };
        let costs = [
            (Stage::Poses, if options.poses == Poses::Adjusted { 0.3 * n } else { 0.0 }),
            (Stage::Crop, 0.015 * n),
            (Stage::Check, if options.check == Check::Off { 0.0 } else { 0.15 * (n - 1.0) }),
            (Stage::DepthRange, if estimates { 0.03 * pixels } else { 0.0 }),
            (Stage::Backbone, if mvsplat { 0.8 } else { 0.12 } * pixels),
            (Stage::Primaries, 0.01 * pixels),
            (Stage::Matching, if matches { 0.05 * pixels * n.min(4.0) } else { 0.0 }),
            (Stage::Parents, FIT_STEP * refinement_of_parents / n * pixels / 4.0),
            (Stage::Subsplat, if aggregates { 0.25 } else { 0.06 } * pixels),
            (Stage::Detail, if options.detail == Detail::Off { 0.0 } else { 0.01 * pixels }),
            (Stage::Fit, FIT_STEP * options.fit_options(photos).steps as f32 * pixels * children),
            // A step draws one photograph instead of all.
            (Stage::Refine, FIT_STEP * refinement / n * pixels * children),
        ];
        costs.map(|(stage, cost)| StageCost { stage, cost }).to_vec()
    }
}

/// Number of other photographs with which each photograph is compared.
const SOURCES: usize = 2;

/// Duration of one step of the fit, in the unit of [`Reconstructor::stage_costs`].
const FIT_STEP: f32 = 0.2;

/// Photographs with the cameras that the network receives.
struct Posed<'a> {
    photos: Cow<'a, [Photo]>,
    /// Depth range of the cameras.
    guess: DepthBounds,
    inputs: Vec<Cropped>,
    /// The check of the pairs with these cameras.
    reports: Vec<PairReport>,
    adjustment: Option<PoseAdjustment>,
}

/// Crops and checks `photos`, with cameras that are adjusted where [`Options::poses`] says so.
fn posed<'a>(
    photos: &'a [Photo],
    options: &Options,
    crop: &CropOptions,
    tracker: &mut Tracker,
    progress: &mut Callback<'_>,
) -> Result<Posed<'a>> {
    let (mut photos, mut adjustment) = (Cow::Borrowed(photos), None);
    let mut found = None;
    if options.poses == Poses::Adjusted {
        tracker.begin(Stage::Poses, progress)?;
        found = poses::adjusted(&photos)?;
    }
    let mut doubts = options.poses == Poses::Auto;
    loop {
        if let Some((moved, change)) = found {
            (photos, adjustment) = (Cow::Owned(moved), Some(change));
        }
        let cameras: Vec<Camera> = photos.iter().map(|p| *p.camera()).collect();
        let guess = options.initial_depth_range(&cameras)?;
        let inputs = crop_all(&photos, crop, tracker, progress)?;
        let reports = match options.check {
            Check::Off => Vec::new(),
            Check::Warn | Check::Refuse => {
                tracker.begin(Stage::Check, progress)?;
                check_pairs(&photos, |part| tracker.advance(part, progress))?
            }
        };
        found = None;
        if std::mem::take(&mut doubts) && poses::doubted(&photos, &reports) {
            tracker.begin(Stage::Poses, progress)?;
            found = poses::adjusted_if_doubted(&photos, &reports)?;
        }
        if found.is_none() {
            return Ok(Posed { photos, guess, inputs, reports, adjustment });
        }
    }
}

fn crop_all(
    photos: &[Photo],
    options: &CropOptions,
    tracker: &mut Tracker,
    progress: &mut Callback<'_>,
) -> Result<Vec<Cropped>> {
    tracker.begin(Stage::Crop, progress)?;
    let mut inputs = Vec::with_capacity(photos.len());
    for photo in photos {
        inputs.push(photo.crop(options)?);
        tracker.advance(inputs.len() as f32 / photos.len() as f32, progress)?;
    }
    Ok(inputs)
}

/// Share of a photograph of `size` px that its crop does not show, 0 to 1.
fn cut_share(crop: &Cropped, size: Size) -> f32 {
    let shown = crop.window.scale.x
        * crop.target.width as f32
        * crop.window.scale.y
        * crop.target.height as f32;
    (1.0 - shown / (size.width as f32 * size.height as f32)).clamp(0.0, 1.0)
}

/// Cropped photographs of one scene as the network's input.
fn views_of(inputs: &[Cropped], near_far: NearFar) -> Result<Views> {
    let (w, h) = inputs.first().map_or((0, 0), |c| (c.input.width, c.input.height));
    let pixels: Vec<f32> = inputs.iter().flat_map(|c| c.input.to_planes()).collect();
    let images = Tensor::from_vec(pixels, (1, inputs.len(), 3, h, w), &Device::Cpu)?;
    let cameras: Vec<Camera> = inputs.iter().map(|c| c.input_camera).collect();
    let sources = choose_sources(&cameras, near_far, SOURCES);
    let views = Views::new(images, vec![cameras], vec![vec![near_far; inputs.len()]])?;
    Ok(views.with_sources(vec![sources])?)
}
