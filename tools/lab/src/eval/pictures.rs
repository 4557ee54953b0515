//! The pictures of a case by every method: one set of Gaussians after the other.

use super::Method;
use super::evaluator::{Crops, Options};
use super::methods::{enlarged, mean, nearest};
use glam::Vec2;
use std::ops::ControlFlow;
use subsplat::files::photos::resize::{Filter, resize};
use subsplat::finish::{FitOptions, PhaseRun};
use subsplat::network::config::LowpassRef;
use subsplat::network::model::scene_encoding::SceneEncoding;
use subsplat::network::model::subsplat::{SubSplat, feature_channels};
use subsplat::network::model::trunk::Trunk;
use subsplat::network::model::weights::Weights;
use subsplat::reconstruct::inputs::crop::{Cropped, PhotoWindow};
use subsplat::reconstruct::stages::{
    ParentsOptions, SceneChildren, add_surroundings, counts_of, fit_to_inputs, hide_repeated,
    match_parents, options_of_parents, refine_on_inputs, refine_parents,
};
use subsplat::reconstruct::{
    Density, DepthBounds, DepthRange, Error, Reconstructor, Refine, Result,
};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render::{Renderer, render_with};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Size};
use subsplat_kernels::clock::Instant;
use subsplat_kernels::cpu::Rasterizer;
use subsplat_kernels::layout::RasterOptions;

/// Makes the pictures of one case. One set of Gaussians is in memory at a time.
pub(super) struct PictureMaker<'a> {
    /// Target side over input side.
    upscale: f32,
    /// Depth range of the network's candidates.
    bounds: DepthBounds,
    /// Mean colour of the inputs.
    colour: [f32; 3],
    network: Option<Network<'a>>,
    density: Density,
    refine: Refine,
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
    views: subsplat::network::model::Views,
    output: subsplat::network::model::BackboneOutput,
    parents: subsplat::network::model::Primaries,
}

/// A set of Gaussians that methods share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Set {
    Children,
    Detailed,
    Fitted,
    /// Refined children of parents that were prepared before.
    Refined(Parents),
    /// [`Set::Refined`] of matched parents, without the surroundings.
    Bare,
    /// The Gaussians of `run` for pictures of a smaller size.
    Smaller(Smaller),
    /// The Gaussians of `run` for two of the inputs.
    Pair([usize; 2]),
    Opaque,
    Random,
    Parents,
    Uniform,
}

/// Sets of which each is made of the one before it.
const IN_ORDER: [Set; 3] = [Set::Children, Set::Detailed, Set::Fitted];

/// Preparation of parents before they are divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Parents {
    /// Depth is matched, and they are refined on the photographs of the input's size.
    Matched,
    /// They are refined on the photographs of the input's size.
    Refined,
    /// Nothing.
    Predicted,
}

/// Size of the pictures of a baseline that are then enlarged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Smaller {
    /// That of the network's input.
    Input,
    /// Half of the target's sides.
    Half,
}

impl Smaller {
    /// Of the methods that have one.
    fn of(method: &Method) -> Option<Self> {
        match method {
            Method::Enlarged => Some(Self::Input),
            Method::Half => Some(Self::Half),
            _ => None,
        }
    }

    /// Side over the input's, at targets of `upscale` times its side.
    fn ratio(self, upscale: f32) -> f32 {
        match self {
            Self::Input => 1.0,
            Self::Half => (upscale / 2.0).max(1.0),
        }
    }
}

/// `c` with a target of `ratio` times the input's sides.
fn reduced(c: &Cropped, ratio: f32) -> Result<Cropped> {
    let (target, target_camera, target_mask) = if ratio == 1.0 {
        (c.input.clone(), c.input_camera, c.input_mask.clone())
    } else {
        let side = |side: usize| (side as f32 * ratio).round() as usize;
        let size = Size::new(side(c.input.width), side(c.input.height));
        let (target, target_camera) = c.resized(size)?;
        (target, target_camera, c.resized_mask(size))
    };
    let size = |p: &Rgb| Vec2::new(p.width as f32, p.height as f32);
    let scale = c.window.scale * (size(&c.target) / size(&target));
    let window = PhotoWindow { scale, ..c.window };
    Ok(Cropped { target, target_camera, target_mask, window, ..c.clone() })
}

