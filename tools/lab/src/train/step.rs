//! Computes the gradients of one step: network, losses and the backward pass.

mod pictures;

use super::config::{Phase, TrainConfig};
use super::loss::{self, with_gradient};
use super::optimizer::{Gradients, Optimizer};
use super::source::Example;
use super::{Error, Result};
use crate::lpips::Lpips;
use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use subsplat::network::config::{Backbone, Config};
use subsplat::network::model::backbone::small::{DepthMaps, DisparityMean};
use subsplat::network::model::primaries::packed;
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::taped::Taped;
use subsplat::network::model::trunk::{Children, TrainPass};
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{BackboneOutput, Views};
use subsplat::network::ops::Backend;
use subsplat::network::ops::Executor;
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::clock::Instant;
use subsplat_kernels::layout::RasterOptions;

/// Parents per chunk of the trunk's backward pass. A `[2048, 128]` activation takes 1 MiB, a part
/// of a core's L2 or L3 cache.
const CHUNK: usize = 2048;

/// Loss terms, means over the examples of a step; NaN for terms that a step does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Terms {
    /// Total loss.
    pub loss: f64,
    /// Mean squared difference of the pictures.
    pub mse: f64,
    /// (1 − SSIM)/2 of the pictures.
    pub dssim: f64,
    /// LPIPS of the pictures.
    pub lpips: f64,
    /// Cross-entropy of the depth candidates.
    pub cross_entropy: f64,
    /// Smooth L1 of disparity, candidates.
    pub disparity: f64,
    /// Cross-entropy of confidence.
    pub confidence: f64,
}

impl Terms {
    /// Returns −10·log₁₀ of the mean squared difference, dB.
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mse.log10()
    }

    /// Number of the terms.
    pub(super) const COUNT: usize = 7;

    /// Returns the terms in the order of the fields.
    pub(super) fn to_array(self) -> [f64; Self::COUNT] {
        let Self { loss, mse, dssim, lpips, cross_entropy, disparity, confidence } = self;
        [loss, mse, dssim, lpips, cross_entropy, disparity, confidence]
    }

    /// Inverse of [`Terms::to_array`].
    pub(super) fn from_array(values: [f64; Self::COUNT]) -> Self {
        let [loss, mse, dssim, lpips, cross_entropy, disparity, confidence] = values;
        Self { loss, mse, dssim, lpips, cross_entropy, disparity, confidence }
    }

    /// Adds `share` times the terms of `other`.
    pub fn add(&mut self, other: &Self, share: f64) {
        self.loss += share * other.loss;
        self.mse += share * other.mse;
        self.dssim += share * other.dssim;
        self.lpips += share * other.lpips;
        self.cross_entropy += share * other.cross_entropy;
        self.disparity += share * other.disparity;
        self.confidence += share * other.confidence;
    }
}

/// Seconds of each part of a step. The seconds of parallel groups are added.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seconds {
    /// Waiting for examples.
    pub data: f64,
    /// Backbone, forward.
    pub backbone: f64,
    /// Primaries and trunk, forward.
    pub trunk: f64,
    /// Rasterizer and picture losses, forward and backward.
    pub raster: f64,
    /// Depth losses.
    pub loss: f64,
    /// Remaining backward pass.
    pub backward: f64,
    /// Summation of gradients, norm, optimizer.
    pub optimizer: f64,
}

impl Seconds {
    /// Returns name and seconds of each part.
    pub fn parts(&self) -> [(&'static str, f64); 7] {
        [
            ("data", self.data),
            ("backbone", self.backbone),
            ("trunk", self.trunk),
            ("raster", self.raster),
            ("loss", self.loss),
            ("backward", self.backward),
            ("optimizer", self.optimizer),
        ]
    }

    /// Adds the seconds of `other`.
    pub fn add(&mut self, other: &Self) {
        self.data += other.data;
        self.backbone += other.backbone;
        self.trunk += other.trunk;
        self.raster += other.raster;
        self.loss += other.loss;
        self.backward += other.backward;
        self.optimizer += other.optimizer;
    }
}

/// The model and the data that its loss needs.
pub struct Learner {
    model: SubSplat,
    /// The same model on the CPU, for groups that the device could not compute.
    on_cpu: SubSplat,
    backend: Backend,
    config: TrainConfig,
    lpips: Option<Lpips>,
    /// One thread pool per parallel group. Groups run in parallel, each in its share of the
    /// threads, so that threads synchronise once per step instead of once per operation.
    pools: Vec<rayon::ThreadPool>,
}

/// Weight of an example, and the step that seeds random values.
#[derive(Clone, Copy, Debug)]
pub struct StepScale {
    /// Weight of one example in the mean loss of the step.
    pub share: f64,
    /// Number of the step.
    pub step: u64,
}

/// The optimizer and the sum to which it adds gradients.
struct GradientSink<'a> {
    optimizer: &'a Optimizer,
    gradients: &'a mut Gradients,
}

