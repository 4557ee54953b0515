//! MVSplat's depth predictor (MVSplat 3.1, "Depth estimation" and "Depth refinement";
//! 3.2): coarse disparity from the cost volume, refinement at full resolution, and the
//! heads. Rows are (v b).
//!
//! Full-resolution tensors are computed one row at a time to bound the memory, except in
//! the refinement U-Net, whose attention joins the views.

use super::cost_volume::{Refinement, correlation, disparities};
use super::unet::UNet;
use crate::network::config::Mvsplat as Settings;
use crate::network::model::Views;
use crate::network::model::layers::{Activation, Conv2d, ConvShape, GroupNorm, gelu, sigmoid};
use crate::network::model::trace::Trace;
use crate::network::ops::{Array, Backend};
use candle_core::Result;
use candle_nn::VarBuilder;
use subsplat_kernels::camera::NearFar;
use subsplat_kernels::layout::sh_coefficients;

/// Factor between feature maps and images.
const DOWNSCALE: usize = 4;

/// Input of the predictor; all rows are (v b).
pub struct Input<'a, A> {
    /// Cameras and depth ranges.
    pub views: &'a Views,
    /// `[V·B, 3, H, W]`, RGB in [0, 1].
    pub images: A,
    /// `[V·B, C, h, w]`, without position encoding.
    pub cnn: A,
    /// `[V·B, C, h, w]`.
    pub trans: A,
}

/// Output of the predictor; all rows are (v b).
pub struct Output<A> {
    /// `[V·B, H·W, 2 + 7 + 3·D]`: raw head, as in
    /// [`BackboneOutput`](crate::network::model::BackboneOutput).
    pub raw: A,
    /// `[V·B, H·W, G]`: distance along the unit ray, world units.
    pub depths: A,
    /// `[V·B, H·W, G]`: opacity in (0, 1).
    pub densities: A,
    /// `[V·B, C_r, H, W]`: the refinement U-Net's output.
    pub refined: A,
}

/// Coarse and full-resolution disparity.
struct Disparity<A> {
    /// `[V·B, 1, H, W]`.
    full: A,
    /// `[V·B, 1, H, W]`: largest probability among the candidates.
    pdf_max: A,
}

/// Two convolutions with a GELU between.
#[derive(Clone, Debug)]
struct Head(Conv2d, Conv2d);

impl Head {
    fn new(c_in: usize, hidden: usize, c_out: usize, vb: VarBuilder) -> Result<Self> {
        Ok(Self(
            Conv2d::new(c_in, hidden, ConvShape::K3, vb.pp("0"))?,
            Conv2d::new(hidden, c_out, ConvShape::K3, vb.pp("2"))?,
        ))
    }

    fn forward<A: Array>(&self, x: &A) -> Result<A> {
        self.1.forward(&self.0.forward_then(x, Activation::Gelu)?)
    }
}

/// The network.
#[derive(Clone, Debug)]
pub struct DepthPredictor {
    refinement: Refinement,
    depth_head_lowres: Head,
    upsampler: Conv2d,
    proj_feature: Conv2d,
    refine_stem: (Conv2d, GroupNorm),
    refine_unet: UNet,
    to_gaussians: Head,
    to_disparity: Head,
    candidates: usize,
    per_pixel: usize,
    /// Backend of the plane sweep.
    pub(super) backend: Backend,
}