impl Set {
    /// The set of `method` for a picture seen by `camera`.
    fn of(method: &Method, inputs: &[Cropped], camera: &Camera) -> Option<Self> {
        match method {
            Method::Subsplat => Some(Self::Children),
            Method::Detail => Some(Self::Detailed),
            Method::Fit => Some(Self::Fitted),
            Method::Refine => Some(Self::Refined(Parents::Matched)),
            Method::Bare => Some(Self::Bare),
            Method::Unmatched => Some(Self::Refined(Parents::Refined)),
            Method::Direct => Some(Self::Refined(Parents::Predicted)),
            Method::Enlarged | Method::Half => Smaller::of(method).map(Self::Smaller),
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
    /// Runs the network where a method needs it.
    ///
    /// # Errors
    /// No model for a method that needs one; an error of the network.
    pub(super) fn new(
        options: &Options,
        model: Option<&'a Reconstructor>,
        crops: &Crops,
    ) -> Result<Self> {
        let begin = Instant::now();
        let needed = options.methods.iter().find(|m| m.needs_model());
        let mut bounds = crops.bounds.clone();
        let network = match (needed, model) {
            (None, _) => None,
            (Some(method), None) => return Err(Error::argument(method.name(), "a model", "none")),
            (Some(_), Some(model)) => {
                let (network, found) =
                    Network::new(model, &crops.inputs, bounds, crops.depth_range)?;
                bounds = found;
                Some(network)
            }
        };
        Ok(Self {
            upscale: options.upscale,
            bounds,
            colour: Cropped::mean_colour(&crops.inputs),
            network,
            density: options.density,
            refine: options.refine,
            current: None,
            splats: None,
            rasterizer: Rasterizer::new(),
            coverage: 0.0,
            network_seconds: begin.elapsed().as_secs_f64(),
            set_seconds: 0.0,
        })
    }

    /// Depth range of the network's candidates.
    pub(super) fn bounds(&self) -> &DepthBounds {
        &self.bounds
    }

    /// The current Gaussians.
    pub(super) fn splats(&self) -> Option<&Splats> {
        self.splats.as_ref().map(|c| &c.splats)
    }

    /// Mean alpha of the last rendered picture.
    pub(super) fn coverage(&self) -> f64 {
        self.coverage
    }

    /// Seconds from the inputs to the current Gaussians.
    pub(super) fn seconds(&self) -> f64 {
        self.network_seconds + self.set_seconds
    }

    /// Makes the Gaussians of `method` for a picture seen by `camera`, unless they are in memory.
    pub(super) fn select(&mut self, method: &Method, crops: &Crops, camera: &Camera) -> Result<()> {
        let set = Set::of(method, &crops.inputs, camera);
        let (Some(set), Some(network)) = (set, &self.network) else { return Ok(()) };
        if self.current == Some(set) {
            return Ok(());
        }
        let begin = Instant::now();
        let place = |set: Set| IN_ORDER.iter().position(|s| *s == set);
        let mut before = 0.0;
        let (from, to) = (self.current.and_then(place), place(set));
        let splats = match (from, to, self.splats.take()) {
            (Some(from), Some(to), Some(splats)) if from < to => {
                before = self.set_seconds;
                let at = (network.model.model(), crops.inputs.as_slice(), self.upscale);
                self.refined(network, splats, at, &IN_ORDER[from + 1..=to])?
            }
            (_, Some(to), _) => {
                let raster = self.raster_options(network, 1.0, None);
                let encoding = network.encoding();
                let model = network.model.model();
                let inputs = &crops.inputs;
                let children = network.children(model, &encoding, inputs, self.density, &raster)?;
                let at = (model, inputs.as_slice(), self.upscale);
                self.refined(network, children, at, &IN_ORDER[1..=to])?
            }
            (_, None, _) => match set {
                Set::Refined(parents) => {
                    let at = (network.model.model(), crops.inputs.as_slice(), self.upscale);
                    let mut children = self.finished(network, at, parents)?;
                    self.surround(network, &crops.inputs, &mut children);
                    children
                }
                Set::Bare => {
                    let at = (network.model.model(), crops.inputs.as_slice(), self.upscale);
                    self.finished(network, at, Parents::Matched)?
                }
                Set::Smaller(smaller) => self.smaller(network, crops, smaller)?,
                Set::Pair(pair) => self.of_pair(network.model, crops, pair)?,
                set => SceneChildren::of_splats(self.baseline(network, crops, set)?),
            },
        };
        self.set_seconds = before + begin.elapsed().as_secs_f64();
        (self.current, self.splats) = (Some(set), Some(splats));
        Ok(())
    }

    /// Takes the `children` of a model and of `inputs`, whose targets have `ratio` times their side,
    /// through the steps `sets` of [`IN_ORDER`].
    fn refined(
        &self,
        network: &Network<'_>,
        mut children: SceneChildren,
        (model, inputs, ratio): (&SubSplat, &[Cropped], f32),
        sets: &[Set],
    ) -> Result<SceneChildren> {
        let upscale = model.config().upscale;
        let raster = self.raster_options(network, ratio, None);
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
                _ => {}
            }
        }
        Ok(children)
    }

