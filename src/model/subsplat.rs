//! The whole model: posed pictures to children.

use super::backbone::small::DepthMaps;
use super::backbone::{Mvsplat, SmallBackbone};
use super::look;
use super::primaries::primaries;
use super::trace::Trace;
use super::trunk::{Children, Trunk};
use super::{BackboneOutput, Primaries, Views};
use crate::abi::RasterOptions;
use crate::camera::Camera;
use crate::config::{Backbone, Config, FeatureLevel};
use crate::ops::Backend;
use candle_core::{Error, Result, Tensor, bail};
use candle_nn::VarBuilder;

enum Encoder {
    Mvsplat(Box<Mvsplat>),
    Small(Box<SmallBackbone>),
}

/// SubSplat with its backbone, built from one [`Config`].
///
/// Parameter names: MVSplat's own at the root (a converted checkpoint loads as it
/// is, with or without its `encoder.` prefix), the small backbone under `small.`,
/// everything that SubSplat adds under `subsplat.`.
pub struct SubSplat {
    config: Config,
    encoder: Encoder,
    trunk: Trunk,
}

/// One scene out of [`SubSplat::forward`].
pub struct SceneOutput {
    /// The Gaussians that are rendered.
    pub children: Children,
    /// Distance along the unit ray of each input pixel (its first Gaussian's),
    /// `[V, H·W]`, world units.
    pub depths: Vec<Vec<f32>>,
}

/// The stages that [`SubSplat::forward`] announces, in order.
pub const STAGES: [&str; 3] = ["backbone", "primaries", "subsplat"];

impl SubSplat {
    /// Builds the model; `vb` is at the root of the names.
    ///
    /// # Errors
    /// A configuration out of range; a tensor that is missing or has another shape,
    /// named with both shapes.
    pub fn new(config: &Config, vb: VarBuilder) -> Result<Self> {
        config.check().map_err(Error::wrap)?;
        let encoder = match &config.backbone {
            Backbone::Mvsplat(c) => Encoder::Mvsplat(Box::new(Mvsplat::new(c, vb.clone())?)),
            Backbone::Small(c) => Encoder::Small(Box::new(SmallBackbone::new(c, vb.pp("small"))?)),
        };
        let trunk = Trunk::new(config, &feature_channels(config), vb)?;
        Ok(Self { config: config.clone(), encoder, trunk })
    }

    /// The model with the plane sweep, the attention's gather, SPGR and the rasterizer on
    /// `backend`, the rest in candle on the CPU as before.
    pub fn with_backend(mut self, backend: &Backend) -> Self {
        match &mut self.encoder {
            Encoder::Mvsplat(encoder) => encoder.set_backend(backend),
            Encoder::Small(encoder) => encoder.set_backend(backend),
        }
        self.trunk.set_backend(backend);
        self
    }

    /// The configuration that the model was built from.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// What turns primaries into children.
    pub fn trunk(&self) -> &Trunk {
        &self.trunk
    }

    /// The backbone alone, at inference.
    ///
    /// # Errors
    /// Sides that are no multiples of [`Config::stride`].
    pub fn encode(&self, views: &Views) -> Result<BackboneOutput> {
        let (h, w) = views.size()?;
        let stride = self.config.stride();
        if h % stride != 0 || w % stride != 0 {
            bail!("input images: expected sides that are multiples of {stride}, got {w}x{h}");
        }
        in_pool(|| match &self.encoder {
            Encoder::Mvsplat(encoder) => encoder.forward(views, &mut Trace::off()),
            Encoder::Small(encoder) => Ok(encoder.forward(views, false)?.0),
        })
    }

    /// `views` with near and far by what a first look at half the size shows, from half
    /// of their near to twice their far; the same for all views of a scene. Unchanged
    /// where the configuration looks once ([`crate::config::Small::first_look`]; MVSplat
    /// always does: its weights know no depths but those that it was trained with).
    ///
    /// # Errors
    /// Sides that are no multiples of [`Config::stride`].
    pub fn look(&self, views: &Views) -> Result<Views> {
        match (&self.encoder, &self.config.backbone) {
            (Encoder::Small(network), Backbone::Small(c)) if c.first_look => {
                in_pool(|| look::ranges(network, views, self.config.stride()))
            }
            _ => Ok(views.clone()),
        }
    }

    /// The backbone for training: with every gradient, and with its depth maps where it
    /// is the small one. `around_mode` averages disparity as inference does, else over
    /// all candidates.
    ///
    /// # Errors
    /// Sides that are no multiples of [`Config::stride`].
    pub fn encode_for_training(
        &self,
        views: &Views,
        around_mode: bool,
    ) -> Result<(BackboneOutput, Option<DepthMaps>)> {
        match &self.encoder {
            Encoder::Mvsplat(encoder) => Ok((encoder.forward(views, &mut Trace::off())?, None)),
            Encoder::Small(encoder) => {
                let (output, maps) = encoder.forward(views, !around_mode)?;
                Ok((output, Some(maps)))
            }
        }
    }

    /// The small backbone's depth alone; `around_mode` as in
    /// [`SubSplat::encode_for_training`].
    ///
    /// # Errors
    /// Another backbone; sides that are no multiples of [`Config::stride`].
    pub fn depth_maps(&self, views: &Views, around_mode: bool) -> Result<DepthMaps> {
        match &self.encoder {
            Encoder::Mvsplat(_) => bail!("depth maps: expected the small backbone, got MVSplat's"),
            Encoder::Small(encoder) => encoder.depth(views, !around_mode),
        }
    }

    /// World-frame primaries of what the backbone gave.
    ///
    /// # Errors
    /// Shapes that do not fit `views`.
    pub fn primaries(&self, views: &Views, output: &BackboneOutput) -> Result<Primaries> {
        primaries(output, views, self.config.primaries(), &mut Trace::off())
    }

    /// Pictures to children, one [`SceneOutput`] a scene. `stage` hears the name of
    /// each stage ([`STAGES`]) as it begins.
    ///
    /// # Errors
    /// Whatever a stage finds wrong with its input; a result that is not finite.
    pub fn forward(
        &self,
        views: &Views,
        stage: &mut dyn FnMut(&'static str),
    ) -> Result<Vec<SceneOutput>> {
        let mut scenes = Vec::with_capacity(views.scenes());
        for b in 0..views.scenes() {
            // Scenes do not see one another; one at a time bounds the memory.
            let views = views.scene(b)?;
            stage(STAGES[0]);
            let output = self.encode(&views)?;
            stage(STAGES[1]);
            let parents = self.primaries(&views, &output)?;
            stage(STAGES[2]);
            let children = in_pool(|| self.trunk.forward(&views, &output, &parents))?;
            let depths = output.depths.narrow(3, 0, 1)?.squeeze(3)?.squeeze(0)?.to_vec2()?;
            scenes.push(SceneOutput { children, depths });
        }
        Ok(scenes)
    }

    /// Pictures straight to what `camera` sees of them, `[5, H, W]` a scene (R, G, B,
    /// alpha, Σ w·z): the children are never in memory ([`Trunk::render`]).
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
            let output = self.encode(&views)?;
            let parents = self.primaries(&views, &output)?;
            in_pool(|| self.trunk.render(&views, &output, &parents, camera, options))
        };
        (0..views.scenes()).map(one).collect()
    }
}

/// Runs `work` on a thread of the current pool: from there a parallel call does not wait
/// for another thread to wake up, and the network makes hundreds of them.
fn in_pool<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| work())
}

/// Channels of every feature level that the configuration's backbone has.
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