impl DepthPredictor {
    /// Builds the predictor; `vb` is at `depth_predictor`.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(s: &Settings, vb: VarBuilder) -> Result<Self> {
        let c = s.cnn_channels[2];
        let d = s.depth_candidates;
        let r = s.refine_channels;
        let g = s.gaussians_per_pixel;
        let raw = 2 + 7 + 3 * sh_coefficients(s.primaries.sh_degree);
        let refine = vb.pp("refine_unet");
        Ok(Self {
            refinement: Refinement::new(s, vb.clone())?,
            depth_head_lowres: Head::new(d, 2 * d, d, vb.pp("depth_head_lowres"))?,
            upsampler: Conv2d::new(2 * c, c, ConvShape::K3, vb.pp("upsampler.0"))?,
            proj_feature: Conv2d::new(c, r, ConvShape::K3, vb.pp("proj_feature"))?,
            refine_stem: (
                Conv2d::new(3 + r + 2, r, ConvShape::K3, refine.pp("0"))?,
                // Four groups here, eight everywhere else.
                GroupNorm::new(4, r, refine.pp("1"))?,
            ),
            refine_unet: UNet::new(r, s.refine_levels, refine.pp("3"))?,
            to_gaussians: Head::new(r + 3 + c, 2 * raw, raw, vb.pp("to_gaussians"))?,
            to_disparity: Head::new(r, 2 * r, 2 * g, vb.pp("to_disparity"))?,
            candidates: d,
            per_pixel: g,
            backend: Backend::Cpu,
        })
    }

    /// Runs the predictor from cost volume to heads.
    ///
    /// # Errors
    /// A camera is not invertible; those of candle.
    pub fn forward<A: Array>(
        &self,
        input: Input<'_, A>,
        trace: &mut Trace<'_>,
    ) -> Result<Output<A>> {
        let Input { views, images, cnn, trans } = input;
        let disparity = self.coarse(views, &trans, trace)?;
        let joined = trans.cat_channels(&cnn)?;
        drop((trans, cnn));
        let low = self.upsampler.forward(&joined)?;
        drop(joined);
        trace.put("depth.upsampler.0", &low)?;
        let up = Upsampled::new(low, trace)?;
        let refined = self.refine(&images, &up, &disparity, views.views(), trace)?;
        let raw = self.gaussians(&images, &up, &refined, trace)?;
        let (depths, densities) = self.disparity(views, &refined, &disparity, trace)?;
        Ok(Output { raw, depths, densities, refined })
    }

    fn coarse<A: Array>(
        &self,
        views: &Views,
        trans: &A,
        trace: &mut Trace<'_>,
    ) -> Result<Disparity<A>> {
        let candidates = disparities(views, self.candidates);
        let volume = correlation(&self.backend, views, &candidates, trans, trace)?;
        let volume = self.refinement.forward(&volume, trans, views.views(), trace)?;
        let logits = self.depth_head_lowres.forward(&volume)?;
        trace.put("depth.logits_vb", &logits)?;
        let [rows, d, h, w] = logits.sizes()?;
        // Candidates are the last axis: a strided softmax or sum is many times slower.
        let pdf = logits.channels_last()?.softmax()?;
        trace.put_with("depth.pdf_vb", || pdf.permute(&[0, 2, 1])?.reshape((rows, d, h, w)))?;
        let candidates = pdf.new_tensor(candidates.concat(), &[rows, d])?;
        let map = |x: A| x.reshape((rows, 1, h, w));
        let disparity = map(pdf.weighted_sum(&candidates)?)?;
        trace.put("depth.coarse_disp_vb", &disparity)?;
        let pdf_max = map(pdf.max_keepdim(2)?)?;
        trace.put("depth.pdf_max_vb", &pdf_max)?;
        let full = disparity.upsample_bilinear2d([DOWNSCALE * h, DOWNSCALE * w], None)?;
        trace.put("depth.fullres_disp_vb", &full)?;
        let pdf_max = pdf_max.upsample_nearest2d(DOWNSCALE)?;
        trace.put("depth.pdf_max_fullres_vb", &pdf_max)?;
        Ok(Disparity { full, pdf_max })
    }

    fn refine<A: Array>(
        &self,
        images: &A,
        up: &Upsampled<A>,
        disparity: &Disparity<A>,
        views: usize,
        trace: &mut Trace<'_>,
    ) -> Result<A> {
        let name = "depth.refine_unet";
        let projected = each_row(images, |r| {
            trace.step()?;
            self.proj_feature.forward(&up.row(r)?)
        })?;
        trace.put("depth.proj_feature_vb", &projected)?;
        let x = A::cat(&[images, &projected, &disparity.full, &disparity.pdf_max], 1)?;
        drop(projected);
        trace.put(&format!("{name}.in_vb"), &x)?;
        let x = self.refine_stem.0.forward(&x)?;
        trace.put(&format!("{name}.0"), &x)?;
        let x = self.refine_stem.1.forward(&x)?;
        trace.put(&format!("{name}.1"), &x)?;
        let x = gelu(&x)?;
        trace.put(&format!("{name}.2"), &x)?;
        self.refine_unet.forward(&x, views, trace, &format!("{name}.3"))
    }

    fn gaussians<A: Array>(
        &self,
        images: &A,
        up: &Upsampled<A>,
        refined: &A,
        trace: &mut Trace<'_>,
    ) -> Result<A> {
        let raw = each_row(images, |r| {
            trace.step()?;
            let row = |x: &A| x.narrow(0, r, 1);
            let x = A::cat(&[&row(refined)?, &row(images)?], 1)?.cat_channels(&up.row(r)?)?;
            self.to_gaussians.forward(&x)?.channels_last()
        })?;
        trace.put_with("depth.to_gaussians_vb", || {
            let [rows, _, h, w] = images.sizes()?;
            raw.permute(&[0, 2, 1])?.reshape((rows, (), h, w))
        })?;
        Ok(raw)
    }

    /// Depths and densities, `[V·B, H·W, G]`.
    fn disparity<A: Array>(
        &self,
        views: &Views,
        refined: &A,
        disparity: &Disparity<A>,
        trace: &mut Trace<'_>,
    ) -> Result<(A, A)> {
        let (b, g) = (views.scenes(), self.per_pixel);
        let out = self.to_disparity.forward(refined)?;
        trace.put("depth.to_disparity_vb", &out)?;
        let full = out.narrow(1, 0, g)?.add(&disparity.full)?.channels_last()?;
        let depths = each_row(&full, |r| {
            let NearFar { near, far } = views.near_far[r % b][r / b];
            full.narrow(0, r, 1)?.clamp(f64::from(1.0 / far), f64::from(1.0 / near))?.recip()
        })?;
        Ok((depths, sigmoid(&out.narrow(1, g, g)?.channels_last()?)?))
    }
}