    /// The Gaussians of a baseline.
    fn baseline(&self, network: &Network<'_>, crops: &Crops, set: Set) -> Result<Splats> {
        match set {
            Set::Opaque | Set::Random => self.reduced(network, crops, set),
            _ => network.splats(set, self.upscale.ceil() as usize),
        }
    }

    /// The Gaussians that `run` makes for pictures of a smaller size. Heads for one number of children do
    /// not serve that size: the parents then have no children.
    fn smaller(
        &self,
        network: &Network<'_>,
        crops: &Crops,
        smaller: Smaller,
    ) -> Result<SceneChildren> {
        let ratio = smaller.ratio(self.upscale);
        let mut children = if network.model.config().spgr.head.serves_any_k() {
            let model = network.model.model().clone().with_upscale(ratio.ceil() as usize)?;
            let inputs = crops.inputs.iter().map(|c| reduced(c, ratio));
            let inputs = inputs.collect::<Result<Vec<_>>>()?;
            self.finished(network, (&model, &inputs, ratio), Parents::Matched)?
        } else {
            SceneChildren::of_splats(self.refined_parents(network, crops)?)
        };
        self.surround(network, &crops.inputs, &mut children);
        Ok(children)
    }

    /// The Gaussians that `run` makes of two of the inputs.
    fn of_pair(
        &self,
        model: &Reconstructor,
        crops: &Crops,
        pair: [usize; 2],
    ) -> Result<SceneChildren> {
        let inputs = pair.map(|i| crops.inputs[i].clone());
        let bounds = crops.bounds.clone();
        let (network, _) = Network::new(model, &inputs, bounds, crops.depth_range)?;
        let at = (model.model(), inputs.as_slice(), self.upscale);
        let mut children = self.finished(&network, at, Parents::Matched)?;
        self.surround(&network, &inputs, &mut children);
        Ok(children)
    }

    /// Adds the Gaussians beyond the edges of `inputs`, as `run` does.
    fn surround(&self, network: &Network<'_>, inputs: &[Cropped], children: &mut SceneChildren) {
        if self.density.has_room() {
            let raster = self.raster_options(network, 1.0, None);
            let renderer = &mut Renderer::default();
            add_surroundings(&mut children.splats, inputs, &raster, renderer);
        }
    }

    /// The network's Gaussians, one a pixel, matched, and refined on the photographs of the input's size.
    fn refined_parents(&self, network: &Network<'_>, crops: &Crops) -> Result<Splats> {
        let inputs = &crops.inputs;
        let small = self.raster_options(network, 1.0, None);
        let mut parents = network.encoding().parents(network.model.model())?;
        let mut part = |_: f32| ControlFlow::Continue(());
        let mut go_on = |_: Option<&PhaseRun<'_>>| ControlFlow::Continue(());
        match_parents(&mut parents, inputs, self.bounds.near_far(), &mut part)?;
        let refine = self.refine.options_for(inputs.len(), true);
        let options = ParentsOptions { refine, most: usize::MAX };
        let renderer = &mut Renderer::default();
        refine_parents(&mut parents, inputs, &small, &options, renderer, &mut go_on)?;
        Ok(parents)
    }

