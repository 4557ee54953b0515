//! Attribute embeddings of the primaries (SubSplat A.2; spec 1.1):
//! z^g = W_g(φ_x(μ) + φ_s(s) + φ_q(q) + φ_α(α)),   z^a = φ_c(vec(h)),   both `[n, E]`.
//!
//! `pg`: φ = (Linear, ReLU, LayerNorm) twice. `lite`: φ = Linear to 32, GELU, and
//! W_g one matrix over the four hidden vectors side by side (which equals the sum of
//! four linear maps), φ_c through 64, a LayerNorm at the end of each.

use super::geometry::{Frames, ParentChunk, canonical};
use super::mlp::{Block2, LayerNorm, affine, gelu, linear, xavier};
use crate::config::{AlphaInput, AnchorFrame, Embed, EmbedMlp, MuInput, ScaleInput};
use crate::ops::attributes::{Attributes, attributes};
use crate::ops::moves;
use candle_core::{Result, Tensor};
use candle_nn::{Linear, VarBuilder};

/// Hidden width of the `lite` geometry attributes.
const LITE_HIDDEN: usize = 32;
/// Hidden width of the `lite` colour embedding.
const LITE_HIDDEN_COLOUR: usize = 64;
/// Clip of the opacity logit.
const LOGIT_MAX: f64 = 6.0;
/// Least depth that a coordinate is divided by or a logarithm taken of, world units.
const Z_MIN: f64 = 1e-3;
/// Bound of x/z and y/z: a parent beside a camera that is not its own.
const SLOPE_MAX: f64 = 100.0;
/// Least σ of which a logarithm is taken, world units.
const SCALE_MIN: f64 = 1e-12;

/// Numbers per attribute in the order x, s, q, a.
const WIDTHS: [(&str, usize); 4] = [("x", 3), ("s", 3), ("q", 4), ("a", 1)];

#[derive(Clone, Debug)]
enum Mlps {
    Pg {
        geometry: Vec<Block2>,
        w_g: Linear,
        colour: Block2,
    },
    Lite {
        geometry: Vec<Linear>,
        w_g: Linear,
        ln_g: LayerNorm,
        colour: [Linear; 2],
        ln_c: LayerNorm,
    },
}

/// The embeddings' parameters.
#[derive(Clone, Debug)]
pub struct Embeddings {
    config: Embed,
    mlps: Mlps,
}

impl Embeddings {
    /// Parameters `x`, `s`, `q`, `a`, `c` and `w_g`; `sh` is the length of vec(h).
    pub fn new(config: &Embed, sh: usize, vb: VarBuilder) -> Result<Self> {
        let e = config.dim;
        let relu = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
        let mlps = match config.mlp {
            EmbedMlp::Pg => {
                let block = |(name, n): (&str, usize)| Block2::new(n, e, vb.pp(name));
                Mlps::Pg {
                    geometry: WIDTHS.into_iter().map(block).collect::<Result<_>>()?,
                    w_g: linear(e, e, xavier(e, e), vb.pp("w_g"))?,
                    colour: block(("c", sh))?,
                }
            }
            EmbedMlp::Lite => {
                let hidden =
                    |(name, n): (&str, usize)| linear(n, LITE_HIDDEN, relu, vb.pp(name).pp("lin0"));
                let (all, c) = (WIDTHS.len() * LITE_HIDDEN, LITE_HIDDEN_COLOUR);
                Mlps::Lite {
                    geometry: WIDTHS.into_iter().map(hidden).collect::<Result<_>>()?,
                    w_g: linear(all, e, xavier(all, e), vb.pp("w_g"))?,
                    ln_g: LayerNorm::new(e, vb.pp("ln_g"))?,
                    colour: [
                        linear(sh, c, relu, vb.pp("c").pp("lin0"))?,
                        linear(c, e, xavier(c, e), vb.pp("c").pp("lin1"))?,
                    ],
                    ln_c: LayerNorm::new(e, vb.pp("c").pp("ln"))?,
                }
            }
        };
        Ok(Self { config: config.clone(), mlps })
    }

    /// Conditioned attributes μ, s, q, α side by side, `[n, 11]` (spec 1.1).
    ///
    /// # Errors
    /// Whatever candle says.
    pub fn attributes(&self, parents: &ParentChunk, frames: &Frames) -> Result<Tensor> {
        let (c, source) = (&self.config, &frames.0[parents.source]);
        let rules = Attributes {
            frame: match c.anchor_frame {
                AnchorFrame::World => None,
                AnchorFrame::SrcCam => Some(source.numbers()),
                AnchorFrame::View0 => Some(frames.0[0].numbers()),
            },
            source: source.numbers(),
            log_px: (c.scale == ScaleInput::LogPx)
                .then_some(f64::from(source.camera.intrinsics.fx)),
            ray: c.mu == MuInput::RayLogz,
            logit: (c.alpha == AlphaInput::Logit).then_some(LOGIT_MAX),
            z_min: Z_MIN,
            slope_max: SLOPE_MAX,
            scale_min: SCALE_MIN,
        };
        attributes(&parents.rows()?, rules)
    }

