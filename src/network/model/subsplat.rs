//! The whole model: from posed images to children.

use super::backbone::small::{DepthMaps, DisparityMean};
use super::backbone::{Mvsplat, SmallBackbone};
use super::half_size_pass;
use super::primaries::primaries;
use super::taped::Tape;
use super::taped::Taped;
use super::trace::{Checkpoint, Trace};
use super::trunk::{Children, Trunk};
use super::{BackboneOutput, Levels, Primaries, Views};
use crate::network::config::{Backbone, Config, FeatureLevel};
use crate::network::ops::small::SmallArray;
use crate::network::ops::{Array, Backend};
use candle_core::{Error, Result, Tensor, bail};
use candle_nn::VarBuilder;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::RasterOptions;

#[derive(Clone)]
enum Encoder {
    Mvsplat(Box<Mvsplat>),
    Small(Box<SmallBackbone>),
}

/// SubSplat with its backbone, built from one [`Config`].
///
/// Parameter names: MVSplat's own at the root (a converted checkpoint loads with or
/// without its `encoder.` prefix), the small backbone's under `small.`, SubSplat's under
/// `subsplat.`.
#[derive(Clone)]
pub struct SubSplat {
    config: Config,
    encoder: Encoder,
    trunk: Trunk,
}

/// The result of [`SubSplat::forward`] for one scene.
pub struct SceneOutput {
    /// The Gaussians to render.
    pub children: Children,
    /// `[V, H·W]`: distance of each input pixel's first Gaussian along the unit ray, world
    /// units.
    pub depths: Vec<Vec<f32>>,
}

/// Names of the stages that [`SubSplat::forward`] reports, in order.
pub const STAGES: [&str; 3] = ["backbone", "primaries", "subsplat"];

impl SubSplat {
    /// Builds the model; `vb` is at the root of the names.
    ///
    /// # Errors
    /// The configuration is invalid; a tensor is missing or has another shape (the message
    /// names it and both shapes).
    pub fn new(config: &Config, vb: VarBuilder) -> Result<Self> {
        config.check().map_err(Error::wrap)?;
        let encoder = match &config.backbone {
            Backbone::Mvsplat(c) => Encoder::Mvsplat(Box::new(Mvsplat::new(c, vb.clone())?)),
            Backbone::Small(c) => Encoder::Small(Box::new(SmallBackbone::new(c, vb.pp("small"))?)),
        };
        let trunk = Trunk::new(config, &feature_channels(config), vb)?;
        Ok(Self { config: config.clone(), encoder, trunk })
    }

    /// Returns the model on `backend`: at inference the network and the rasterizer, in training
    /// the backbone, and the trunk where [`Trunk::trains_on_device`].
    pub fn with_backend(mut self, backend: &Backend) -> Self {
        match &mut self.encoder {
            Encoder::Mvsplat(encoder) => encoder.set_backend(backend),
            Encoder::Small(encoder) => encoder.set_backend(backend),
        }
        self.trunk.set_backend(backend);
        self
    }

    /// Returns the model with r = `upscale` ([`Trunk::set_upscale`]).
    ///
    /// # Errors
    /// Those of [`Trunk::set_upscale`].
    pub fn with_upscale(mut self, upscale: usize) -> Result<Self> {
        self.trunk.set_upscale(upscale)?;
        self.config.upscale = upscale;
        Ok(self)
    }

    /// Returns the configuration of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the part that turns primaries into children.
    pub fn trunk(&self) -> &Trunk {
        &self.trunk
    }

    /// Runs the backbone alone, at inference.
    ///
    /// # Errors
    /// A side is not a multiple of [`Config::stride`].
    pub fn encode(&self, views: &Views) -> Result<BackboneOutput> {
        in_pool(|| self.encode_with(views, &|| Ok(())))
    }

    /// [`SubSplat::encode`] on this thread, with `checkpoint` after each of
    /// [`SubSplat::encode_steps`].
    ///
    /// # Errors
    /// Those of [`SubSplat::encode`] and of `checkpoint`.
    pub fn encode_with(&self, views: &Views, checkpoint: Checkpoint<'_>) -> Result<BackboneOutput> {
        self.check_input(views)?;
        if let Some(result) = self.trunk.on_device(|executor| {
            let images = executor.upload(&views.images)?;
            let mut trace = Trace::with_checkpoint(checkpoint);
            self.encode_on(views, &images, &|_| true, &mut trace)?.to_host()
        }) {
            return result;
        }
        let mut trace = Trace::with_checkpoint(checkpoint);
        self.encode_on(views, &views.images, &|_| true, &mut trace)
    }