    /// The Gaussians that `run` makes, without those beyond the edges, of `parents`, by a model and for `inputs`, whose
    /// targets have `ratio` times their side.
    fn finished(
        &self,
        network: &Network<'_>,
        (model, inputs, ratio): (&SubSplat, &[Cropped], f32),
        parents: Parents,
    ) -> Result<SceneChildren> {
        let mut renderer = Renderer::default();
        let small = self.raster_options(network, 1.0, None);
        let mut encoding = network.encoding();
        let mut own = encoding.parents(model)?;
        let mut part = |_: f32| ControlFlow::Continue(());
        let mut go_on = |_: Option<&PhaseRun<'_>>| ControlFlow::Continue(());
        if parents == Parents::Matched {
            let near_far = self.bounds.near_far();
            match_parents(&mut own, inputs, near_far, &mut part)?;
        }
        let options = self.refine.options_for(inputs.len(), true);
        let (count, upscale) = (encoding.per_view() * inputs.len(), model.config().upscale);
        let most = self.density.limit(count, inputs.len(), upscale);
        hide_repeated(&mut own, inputs, most, upscale);
        let options =
            options_of_parents(&options, inputs, most).filter(|_| parents != Parents::Predicted);
        if let Some(options) = options {
            refine_parents(&mut own, inputs, &small, &options, &mut renderer, &mut go_on)?;
        }
        encoding = encoding.with_parents(model, &own)?;
        let mut children = network.children(model, &encoding, inputs, self.density, &small)?;
        children.add_offsets(own.gain(), own.len());
        let at = (model, inputs, ratio);
        let options = self.refine.options_for(inputs.len(), true);
        let steps = if options.needs_fit(inputs.len()) { &IN_ORDER[1..] } else { &IN_ORDER[1..2] };
        let mut children = self.refined(network, children, at, steps)?;
        let SceneChildren { splats, groups, .. } = &mut children;
        let raster = self.raster_options(network, ratio, None);
        let mut step = |_: &PhaseRun<'_>| ControlFlow::Continue(());
        let renderer = &mut renderer;
        refine_on_inputs(splats, groups, inputs, &raster, &options, renderer, &mut step)?;
        Ok(children)
    }

    /// The Gaussians of [`Set::Detailed`] at full density, as many as the density allows: those of
    /// the highest opacities ([`Set::Opaque`]), or random ones.
    fn reduced(&self, network: &Network<'_>, crops: &Crops, set: Set) -> Result<Splats> {
        let raster = self.raster_options(network, 1.0, None);
        let encoding = network.encoding();
        let model = network.model.model();
        let mut children =
            network.children(model, &encoding, &crops.inputs, Density::Full, &raster)?;
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

    /// The picture of `method` at a target, of the current Gaussians: RGB, display values.
    pub(super) fn picture(&mut self, method: &Method, crops: &Crops, target: &Cropped) -> Vec<f32> {
        let r = self.upscale;
        let camera = &target.target_camera;
        let size = (target.target.width, target.target.height);
        match method {
            Method::Copy => nearest(&crops.inputs, camera, size),
            Method::Mean => mean(&crops.inputs, size),
            Method::Lowpass => self.render(camera, r, Some(LowpassRef::Input)),
            Method::Backbone => self.render(camera, r, Some(LowpassRef::Target)),
            Method::Enlarged | Method::Half => {
                let ratio = Smaller::of(method).map_or(1.0, |smaller| smaller.ratio(r));
                let Ok(Cropped { target: small, target_camera, .. }) = reduced(target, ratio)
                else {
                    return Vec::new();
                };
                let picture = self.render(&target_camera, ratio, None);
                let (w, h) = (small.width, small.height);
                let Some(small) = Rgb::from_unit(&picture, w, h) else { return Vec::new() };
                resize(&small, size.0, size.1, Filter::Lanczos).to_unit()
            }
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

impl<'a> Network<'a> {
    /// Runs the backbone on `inputs`. Returns also the depth range of its candidates.
    fn new(
        model: &'a Reconstructor,
        inputs: &[Cropped],
        bounds: DepthBounds,
        range: DepthRange,
    ) -> Result<(Self, DepthBounds)> {
        let (views, bounds) = model.views(inputs, bounds, range)?;
        let output = model.model().encode(&views)?;
        let parents = model.model().primaries(&views, &output)?;
        Ok((Self { model, views, output, parents }, bounds))
    }

    /// The backbone's outputs and the primaries.
    fn encoding(&self) -> SceneEncoding {
        SceneEncoding::new(self.views.clone(), self.output.clone(), self.parents.clone())
    }

    /// The Gaussians of `network` of the primaries in `encoding`, without detail. `raster` renders pictures of
    /// the input's size.
    fn children(
        &self,
        network: &SubSplat,
        encoding: &SceneEncoding,
        inputs: &[Cropped],
        density: Density,
        raster: &RasterOptions,
    ) -> Result<SceneChildren> {
        let mut renderer = Renderer::default();
        let counts = counts_of(network, encoding, None, inputs, density, raster, &mut renderer)?;
        Ok(SceneChildren::new(network, encoding, inputs.len(), counts, &|| Ok(()))?)
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
}

/// The two inputs whose cameras are nearest to `camera`, in ascending order.
fn nearest_two(inputs: &[Cropped], camera: &Camera) -> Option<[usize; 2]> {
    let distance = |i: usize| inputs[i].input_camera.position().distance(camera.position());
    let mut order: Vec<usize> = (0..inputs.len()).collect();
    order.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    let [a, b] = order.get(..2)?.try_into().ok()?;
    Some([a.min(b), a.max(b)])
}