    /// [`Embeddings::attributes`] in tensor operations, one tensor each: their reference
    /// in tests. μ `[n,3]`, s `[n,3]`, q `[n,4]`, α `[n,1]`.
    pub fn inputs(&self, parents: &ParentChunk, frames: &Frames) -> Result<[Tensor; 4]> {
        let source = &frames.0[parents.source];
        let frame = match self.config.anchor_frame {
            AnchorFrame::World => None,
            AnchorFrame::SrcCam => Some(source),
            AnchorFrame::View0 => Some(&frames.0[0]),
        };
        let (mean, quat) = match frame {
            None => (parents.means.clone(), parents.quats_wxyz.clone()),
            Some(f) => (f.to_camera(&parents.means)?, f.quat_to_camera(&parents.quats_wxyz)?),
        };
        let mean = match self.config.mu {
            MuInput::Raw => mean,
            MuInput::RayLogz => {
                let z = mean.narrow(1, 2, 1)?.maximum(Z_MIN)?;
                let slopes = mean.narrow(1, 0, 2)?.broadcast_div(&z)?;
                Tensor::cat(&[&slopes.clamp(-SLOPE_MAX, SLOPE_MAX)?, &z.log()?], 1)?
            }
        };
        let scale = match self.config.scale {
            ScaleInput::Raw => parents.scales.clone(),
            ScaleInput::LogPx => {
                let z = source.to_camera(&parents.means)?.narrow(1, 2, 1)?.maximum(Z_MIN)?;
                let fx = f64::from(source.camera.intrinsics.fx);
                let log = parents.scales.maximum(SCALE_MIN)?.log()?;
                log.broadcast_sub(&z.log()?.affine(1.0, -fx.ln())?)?
            }
        };
        let alpha = match self.config.alpha {
            AlphaInput::Raw => parents.opacities.clone(),
            AlphaInput::Logit => {
                let low = 1.0 / (1.0 + LOGIT_MAX.exp());
                let p = parents.opacities.clamp(low, 1.0 - low)?;
                (p.log()? - p.affine(-1.0, 1.0)?.log()?)?
            }
        };
        Ok([mean, scale, canonical(&quat)?, alpha])
    }

    /// z^g and z^a, `[n, E]`.
    pub fn forward(&self, parents: &ParentChunk, frames: &Frames) -> Result<(Tensor, Tensor)> {
        let all = self.attributes(parents, frames)?;
        match &self.mlps {
            Mlps::Pg { geometry, w_g, colour } => {
                let mut sum = geometry[0].forward(&all.narrow(1, 0, WIDTHS[0].1)?)?;
                let mut first = WIDTHS[0].1;
                for (block, (_, width)) in geometry.iter().zip(WIDTHS).skip(1) {
                    let next = block.forward(&all.narrow(1, first, width)?)?;
                    sum = moves::sum(&sum, &next)?;
                    first += width;
                }
                Ok((affine(w_g, &sum)?, colour.forward(&parents.sh)?))
            }
            Mlps::Lite { geometry, w_g, ln_g, colour, ln_c } => {
                let hidden = affine(&side_by_side(geometry)?, &all)?;
                let z_g = ln_g.forward(&affine(w_g, &gelu(&hidden)?)?)?;
                let hidden = gelu(&affine(&colour[0], &parents.sh)?)?;
                let z_a = affine(&colour[1], &hidden)?;
                Ok((z_g, ln_c.forward(&z_a)?))
            }
        }
    }
}

/// One layer that gives the outputs of all, side by side, of their inputs side by side.
fn side_by_side(layers: &[Linear]) -> Result<Linear> {
    let widths = layers.iter().map(|l| l.weight().dim(1)).collect::<Result<Vec<_>>>()?;
    let all: usize = widths.iter().sum();
    let (mut weights, mut biases, mut first) = (Vec::new(), Vec::new(), 0);
    for (layer, width) in layers.iter().zip(widths) {
        weights.push(layer.weight().pad_with_zeros(1, first, all - first - width)?);
        biases.extend(layer.bias());
        first += width;
    }
    Ok(Linear::new(Tensor::cat(&weights, 0)?, Some(Tensor::cat(&biases, 0)?)))
}