/// One scene of a group after the backbone.
struct EncodedScene<'a> {
    views: Views,
    output: BackboneOutput,
    example: &'a Example,
}

/// Results of one group of scenes that pass through the backbone together.
pub(super) struct GroupSum {
    /// Gradients of the group's share of the loss.
    pub gradients: Gradients,
    /// Means over the group's scenes.
    pub terms: Terms,
    /// Seconds of this process.
    pub seconds: Seconds,
}

impl GroupSum {
    /// Adds the group to the sums of a step. `share` is its share of the batch's scenes.
    pub(super) fn add_to(
        &self,
        gradients: &mut Gradients,
        terms: &mut Terms,
        seconds: &mut Seconds,
        share: f64,
    ) {
        let start = Instant::now();
        gradients.add(&self.gradients);
        seconds.add(&self.seconds);
        seconds.optimizer += start.elapsed().as_secs_f64();
        terms.add(&self.terms, share);
    }
}

/// Stacks the context views of `examples` as the network's input.
///
/// # Errors
/// Views of different sizes, or fewer than two.
pub fn views_of(examples: &[&Example]) -> Result<Views> {
    let first = examples.iter().flat_map(|e| &e.context).next();
    let Some(first) = first else { return Err(Error::value("examples", "at least one", "none")) };
    let w = first.image.width;
    let h = first.image.height;
    let v = examples[0].context.len();
    let mut pixels = Vec::with_capacity(examples.len() * v * 3 * w * h);
    for picture in examples.iter().flat_map(|e| &e.context) {
        pixels.extend(picture.image.to_planes());
    }
    let images = Tensor::from_vec(pixels, (examples.len(), v, 3, h, w), &Device::Cpu)?;
    let cameras = examples.iter().map(|e| e.context.iter().map(|p| p.camera).collect()).collect();
    let planes = examples.iter().map(|e| vec![e.near_far; e.context.len()]).collect();
    Ok(Views::new(images, cameras, planes)?)
}

/// Returns the rasterizer options for target `camera` of `example` and a model with `config`.
pub fn raster_options(config: &Config, example: &Example, camera: &Camera) -> RasterOptions {
    let width = example.context.first().map_or(1, |p| p.image.width.max(1));
    let ratio = camera.intrinsics().width as f32 / width as f32;
    let inputs = Rgb::mean_colour(example.context.iter().map(|p| &p.image));
    config.raster_options(ratio, example.near_far.near, inputs)
}

/// Returns the elements of a tensor.
fn flat(t: &Tensor) -> Result<Vec<f32>> {
    Ok(t.flatten_all()?.to_vec1::<f32>()?)
}

impl Learner {
    /// Builds the model from `weights`, which must be trainable.
    ///
    /// # Errors
    /// Weights that do not fit; a weight file of LPIPS that cannot be read; a device that cannot be
    /// opened.
    pub fn new(config: &TrainConfig, weights: &Weights) -> Result<Self> {
        let on_cpu = SubSplat::new(&config.model_config()?, weights.builder())?;
        let backend = Backend::open(&config.device)?;
        let model = on_cpu.clone().with_backend(&backend);
        let lpips = match &config.loss.lpips_weights {
            Some(path) if config.loss.lpips > 0.0 => {
                Some(Lpips::new(Weights::load(path)?.builder())?)
            }
            _ => None,
        };
        let threads = rayon::current_num_threads();
        let count = match (config.parallel_groups, backend.is_cpu()) {
            (_, false) => 1,
            (0, true) => threads,
            (count, true) => count,
        };
        let pool = |i: usize| {
            let share = (threads + count - 1 - i) / count;
            let built = rayon::ThreadPoolBuilder::new().num_threads(share.max(1)).build();
            built.map_err(|e| Error::value("threads", "a thread pool", e))
        };
        let pools = (0..count).map(pool).collect::<Result<_>>()?;
        Ok(Self { model, on_cpu, backend, config: config.clone(), lpips, pools })
    }

