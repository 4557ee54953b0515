//! Backbones: from posed images to depth, opacity and raw Gaussian parameters. This file
//! holds MVSplat's encoder (arXiv 2403.14627), parameter for parameter; [`small`] holds the
//! small backbone.
//!
//! MVSplat's code has two orders of rows, and so has this one. The CNN's rows are (b v),
//! scene-major; those of transformer and depth predictor are (v b), row = v·B + b.

pub mod cnn;
pub mod cost_volume;
pub mod depth;
pub mod small;
mod small_parts;
pub mod transformer;
pub mod unet;

pub use small::{DisparityMean, SmallBackbone};
pub(crate) use small_parts::apply_small_initial_value;

use super::trace::Trace;
use super::{BackboneOutput, Views};
use crate::network::config::{Config, FeatureLevel, Mvsplat as Settings};
use crate::network::ops::{Array, Backend};
use candle_core::{Result, bail};
use candle_nn::VarBuilder;

/// MVSplat's encoder.
#[derive(Clone, Debug)]
pub struct Mvsplat {
    cnn: cnn::Cnn,
    transformer: transformer::Transformer,
    depth: depth::DepthPredictor,
    settings: Settings,
}

impl Mvsplat {
    /// Builds the encoder; `vb` is at its root (`backbone.…`, `depth_predictor.…`).
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(settings: &Settings, vb: VarBuilder) -> Result<Self> {
        let backbone = vb.pp("backbone");
        Ok(Self {
            cnn: cnn::Cnn::new(settings.cnn_channels, backbone.pp("backbone"))?,
            transformer: transformer::Transformer::new(settings, backbone.pp("transformer"))?,
            depth: depth::DepthPredictor::new(settings, vb.pp("depth_predictor"))?,
            settings: settings.clone(),
        })
    }

    /// Sets the backend of the following plane sweeps.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.depth.backend = backend.clone();
    }

    /// Returns the number of steps, with a checkpoint after each, of a scene of `views` views.
    pub fn steps(&self, views: usize) -> usize {
        let Settings { transformer_layers, costvolume_levels, refine_levels, .. } = self.settings;
        let cnn = 7;
        let transformer = 2 + 2 * transformer_layers;
        let cost_volume = 7 + unet::UNet::steps(costvolume_levels);
        let coarse_depth = 7;
        let refinement = 5 + views + unet::UNet::steps(refine_levels);
        let heads = 2 + views;
        cnn + transformer + cost_volume + coarse_depth + refinement + heads
    }

    /// Runs the encoder on any number of scenes of two or more views. `trace` records the
    /// stages under the names of the reference outputs (`cnn.conv1`, …,
    /// `depth.to_disparity_vb`).
    ///
    /// # Errors
    /// H or W is not a multiple of [`Config::stride`]; those of candle.
    pub fn forward(&self, views: &Views, trace: &mut Trace<'_>) -> Result<BackboneOutput> {
        self.forward_on(views, &views.images, trace)
    }

    /// [`Mvsplat::forward`] on the executor of `images`, the views' images.
    ///
    /// # Errors
    /// Those of [`Mvsplat::forward`].
    pub fn forward_on<A: Array>(
        &self,
        views: &Views,
        images: &A,
        trace: &mut Trace<'_>,
    ) -> Result<BackboneOutput<A>> {
        let [b, v, _, height, width] = images.sizes()?;
        let stride = Config::stride_of(&self.settings);
        if height == 0 || width == 0 || height % stride != 0 || width % stride != 0 {
            bail!("backbone: expected sides that are multiples of {stride}, got {height}x{width}");
        }
        let cnn = self.cnn.forward(&images.reshape((b * v, 3, height, width))?, trace)?;
        let [_, c, h, w] = cnn.quarter.sizes()?;
        let cnn4 = cnn.quarter.reshape((b, v, c, h, w))?;
        trace.put("cnn.features", &cnn4)?;
        let trans4 = self.transformer.forward(&cnn4, views.sources(), trace)?;
        let input = depth::Input {
            views,
            images: vb_rows(images)?,
            cnn: vb_rows(&cnn4)?,
            trans: vb_rows(&trans4)?,
        };
        let out = self.depth.forward(input, trace)?;
        let pooled = |s: usize| -> Result<A> {
            let x = trans4.reshape((b * v, c, h, w))?.avg_pool2d(s)?;
            x.reshape((b, v, c, h / s, w / s))
        };
        let [_, half, hh, hw] = cnn.half.sizes()?;
        let features = vec![
            (FeatureLevel::Trans8, pooled(2)?),
            (FeatureLevel::Trans16, pooled(4)?),
            (FeatureLevel::Trans4, trans4),
            (FeatureLevel::Cnn4, cnn4),
            (FeatureLevel::Cnn2, cnn.half.reshape((b, v, half, hh, hw))?),
            (FeatureLevel::Refine1, bv_rows(&out.refined, v)?),
        ];
        Ok(BackboneOutput {
            raw: bv_rows(&out.raw, v)?,
            depths: bv_rows(&out.depths, v)?,
            densities: bv_rows(&out.densities, v)?,
            features,
        })
    }
}

/// Maps `[B, V, …]` to `[V·B, …]`, view-major.
///
/// # Errors
/// Fewer than two dimensions.
pub fn vb_rows<A: Array>(x: &A) -> Result<A> {
    let x = swapped(x)?;
    let mut dims = x.dims().to_vec();
    let views = dims.remove(0);
    dims[0] *= views;
    x.reshape(dims)
}

/// Exchanges the first two dimensions.
fn swapped<A: Array>(x: &A) -> Result<A> {
    let mut order: Vec<usize> = (0..x.dims().len()).collect();
    match order.get_mut(..2) {
        Some(first) => first.reverse(),
        None => bail!("rows: expected two dimensions or more, got {:?}", x.dims()),
    }
    x.permute(&order)
}

/// Maps `[V·B, …]` to `[B, V, …]`.
///
/// # Errors
/// The first dimension is not a multiple of `views`.
pub fn bv_rows<A: Array>(x: &A, views: usize) -> Result<A> {
    let mut dims = vec![views, x.dims()[0] / views.max(1)];
    dims.extend_from_slice(&x.dims()[1..]);
    swapped(&x.reshape(dims)?)
}
