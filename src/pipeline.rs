//! Photographs to a scene in one call: what an application uses.
//!
//! ```no_run
//! use subsplat::pipeline::{Photo, Reconstructor, Request};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let scene = subsplat::io::scene::load_scene("scene".as_ref())?;
//! let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
//! let model = Reconstructor::load("weights.safetensors".as_ref(), None)?;
//! let result = model.reconstruct(&photos, &Request::default())?;
//! subsplat::io::save_splats("scene.ply".as_ref(), &result.splats, &Default::default())?;
//! # Ok(())
//! # }
//! ```

use crate::abi::RasterOptions;
use crate::camera::Camera;
use crate::check::{CheckOptions, GrayImage, PairReport, Verdict, check_pair};
use crate::config::{Backbone, Config, ConfigError, Preset};
use crate::cpu::detail::{Photograph, SourceView, residuals, with_residuals};
use crate::data::crop::{CropOptions, Cropped, crop};
use crate::data::depth::DepthRange;
use crate::io;
use crate::io::image::{Depth, Rgb};
use crate::io::scene::Frame;
pub use crate::model::Backend;
use crate::model::Views;
use crate::model::subsplat::{SceneOutput, SubSplat};
use crate::model::weights::{SUBSPLAT_PREFIX, Weights};
use crate::splats::Splats;
use candle_core::{Device, Tensor};
use std::path::Path;
use std::time::Instant;
use thiserror::Error;

/// Why a reconstruction could not be made.
#[derive(Debug, Error)]
pub enum Error {
    /// A file or a picture.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The network: shapes, weights, numbers.
    #[error(transparent)]
    Model(#[from] candle_core::Error),
    /// A configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// What the caller asked for.
    #[error("{what}: expected {expected}, got {got}")]
    Request {
        /// Which part of it.
        what: &'static str,
        /// What would be accepted.
        expected: String,
        /// What came.
        got: String,
    },
}

/// Result of everything in this room.
pub type Result<T> = std::result::Result<T, Error>;

/// A photograph without lens distortion, and its camera.
#[derive(Clone, Debug)]
pub struct Photo {
    /// The pixels.
    pub image: Rgb,
    /// Pinhole camera of these pixels.
    pub camera: Camera,
}

impl Photo {
    /// Decodes a frame's picture and removes its lens distortion.
    ///
    /// # Errors
    /// Everything of [`Frame::load`].
    pub fn from_frame(frame: &Frame) -> Result<Self> {
        let (image, camera) = frame.load()?;
        Ok(Self { image, camera })
    }

    /// The parts that the network and the scores need.
    ///
    /// # Errors
    /// Everything of [`crop`].
    pub fn crop(&self, options: &CropOptions) -> Result<Cropped> {
        Ok(crop(&self.image, &self.camera, options)?)
    }
}

/// What a reconstruction is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Request {
    /// Width and height of the network's input, px; cut to the model's stride.
    pub input_size: (usize, usize),
    /// Nearest and farthest depth candidate, world units.
    pub near_far: (f32, f32),
    /// Add to each child what the photograph shows at its place beyond its parent's
    /// pixel ([`crate::cpu::detail`]).
    pub detail: bool,
    /// `near_far` is a guess, which the small backbone replaces by what it sees
    /// ([`SubSplat::look`]).
    pub look: bool,
}

impl Default for Request {
    /// 256×256, no detail; depth 1 to 100, RealEstate10K's habit, as a guess.
    fn default() -> Self {
        Self { input_size: (256, 256), near_far: (1.0, 100.0), detail: false, look: true }
    }
}

/// A reconstructed scene.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// The Gaussians.
    pub splats: Splats,
    /// The photographs as the network saw them, and at target resolution.
    pub inputs: Vec<Cropped>,
    /// Predicted depth of each input, camera z, world units.
    pub depths: Vec<Depth>,
    /// Nearest and farthest depth candidate, world units.
    pub near_far: (f32, f32),
    /// Harmless oddities, one line each, for the user.
    pub warnings: Vec<String>,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
}

/// A model that is ready to reconstruct.
pub struct Reconstructor {
    model: SubSplat,
    weights: Weights,
}

impl Reconstructor {
    /// A model with seeded, untrained weights. The small backbone is then a plain
    /// plane sweep and gives a usable scene; MVSplat's gives noise.
    ///
    /// # Errors
    /// A configuration out of range.
    pub fn untrained(config: &Config, seed: u64) -> Result<Self> {
        Self::build(config, Weights::seeded(seed))
    }