    /// Returns the model.
    pub fn model(&self) -> &SubSplat {
        &self.model
    }

    /// Returns the kernels that the model uses.
    pub fn backend(&self) -> &Backend {
        &self.backend
    }

    /// Returns the GPU of the configured device, if it is one.
    pub(super) fn executor(&self) -> Option<&Arc<Executor>> {
        self.model.trunk().executor()
    }

    /// Returns why the CPU took over work of the configured GPU; `None` where it did not.
    pub fn warning(&self) -> Option<String> {
        self.backend.warning()
    }

    /// Adds the gradients of the loss of `examples` and returns the mean terms. Each example counts
    /// `scale.share`, and `scale.step` seeds random values.
    ///
    /// # Errors
    /// An invalid input of the network.
    pub fn accumulate(
        &self,
        examples: &[Example],
        scale: StepScale,
        optimizer: &Optimizer,
        gradients: &mut Gradients,
        seconds: &mut Seconds,
    ) -> Result<Terms> {
        let groups: Vec<Vec<&Example>> =
            examples.chunks(self.config.together.max(1)).map(|g| g.iter().collect()).collect();
        let mut terms = Terms::default();
        // In the order of the groups: the sums do not depend on the number of groups in parallel.
        for (group, sum) in groups.iter().zip(self.group_sums(&groups, scale, optimizer)?) {
            let share = group.len() as f64 / examples.len() as f64;
            sum.add_to(gradients, &mut terms, seconds, share);
        }
        Ok(terms)
    }

    /// Results of `groups` of scenes, in their order.
    ///
    /// # Errors
    /// Those of [`Learner::accumulate`].
    pub(super) fn group_sums(
        &self,
        groups: &[Vec<&Example>],
        scale: StepScale,
        optimizer: &Optimizer,
    ) -> Result<Vec<GroupSum>> {
        let next = AtomicUsize::new(0);
        let found: Vec<Mutex<Option<Result<GroupSum>>>> =
            groups.iter().map(|_| Mutex::new(None)).collect();
        let work = || {
            while let Some(i) =
                Some(next.fetch_add(1, Ordering::Relaxed)).filter(|i| *i < groups.len())
            {
                let one = self.group(&groups[i], scale, optimizer);
                *found[i].lock().unwrap_or_else(PoisonError::into_inner) = Some(one);
            }
        };
        std::thread::scope(|scope| {
            for pool in self.pools.iter().take(groups.len()) {
                scope.spawn(|| pool.install(work));
            }
        });
        let sum = |one: Mutex<Option<Result<GroupSum>>>| {
            let one = one.into_inner().unwrap_or_else(PoisonError::into_inner);
            one.ok_or_else(|| Error::value("step", "a result of every scene", "none"))?
        };
        found.into_iter().map(sum).collect()
    }

    /// Computes gradients and terms of scenes that pass through the backbone together. The CPU
    /// repeats a group whose device failed.
    fn group(
        &self,
        group: &[&Example],
        scale: StepScale,
        optimizer: &Optimizer,
    ) -> Result<GroupSum> {
        if let Some(executor) = self.model.trunk().executor()
            && let Some(result) = executor
                .attempt(&self.backend, || self.group_with(&self.model, group, scale, optimizer))
        {
            return result;
        }
        self.group_with(&self.on_cpu, group, scale, optimizer)
    }

