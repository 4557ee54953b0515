//! MVSplat's encoder (arXiv 2403.14627), parameter for parameter: posed pictures to
//! depth, opacity and raw Gaussian parameters.
//!
//! Two orders of rows coexist, as in the original: the CNN works on (b v), scene-major;
//! transformer and depth predictor on (v b), row = v·B + b.

pub mod cnn;
pub mod cost_volume;
pub mod depth;
pub mod small;
mod small_parts;
pub mod transformer;
pub mod unet;

pub use small::SmallBackbone;
pub(crate) use small_parts::small_start;

use super::trace::Trace;
use super::{BackboneOutput, Views};
use crate::config::{Config, FeatureLevel, Mvsplat as Settings};
use crate::ops::Backend;
use candle_core::{Result, Tensor, bail};
use candle_nn::VarBuilder;

/// The whole encoder.
#[derive(Clone, Debug)]
pub struct Mvsplat {
    cnn: cnn::Cnn,
    transformer: transformer::Transformer,
    depth: depth::DepthPredictor,
    settings: Settings,
}

impl Mvsplat {
    /// `vb` at the root of the encoder (`backbone.…`, `depth_predictor.…`).
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

    /// Where the plane sweep of the next calls runs.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.depth.backend = backend.clone();
    }

    /// Any number of scenes and of views ≥ 2; H and W multiples of
    /// [`Config::stride`]. Stages go to `trace` under the names of the reference
    /// outputs (`cnn.conv1`, …, `depth.to_disparity_vb`).
    ///
    /// # Errors
    /// A picture size that does not fit; whatever candle says.
    pub fn forward(&self, views: &Views, trace: &mut Trace<'_>) -> Result<BackboneOutput> {
        let (b, v, _, height, width) = views.images.dims5()?;
        let stride = Config::stride_of(&self.settings);
        if height == 0 || width == 0 || height % stride != 0 || width % stride != 0 {
            bail!("backbone: expected sides that are multiples of {stride}, got {height}x{width}");
        }
        let cnn = self.cnn.forward(&views.images.reshape((b * v, 3, height, width))?, trace)?;
        let (_, c, h, w) = cnn.quarter.dims4()?;
        let cnn4 = cnn.quarter.reshape((b, v, c, h, w))?;
        trace.put("cnn.features", &cnn4)?;
        let trans4 = self.transformer.forward(&cnn4, trace)?;
        let input = depth::Input {
            views,
            images: vb_rows(&views.images)?,
            cnn: vb_rows(&cnn4)?,
            trans: vb_rows(&trans4)?,
        };
        let out = self.depth.forward(input, trace)?;
        let pooled = |s: usize| -> Result<Tensor> {
            let x = trans4.reshape((b * v, c, h, w))?.avg_pool2d(s)?;
            x.reshape((b, v, c, h / s, w / s))
        };
        let (_, half, hh, hw) = cnn.half.dims4()?;
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

/// `[B, V, …]` to `[V·B, …]`, view-major.
pub fn vb_rows(x: &Tensor) -> Result<Tensor> {
    x.transpose(0, 1)?.contiguous()?.flatten(0, 1)
}

/// `[V·B, …]` to `[B, V, …]`.
pub fn bv_rows(x: &Tensor, views: usize) -> Result<Tensor> {
    let mut dims = vec![views, x.dim(0)? / views.max(1)];
    dims.extend_from_slice(&x.dims()[1..]);
    x.reshape(dims)?.transpose(0, 1)?.contiguous()
}
