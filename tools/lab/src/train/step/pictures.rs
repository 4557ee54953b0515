//! Losses of a scene's pictures, and their gradients with respect to the children.

use super::{Learner, Terms, flat, raster_options};
use crate::data::dataset::Posed;
use crate::train::Result;
use crate::train::loss;
use crate::train::loss::{Scored, with_gradient};
use crate::train::source::{Example, InputTargets};
use candle_core::{Device, Tensor, Var};
use subsplat::network::model::trunk::Children;
use subsplat::network::ops::rasterize_on;
use subsplat_kernels::cpu::detail::{Photograph, SourceView, residuals, with_residuals};

/// Returns a detached copy that collects its own gradient.
fn leaf(t: &Tensor) -> Result<Var> {
    Ok(Var::from_tensor(&t.detach())?)
}

impl Learner {
    /// Renders every target of `example` and propagates the loss back to the children immediately,
    /// so that one picture's graph exists at a time.
    pub(super) fn pictures(&self, children: &Children, example: &Example) -> Result<RenderedLoss> {
        let gain = self.detailed_gain(children, example)?;
        let gain = gain.as_ref().unwrap_or(&children.gain);
        let leaves = [leaf(&children.rows)?, leaf(&children.sh)?, leaf(gain)?];
        let mut gradients =
            [&children.rows, &children.sh, gain].map(|t| Scored::zero(t.elem_count()));
        let mut terms = Terms::default();
        let share = 1.0 / example.targets.len().max(1) as f64;
        for target in &example.targets {
            let mut options = raster_options(self.model.config(), example, &target.camera);
            options.sh_basis = children.sh_basis;
            let [rows, sh, gain] = &leaves;
            let planes = rasterize_on(&self.backend, rows, sh, gain, &target.camera, &options)?;
            let rgb = planes.narrow(0, 0, 3)?.contiguous()?;
            let (loss, found) = self.picture_loss(&rgb, target)?;
            terms.add(&found, share);
            let store = loss.backward()?;
            for (leaf, sum) in leaves.iter().zip(&mut gradients) {
                if let Some(g) = store.get(leaf) {
                    let gradient = flat(g)?;
                    sum.add(&Scored { value: 0.0, gradient }, share);
                }
            }
        }
        gradients[0].value = terms.loss;
        let channels = children.gain.elem_count() / children.rows.dim(0)?.max(1);
        if channels == 1 && gain.rank() == 2 {
            // δ is data: only the column of γ has a parameter.
            let of_gain = &mut gradients[2].gradient;
            *of_gain = of_gain.iter().step_by(4).copied().collect();
        }
        Ok(RenderedLoss { gradients, terms })
    }

    /// Returns γ and δ `[N·K, 4]` with the detail of the example's photographs, or `None` where it
    /// takes none.
    fn detailed_gain(&self, children: &Children, example: &Example) -> Result<Option<Tensor>> {
        if example.input_targets != InputTargets::WithDetail {
            return Ok(None);
        }
        let context = &example.context;
        let first = example.targets.len().saturating_sub(context.len());
        let photographs = &example.targets[first..];
        let pixels: Vec<Vec<f32>> = photographs.iter().map(|t| t.image.to_unit()).collect();
        let views = context.iter().zip(photographs).zip(&pixels).map(|((view, photo), pixels)| {
            let (w, h) = (photo.image.width, photo.image.height);
            SourceView { photograph: Photograph::new(pixels, w, h), camera: view.camera }
        });
        let views: Vec<SourceView<'_>> = views.collect();
        let means = children.rows.narrow(1, 0, 3)?.contiguous()?;
        let count = children.rows.dim(0)?;
        let per_view = count / (children.k * views.len()).max(1);
        let upscale = example.upscale();
        let delta = residuals(&views, &flat(&means)?, per_view, children.k, upscale);
        let gain = with_residuals(&flat(&children.gain)?, &delta);
        Ok(Some(Tensor::from_vec(gain, (count, 4), &Device::Cpu)?))
    }

    /// Returns the loss of one picture as a scalar of candle's graph, and its terms.
    fn picture_loss(&self, rgb: &Tensor, target: &Posed) -> Result<(Tensor, Terms)> {
        let w = &self.config.loss;
        let (_, height, width) = rgb.dims3()?;
        let x = flat(rgb)?;
        let truth = target.image.to_planes();
        let mut all = loss::mse(&x, &truth).scaled(w.mse);
        let mut terms = Terms {
            mse: all.value / w.mse.max(1e-30),
            dssim: f64::NAN,
            lpips: f64::NAN,
            ..Terms::default()
        };
        if w.mse == 0.0 {
            terms.mse = loss::mse(&x, &truth).value;
        }
        if w.dssim > 0.0 {
            let found = loss::dssim(&x, &truth, width, height);
            terms.dssim = found.value;
            all.add(&found, w.dssim);
        }
        terms.loss = all.value;
        let mut total = with_gradient(rgb, all)?;
        if let Some(lpips) = &self.lpips {
            let truth = Tensor::from_vec(truth, (1, 3, height, width), &Device::Cpu)?;
            let found = lpips.forward(&rgb.unsqueeze(0)?, &truth)?.mean_all()?;
            terms.lpips = f64::from(found.to_scalar::<f32>()?);
            terms.loss += w.lpips * terms.lpips;
            total = (total + (found * w.lpips)?)?;
        }
        Ok((total, terms))
    }
}

/// Loss of a scene's pictures: gradients of rows, SH and gain, and the terms.
pub(super) struct RenderedLoss {
    pub(super) gradients: [Scored; 3],
    pub(super) terms: Terms,
}