    /// [`Learner::group`] with `model`.
    fn group_with(
        &self,
        model: &SubSplat,
        group: &[&Example],
        scale: StepScale,
        optimizer: &Optimizer,
    ) -> Result<GroupSum> {
        let mut seconds = Seconds::default();
        let mut gradients = optimizer.gradients();
        let views = views_of(group)?;
        let (loss, terms) = match self.config.phase {
            Phase::Depth => self.depth_group(model, group, &views, scale.share, &mut seconds)?,
            Phase::Render => {
                let sink = GradientSink { optimizer, gradients: &mut gradients };
                self.render_group(model, group, &views, scale, sink, &mut seconds)?
            }
        };
        let start = Instant::now();
        let store = loss.value.backward()?;
        seconds.backward += start.elapsed().as_secs_f64();
        let start = Instant::now();
        optimizer.collect(&store, &mut gradients)?;
        seconds.optimizer += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let rest = loss.backward(&store)?;
        if !rest.is_empty() {
            optimizer.collect(&sum(rest)?.backward()?, &mut gradients)?;
        }
        seconds.backward += start.elapsed().as_secs_f64();
        Ok(GroupSum { gradients, terms, seconds })
    }

    /// Computes the loss of the depth phase.
    fn depth_group(
        &self,
        model: &SubSplat,
        group: &[&Example],
        views: &Views,
        share: f64,
        seconds: &mut Seconds,
    ) -> Result<(Taped<Tensor>, Terms)> {
        let start = Instant::now();
        let maps = model.depth_maps(views, self.disparity_mean())?;
        seconds.backbone += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let unmeasured =
            Terms { mse: f64::NAN, dssim: f64::NAN, lpips: f64::NAN, ..Terms::default() };
        let (mut parts, mut terms) = (Vec::new(), unmeasured);
        let weight = share * group.len() as f64;
        self.depth_losses(group, &maps.value, weight, &mut parts, &mut terms)?;
        seconds.loss += start.elapsed().as_secs_f64();
        let total = sum(parts)?;
        Ok((maps.map(|_| total), terms))
    }

    /// Adds to `parts` scalars whose sum is `weight` times the mean depth loss of `group`.
    fn depth_losses(
        &self,
        group: &[&Example],
        maps: &DepthMaps,
        weight: f64,
        parts: &mut Vec<Tensor>,
        terms: &mut Terms,
    ) -> Result<()> {
        (terms.cross_entropy, terms.disparity, terms.confidence) = (f64::NAN, f64::NAN, f64::NAN);
        let Backbone::Small(small) = &self.model.config().backbone else { return Ok(()) };
        if group.iter().any(|e| e.inverse_depth.len() != e.context.len()) {
            return Ok(());
        }
        let d = small.depth_candidates;
        let (mut fine, mut coarse) = (Vec::new(), Vec::new());
        for example in group {
            for (inverse, view) in example.inverse_depth.iter().zip(&example.context) {
                let inverse: Vec<f32> = inverse.iter().map(|v| v.to_f32()).collect();
                let index = loss::candidate_index(&inverse, example.near_far, d);
                coarse.extend(loss::block_median(&index, view.image.width));
                fine.extend(index);
            }
        }
        let w = &self.config.loss;
        let (_, _, h4, w4) = maps.logits.dims4()?;
        let index = flat(&maps.index)?;
        let entropy = loss::two_hot_cross_entropy(&flat(&maps.logits)?, &coarse, [d, h4 * w4]);
        let disparity = loss::smooth_l1(&index, &fine);
        let confidence = loss::confidence(&flat(&maps.confidence)?, &index, &fine);
        (terms.cross_entropy, terms.disparity) = (entropy.value, disparity.value);
        terms.confidence = confidence.value;
        let all = [
            (&maps.logits, entropy, w.cross_entropy),
            (&maps.index, disparity, w.disparity),
            (&maps.confidence, confidence, w.confidence),
        ];
        for (tensor, scored, factor) in all {
            terms.loss += factor * scored.value;
            if factor > 0.0 {
                parts.push(with_gradient(tensor, scored.scaled(factor * weight))?);
            }
        }
        Ok(())
    }