    /// The model that ships, [`Weights::shipped`], at ×`upscale`. SubSplat's heads are
    /// trained at ×2 and ×4; at another r children are the plain split of their parents, and
    /// [`Reconstructor::untrained_tensors`] lists the heads.
    ///
    /// # Errors
    /// An `upscale` out of range.
    pub fn shipped(upscale: usize) -> Result<Self> {
        Self::from_weights(Weights::shipped(upscale)?, None)
    }

    /// A model from a weight file. Its own configuration is used unless `config` is
    /// given; a file without one must fit `config`, which is then by default MVSplat
    /// with the `tuned` preset and ×2. SubSplat's tensors may be missing (a converted
    /// MVSplat checkpoint): they start untrained, and
    /// [`Reconstructor::untrained_tensors`] lists them.
    ///
    /// # Errors
    /// A file that is no weight file; a tensor that is missing or has another shape,
    /// named with both shapes; a configuration out of range.
    pub fn load(path: &Path, config: Option<&Config>) -> Result<Self> {
        Self::from_weights(Weights::load(path)?, config)
    }

    /// [`Reconstructor::load`] from weights that were read already.
    ///
    /// # Errors
    /// As [`Reconstructor::load`].
    pub fn from_weights(weights: Weights, config: Option<&Config>) -> Result<Self> {
        let weights = weights.allow_missing(SUBSPLAT_PREFIX, 0);
        let config = match (config, weights.config()) {
            (Some(config), _) | (None, Some(config)) => config.clone(),
            (None, None) => Config::re10k(Preset::Tuned, 2),
        };
        Self::build(&config, weights)
    }

    /// The same with the kernels that have a twin there on `backend`
    /// ([`SubSplat::with_backend`]); [`Backend::warning`] says afterwards whether the CPU had
    /// to take over.
    pub fn with_backend(self, backend: &Backend) -> Self {
        Self { model: self.model.with_backend(backend), ..self }
    }

    fn build(config: &Config, weights: Weights) -> Result<Self> {
        let model = SubSplat::new(config, weights.builder())?;
        Ok(Self { model, weights })
    }

    /// The model's configuration.
    pub fn config(&self) -> &Config {
        self.model.config()
    }

    /// The model itself.
    pub fn model(&self) -> &SubSplat {
        &self.model
    }

    /// Names of the tensors that no file gave.
    pub fn untrained_tensors(&self) -> Vec<String> {
        self.weights.initialised()
    }

    /// Names in the weight file that the model did not ask for.
    pub fn unexpected_tensors(&self) -> Vec<String> {
        self.weights.unexpected()
    }

    /// How this model crops a photograph for inputs of `input_size`.
    pub fn crop_options(&self, input_size: (usize, usize)) -> CropOptions {
        let config = self.config();
        CropOptions { input_size, ..CropOptions::square(0, config.upscale, config.stride()) }
    }

    /// How this model's Gaussians of `inputs` are rendered at target resolution.
    pub fn raster_options(&self, near: f32, inputs: &[Cropped]) -> RasterOptions {
        raster_options(self.config(), near, inputs)
    }

    /// Photographs to Gaussians.
    ///
    /// # Errors
    /// Fewer than two photographs, a bad request, whatever the network finds wrong.
    pub fn reconstruct(&self, photos: &[Photo], request: &Request) -> Result<Reconstruction> {
        self.reconstruct_with(photos, request, &mut |_| {})
    }