/// GELU(bilinear ×4): 32 MiB per 256² view. Each use recomputes it, unless a gradient or the
/// trace needs it.
struct Upsampled<A> {
    low: A,
    kept: Option<A>,
}

impl<A: Array> Upsampled<A> {
    fn new(low: A, trace: &mut Trace<'_>) -> Result<Self> {
        let kept = if low.track_op() || trace.is_on() { Some(Self::make(&low)?) } else { None };
        if let Some(up) = &kept {
            trace.put("depth.upsampler_vb", up)?;
        }
        Ok(Self { low, kept })
    }

    fn make(low: &A) -> Result<A> {
        let [_, _, h, w] = low.sizes()?;
        low.upsample_bilinear2d([DOWNSCALE * h, DOWNSCALE * w], Some(Activation::Gelu))
    }

    /// Returns row `r`, `[1, C, H, W]`.
    fn row(&self, r: usize) -> Result<A> {
        match &self.kept {
            Some(up) => up.narrow(0, r, 1),
            None => Self::make(&self.low.narrow(0, r, 1)?),
        }
    }
}

/// Joins `f` of every row index of `like` along the first dimension.
fn each_row<A: Array>(like: &A, f: impl Fn(usize) -> Result<A>) -> Result<A> {
    let rows = (0..like.dims()[0]).map(f).collect::<Result<Vec<_>>>()?;
    A::cat(&rows.iter().collect::<Vec<_>>(), 0)
}