    /// Computes the loss of the rendering phase. The trunk's gradients go to `sink`.
    fn render_group(
        &self,
        model: &SubSplat,
        group: &[&Example],
        views: &Views,
        scale: StepScale,
        mut sink: GradientSink<'_>,
        seconds: &mut Seconds,
    ) -> Result<(Taped<Tensor>, Terms)> {
        let start = Instant::now();
        let encoded = model.encode_for_training(views, self.disparity_mean())?;
        let (output, maps) = &encoded.value;
        let frozen = self.config.optimizer.freeze_backbone;
        let output = if frozen { output.detach()? } else { output.clone() };
        seconds.backbone += start.elapsed().as_secs_f64();
        let (mut parts, mut terms) = (Vec::new(), Terms::default());
        match maps {
            Some(maps) if !frozen => {
                let start = Instant::now();
                let weight = scale.share * group.len() as f64;
                self.depth_losses(group, maps, weight, &mut parts, &mut terms)?;
                seconds.loss += start.elapsed().as_secs_f64();
            }
            _ => {
                (terms.cross_entropy, terms.disparity, terms.confidence) =
                    (f64::NAN, f64::NAN, f64::NAN);
            }
        }
        for (b, example) in group.iter().enumerate() {
            let scene = EncodedScene { views: views.scene(b)?, output: output.scene(b)?, example };
            let scene_terms =
                self.render_scene(model, &scene, scale, &mut sink, &mut parts, seconds)?;
            terms.add(&scene_terms, 1.0 / group.len() as f64);
        }
        let total = sum(parts)?;
        Ok((encoded.map(|_| total), terms))
    }

    /// Renders one scene and propagates its loss back to the backbone's output. The trunk's
    /// gradients go to `sink`; scalars for the remaining backward pass go to `parts`.
    fn render_scene(
        &self,
        model: &SubSplat,
        scene: &EncodedScene<'_>,
        scale: StepScale,
        sink: &mut GradientSink<'_>,
        parts: &mut Vec<Tensor>,
        seconds: &mut Seconds,
    ) -> Result<Terms> {
        let EncodedScene { views, output, example } = scene;
        let StepScale { share, step } = scale;
        let start = Instant::now();
        let mut settings = model.config().primaries().clone();
        settings.opacity_exponent = self.opacity_exponent(step, settings.opacity_exponent);
        let parents = packed(output, views, &settings)?;
        let mut trunk = model.trunk().clone();
        trunk.set_upscale(example.upscale())?;
        if trunk.reads_features() && !trunk.trains_on_device() {
            // Each chunk of a gather on a GPU would upload the feature maps.
            trunk.set_backend(&Backend::Cpu);
        }
        if trunk.is_off() {
            let children = Children::whole(&parents)?;
            seconds.trunk += start.elapsed().as_secs_f64();
            let start = Instant::now();
            let rendered = self.pictures(&children, example)?;
            let [rows, sh, gain] = rendered.gradients;
            parts.push(with_gradient(&children.rows, rows.scaled(share))?);
            parts.push(with_gradient(&children.sh, sh.scaled(share))?);
            parts.push(with_gradient(&children.gain, gain.scaled(share))?);
            seconds.raster += start.elapsed().as_secs_f64();
            return Ok(rendered.terms);
        }
        let primaries = parents.split()?;
        let pass = trunk.forward_recomputed(
            views,
            output,
            &primaries,
            TrainPass { chunk: CHUNK, seed: step },
        )?;
        seconds.trunk += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let rendered = self.pictures(pass.children(), example)?;
        let [rows, sh, gain] = rendered.gradients.map(|g| g.scaled(share));
        parts.push(with_gradient(&pass.children().sh, sh)?);
        seconds.raster += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let collect = |store: &GradStore| sink.optimizer.collect(store, sink.gradients);
        parts.extend(pass.backward([&rows.gradient, &gain.gradient], collect)?);
        seconds.backward += start.elapsed().as_secs_f64();
        Ok(rendered.terms)
    }

    fn disparity_mean(&self) -> DisparityMean {
        if self.config.loss.around_mode {
            DisparityMean::AroundMode
        } else {
            DisparityMean::AllCandidates
        }
    }

    /// Returns the exponent x of the opacity mapping at `step` (MVSplat, `map_pdf_to_opacity`).
    fn opacity_exponent(&self, step: u64, last: f64) -> f64 {
        let l = &self.config.loss;
        if l.opacity_steps == 0 {
            return last;
        }
        let share = (step as f64 / l.opacity_steps as f64).min(1.0);
        l.opacity_start + share * (last - l.opacity_start)
    }
}

/// Adds scalars.
fn sum(parts: Vec<Tensor>) -> Result<Tensor> {
    let mut parts = parts.into_iter();
    let Some(mut total) = parts.next() else {
        return Err(Error::value("loss", "at least one weight above 0", "none"));
    };
    for part in parts {
        total = (total + part)?;
    }
    Ok(total)
}