    /// [`Reconstructor::reconstruct`], telling `stage` the name of each stage as it
    /// begins.
    ///
    /// # Errors
    /// As [`Reconstructor::reconstruct`].
    pub fn reconstruct_with(
        &self,
        photos: &[Photo],
        request: &Request,
        stage: &mut dyn FnMut(&'static str),
    ) -> Result<Reconstruction> {
        if photos.len() < 2 {
            let (expected, got) = ("at least 2".to_owned(), photos.len().to_string());
            return Err(Error::Request { what: "photographs", expected, got });
        }
        let mut clock = Clock::new(stage);
        clock.begin("crop");
        let options = self.crop_options(request.input_size);
        let inputs = photos.iter().map(|p| p.crop(&options)).collect::<Result<Vec<_>>>()?;
        let mut views = views_of(&inputs, request.near_far)?;
        if request.look {
            clock.begin("depth range");
            views = self.model.estimate_depth_range(&views)?;
        }
        let near_far = views.near_far[0][0];
        let mut scenes = self.model.forward(&views, &mut |name| clock.begin(name))?;
        let Some(SceneOutput { children, depths }) = scenes.pop() else {
            let (expected, got) = ("one scene".to_owned(), "none".to_owned());
            return Err(Error::Request { what: "reconstruction", expected, got });
        };
        let mut splats = children.to_splats()?;
        drop(children);
        let mut warnings: Vec<String> = inputs.iter().flat_map(|c| c.warnings.clone()).collect();
        warnings.sort();
        warnings.dedup();
        if request.detail {
            clock.begin("detail");
            add_detail(&mut splats, &inputs, self.config().upscale)?;
        }
        let depths =
            inputs.iter().zip(depths).map(|(c, d)| camera_depth(&c.input_camera, d)).collect();
        let seconds = clock.end();
        Ok(Reconstruction { splats, inputs, depths, near_far, warnings, seconds })
    }
}

/// Whether a photograph shows more than the network's input does: more than one of its
/// pixels for each of the input's.
pub fn has_detail(c: &Cropped) -> bool {
    let ratio = c.target.width as f32 / c.input.width.max(1) as f32;
    (c.window.scale * ratio).min_element() > 1.0
}

/// Adds to the children of cropped photographs what the photographs show beyond their
/// parents' pixels ([`crate::cpu::detail`]), if one has anything to show; `upscale` is the
/// children's, K = upscale².
///
/// # Errors
/// A photograph without pixels.
pub fn add_detail(splats: &mut Splats, inputs: &[Cropped], upscale: usize) -> Result<()> {
    if !inputs.iter().any(has_detail) {
        return Ok(());
    }
    let pixels: Vec<Vec<f32>> = inputs.iter().map(|c| c.target.to_unit()).collect();
    let mut sources = Vec::with_capacity(inputs.len());
    for (c, pixels) in inputs.iter().zip(&pixels) {
        let (w, h) = (c.target.width, c.target.height);
        let photograph = match has_detail(c) {
            true => Some(Photograph::new(pixels, w, h).ok_or_else(|| Error::Request {
                what: "photograph",
                expected: format!("{w}x{h} pixels"),
                got: pixels.len().to_string(),
            })?),
            false => None,
        };
        sources.push(SourceView { photograph, camera: c.input_camera });
    }
    let means: Vec<f32> = (0..splats.len()).flat_map(|i| splats.mean(i)).collect();
    let per_view = splats.parents() / inputs.len().max(1);
    let children = splats.children_per_parent();
    let delta = residuals(&sources, &means, per_view, children, upscale);
    splats.gain = with_residuals(&splats.gain, &delta);
    Ok(())
}

/// How Gaussians of a model with `config`, made from `inputs`, are rendered at target
/// resolution; `near` is the near plane that the reconstruction was made with.
pub fn raster_options(config: &Config, near: f32, inputs: &[Cropped]) -> RasterOptions {
    let colour = Rgb::mean_colour(inputs.iter().map(|c| &c.input));
    config.raster_options(config.upscale as f32, near, colour)
}

/// The preset configuration for a backbone by name.
pub fn preset(mvsplat: bool, preset: Preset, upscale: usize) -> Config {
    if mvsplat { Config::re10k(preset, upscale) } else { Config::small(preset, upscale) }
}

/// Whether a configuration's backbone is MVSplat.
pub fn is_mvsplat(config: &Config) -> bool {
    matches!(config.backbone, Backbone::Mvsplat(_))
}

/// Cropped photographs as the network takes them, one scene.
///
/// # Errors
/// No photograph, or photographs of several sizes; a bad depth range.
pub fn views_of(inputs: &[Cropped], near_far: (f32, f32)) -> Result<Views> {
    let (w, h) = inputs.first().map_or((0, 0), |c| (c.input.width, c.input.height));
    let pixels: Vec<f32> = inputs.iter().flat_map(|c| c.input.to_planes()).collect();
    let images = Tensor::from_vec(pixels, (1, inputs.len(), 3, h, w), &Device::Cpu)?;
    let cameras = inputs.iter().map(|c| c.input_camera).collect();
    Ok(Views::new(images, vec![cameras], vec![vec![near_far; inputs.len()]])?)
}

/// What matched points say about each photograph and the next ([`crate::check`]).
///
/// # Errors
/// A photograph without pixels.
pub fn check_photos(photos: &[Photo]) -> Result<Vec<PairReport>> {
    let grey = |photo: &Photo| {
        let Rgb { width, height, data } = &photo.image;
        GrayImage::from_rgb8(*width, *height, data).ok_or_else(|| Error::Request {
            what: "photograph",
            expected: format!("{width}x{height} pixels"),
            got: data.len().to_string(),
        })
    };
    let pair = |w: &[Photo]| {
        let [a, b] = [grey(&w[0])?, grey(&w[1])?];
        Ok(check_pair(&a, &w[0].camera, &b, &w[1].camera, &CheckOptions::default()))
    };
    photos.windows(2).map(pair).collect()
}

/// `range` with what was only guessed, and not `given`, replaced by what the matched
/// points of `reports` say.
pub fn refine_range(
    range: DepthRange,
    given: (Option<f32>, Option<f32>),
    reports: &[PairReport],
) -> DepthRange {
    let usable = reports.iter().filter(|r| r.verdict != Verdict::Bad);
    let depths: Vec<_> = usable.filter_map(|r| r.depth).collect();
    if !range.guessed || depths.is_empty() {
        return range;
    }
    let near = given.0.unwrap_or(depths.iter().map(|d| d.near).fold(f32::INFINITY, f32::min));
    let far = given.1.unwrap_or(depths.iter().map(|d| d.far).fold(0.0, f32::max));
    if !(near > 0.0 && far > near && far.is_finite()) {
        return range;
    }
    let points: usize = reports.iter().map(|r| r.consistent_matches).sum();
    let reason = match given {
        (None, None) => format!("from {points} matched points"),
        (Some(_), _) => format!("near as given, far from {points} matched points"),
        _ => format!("far as given, near from {points} matched points"),
    };
    DepthRange { near, far, reason, guessed: false }
}

/// Distance along the unit ray to camera z.
fn camera_depth(camera: &Camera, distance: Vec<f32>) -> Depth {
    let k = camera.intrinsics;
    let mut data = distance;
    for (i, d) in data.iter_mut().enumerate() {
        let at = glam::Vec2::new((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5);
        *d /= k.unproject(at).length();
    }
    Depth { width: k.width, height: k.height, data }
}

/// Books the time between announcements.
struct Clock<'a> {
    stage: &'a mut dyn FnMut(&'static str),
    current: Option<(&'static str, Instant)>,
    seconds: Vec<(&'static str, f64)>,
}

impl<'a> Clock<'a> {
    fn new(stage: &'a mut dyn FnMut(&'static str)) -> Self {
        Self { stage, current: None, seconds: Vec::new() }
    }

    fn close(&mut self) {
        if let Some((name, start)) = self.current.take() {
            self.seconds.push((name, start.elapsed().as_secs_f64()));
        }
    }

    fn begin(&mut self, name: &'static str) {
        self.close();
        (self.stage)(name);
        self.current = Some((name, Instant::now()));
    }

    fn end(mut self) -> Vec<(&'static str, f64)> {
        self.close();
        self.seconds
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::DepthReport;

    fn depth(near: f32, far: f32) -> PairReport {
        let depth = DepthReport {
            quantiles: [0.0; 5],
            near,
            far,
            baseline_over_depth: 0.1,
            parallax_px: 9.0,
        };
        PairReport { depth: Some(depth), ..PairReport::default() }
    }

    #[test]
    fn only_a_guess_gives_way_to_matched_points() {
        let guess = DepthRange { near: 0.01, far: 0.5, reason: "baseline".into(), guessed: true };
        let known = DepthRange { guessed: false, ..guess.clone() };
        let reports = [depth(0.6, 9.0), depth(0.7, 12.0)];
        let ends = |r: DepthRange| (r.near, r.far);
        assert_eq!(ends(refine_range(guess.clone(), (None, None), &reports)), (0.6, 12.0));
        assert_eq!(ends(refine_range(guess.clone(), (Some(1.0), None), &reports)), (1.0, 12.0));
        assert_eq!(ends(refine_range(guess.clone(), (None, Some(20.0)), &reports)), (0.6, 20.0));
        assert_eq!(refine_range(known.clone(), (None, None), &reports), known);
        assert_eq!(refine_range(guess.clone(), (None, None), &[]), guess);
        let bad = PairReport { verdict: Verdict::Bad, ..depth(0.6, 9.0) };
        assert_eq!(refine_range(guess.clone(), (None, None), &[bad]), guess);
    }
}