    /// Refuses images whose sides are no multiples of [`Config::stride`].
    pub(super) fn check_input(&self, views: &Views) -> Result<()> {
        let (h, w) = views.size()?;
        let stride = self.config.stride();
        if h % stride != 0 || w % stride != 0 {
            bail!("input images: expected sides that are multiples of {stride}, got {w}x{h}");
        }
        Ok(())
    }

    /// Runs the backbone on the executor of `images`, the views' images, for the feature maps of `levels`.
    pub(super) fn encode_on<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        levels: Levels<'_>,
        trace: &mut Trace<'_>,
    ) -> Result<BackboneOutput<A>> {
        match &self.encoder {
            Encoder::Mvsplat(encoder) => {
                let mut output = encoder.forward_on(views, images, trace)?;
                output.features.retain(|(level, _)| levels(*level));
                Ok(output)
            }
            Encoder::Small(encoder) => {
                let mean = DisparityMean::AroundMode;
                Ok(encoder.forward_on(views, images, mean, levels, trace)?.0)
            }
        }
    }

    /// Returns the number of steps of [`SubSplat::encode_with`] for one scene of `views` views.
    pub fn encode_steps(&self, views: usize) -> usize {
        match &self.encoder {
            Encoder::Mvsplat(encoder) => encoder.steps(views),
            Encoder::Small(_) => SmallBackbone::steps(views),
        }
    }

    /// Estimates near and far depth from half-size images.
    ///
    /// Returns `views` with the estimated range, one for all views of a scene; the search
    /// covers half of `views`' near to twice their far. Returns `views` unchanged if
    /// [`crate::network::config::Small::estimate_depth_range`] is off, and for MVSplat, whose weights
    /// fit the depths of its training only.
    ///
    /// # Errors
    /// A side is not a multiple of [`Config::stride`].
    pub fn estimate_depth_range(&self, views: &Views) -> Result<Views> {
        in_pool(|| self.estimate_depth_range_with(views, &|| Ok(())))
    }

    /// [`SubSplat::estimate_depth_range`] on this thread, with `checkpoint` after each of four
    /// steps.
    ///
    /// # Errors
    /// Those of [`SubSplat::estimate_depth_range`] and of `checkpoint`.
    pub fn estimate_depth_range_with(
        &self,
        views: &Views,
        checkpoint: Checkpoint<'_>,
    ) -> Result<Views> {
        match (&self.encoder, &self.config.backbone) {
            (Encoder::Small(network), Backbone::Small(c)) if c.estimate_depth_range => {
                let d = network.candidates();
                let stride = self.config.stride();
                half_size_pass::estimate_depth_range(views, d, stride, |views| {
                    self.depth_indices(network, views, &Trace::with_checkpoint(checkpoint))
                })
            }
            _ => Ok(views.clone()),
        }
    }

    /// Candidate indices `[B·V, 1, H, W]` of the small backbone's depth.
    fn depth_indices(
        &self,
        network: &SmallBackbone,
        views: &Views,
        trace: &Trace<'_>,
    ) -> Result<Tensor> {
        let mean = DisparityMean::AroundMode;
        if let Some(result) = self.trunk.on_device(|executor| {
            let images = executor.upload(&views.images)?;
            network.depth_on(views, &images, mean, trace)?.index.to_host()
        }) {
            return result;
        }
        Ok(network.depth_on(views, &views.images, mean, trace)?.index)
    }

    /// Runs the backbone for training: with every gradient, and with its depth maps if it
    /// is the small one. The output of a GPU has feature maps only where the trunk reads them.
    ///
    /// # Errors
    /// A side is not a multiple of [`Config::stride`].
    pub fn encode_for_training(
        &self,
        views: &Views,
        mean: DisparityMean,
    ) -> Result<Taped<(BackboneOutput, Option<DepthMaps>)>> {
        if let Some(result) = self.trunk.on_device(|executor| {
            let images = executor.upload(&views.images)?;
            let (mut output, maps) = self.train_on(views, &images, mean)?;
            if !self.trunk.reads_features() {
                output.features.clear();
            }
            let mut tape = Tape::new(executor);
            let output = output.copied(&mut tape)?;
            let maps = maps.map(|maps| maps.copied(&mut tape)).transpose()?;
            Ok(Taped::on_device((output, maps), tape))
        }) {
            return result;
        }
        Ok(Taped::on_host(self.train_on(views, &views.images, mean)?))
    }

    /// Runs the backbone for training on the executor of `images`, the views' images.
    fn train_on<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        mean: DisparityMean,
    ) -> Result<(BackboneOutput<A>, Option<DepthMaps<A>>)> {
        match &self.encoder {
            Encoder::Mvsplat(encoder) => {
                Ok((encoder.forward_on(views, images, &mut Trace::off())?, None))
            }
            Encoder::Small(encoder) => {
                let (output, maps) =
                    encoder.forward_on(views, images, mean, &|_| true, &Trace::off())?;
                Ok((output, Some(maps)))
            }
        }
    }

    /// Computes the small backbone's depth alone, with every gradient.
    ///
    /// # Errors
    /// The backbone is MVSplat's; a side is not a multiple of [`Config::stride`].
    pub fn depth_maps(&self, views: &Views, mean: DisparityMean) -> Result<Taped<DepthMaps>> {
        let Encoder::Small(encoder) = &self.encoder else {
            bail!("depth maps: expected the small backbone, got MVSplat's")
        };
        if let Some(result) = self.trunk.on_device(|executor| {
            let images = executor.upload(&views.images)?;
            let maps = encoder.depth_on(views, &images, mean, &Trace::off())?;
            let mut tape = Tape::new(executor);
            let maps = maps.copied(&mut tape)?;
            Ok(Taped::on_device(maps, tape))
        }) {
            return result;
        }
        Ok(Taped::on_host(encoder.depth(views, mean)?))
    }

    /// Returns the world-frame primaries of the backbone's `output`.
    ///
    /// # Errors
    /// Shapes do not fit `views`.
    pub fn primaries(&self, views: &Views, output: &BackboneOutput) -> Result<Primaries> {
        primaries(output, views, self.config.primaries(), &mut Trace::off())
    }

    /// Computes the children of every scene. `stage` receives the name of each stage
    /// ([`STAGES`]) when it begins.
    ///
    /// # Errors
    /// Those of the stages; a result is not finite.
    pub fn forward(
        &self,
        views: &Views,
        stage: &mut dyn FnMut(&'static str),
    ) -> Result<Vec<SceneOutput>> {
        let mut scenes = Vec::with_capacity(views.scenes());
        for b in 0..views.scenes() {
            // Scenes are independent; one at a time bounds the memory.
            let views = views.scene(b)?;
            stage(STAGES[0]);
            let features = in_pool(|| self.encode_scene(&views, &|| Ok(())))?;
            stage(STAGES[1]);
            let encoding = self.place(features)?;
            stage(STAGES[2]);
            scenes.push(in_pool(|| encoding.children(self, &|| Ok(())))?);
        }
        Ok(scenes)
    }

    /// Renders every scene from `camera` without storing its children ([`Trunk::render`]):
    /// `[5, H, W]` a scene (R, G, B, alpha, Σ w·z). On a GPU nothing but the picture and its number of
    /// (splat, tile) pairs returns to the host.
    ///
    /// # Errors
    /// Those of [`SubSplat::forward`] and of the rasterizer.
    pub fn render(
        &self,
        views: &Views,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Vec<Tensor>> {
        let one = |b: usize| {
            let views = views.scene(b)?;
            let features = in_pool(|| self.features(&views, &|| Ok(()), false))?;
            self.place(features)?.render(self, camera, options)
        };
        (0..views.scenes()).map(one).collect()
    }
}

/// Runs `work` on a thread of the current pool. Hundreds of parallel calls of the network
/// then start without waking another thread first.
pub(super) fn in_pool<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| work())
}

/// Returns the feature levels of the configuration's backbone with their channels.
pub fn feature_channels(config: &Config) -> Vec<(FeatureLevel, usize)> {
    let [quarter, cnn4, cnn2, full] = match &config.backbone {
        Backbone::Mvsplat(c) => {
            [c.cnn_channels[2], c.cnn_channels[2], c.cnn_channels[0], c.refine_channels]
        }
        Backbone::Small(c) => {
            [c.unet_channels[0], c.cnn_channels[1], c.cnn_channels[0], c.head_channels]
        }
    };
    vec![
        (FeatureLevel::Trans4, quarter),
        (FeatureLevel::Trans8, quarter),
        (FeatureLevel::Trans16, quarter),
        (FeatureLevel::Cnn4, cnn4),
        (FeatureLevel::Cnn2, cnn2),
        (FeatureLevel::Refine1, full),
    ]
}
