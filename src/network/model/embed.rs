//! Attribute embeddings of the primaries (SubSplat A.2):
//! z^g = W_g(φ_x(μ) + φ_s(s) + φ_q(q) + φ_α(α)),   z^a = φ_c(vec(h)),   both `[n, E]`.
//!
//! * `pg`: φ is (Linear, ReLU, LayerNorm) twice.
//! * `lite`: φ is Linear to 32 and GELU. W_g is one matrix over the four hidden vectors,
//!   which equals the sum of four linear maps; φ_c has 64 hidden units. A LayerNorm follows
//!   each.

use super::geometry::{Frames, ParentChunk};
use super::layers::{Activation, LayerNorm, xavier};
use super::mlp::{Block2, affine, affine_then, linear};
use crate::network::config::{AlphaInput, AnchorFrame, Embed, EmbedMlp, ScaleInput};
use crate::network::ops::Array;
use crate::network::ops::attributes::Attributes;
use candle_core::{Result, Tensor};
use candle_nn::{Linear, VarBuilder};

/// Hidden width of the `lite` geometry attributes.
const LITE_HIDDEN: usize = 32;
/// Hidden width of the `lite` colour embedding.
const LITE_HIDDEN_COLOUR: usize = 64;
/// Clip of the opacity logit.
const LOGIT_MAX: f64 = 6.0;
/// Smallest divisor of a coordinate and smallest argument of ln z, world units.
const Z_MIN: f64 = 1e-3;
/// Bound of x/z and y/z: a parent can lie beside a camera that is not its source.
const SLOPE_MAX: f64 = 100.0;
/// Smallest argument of ln σ, world units.
const SCALE_MIN: f64 = 1e-12;

/// Components of each attribute, in the order x, s, q, a.
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

/// One geometry and one appearance descriptor of each parent of a chunk: the embeddings
/// z^g and z^a, or the aggregated features f^g and f^a.
#[derive(Clone, Debug)]
pub struct Descriptors<A = Tensor> {
    /// `[n, E]`.
    pub geometry: A,
    /// `[n, E]`.
    pub appearance: A,
}

/// The embeddings' parameters.
#[derive(Clone, Debug)]
pub struct Embeddings {
    config: Embed,
    mlps: Mlps,
}

impl Embeddings {
    /// Reads the parameters `x`, `s`, `q`, `a`, `c` and `w_g`; `sh` is the length of vec(h).
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
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
                let all = WIDTHS.len() * LITE_HIDDEN;
                let c = LITE_HIDDEN_COLOUR;
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

    /// Returns the conditioned attributes μ, s, q, α side by side, `[n, 11]`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn attributes<A: Array>(&self, parents: &ParentChunk<A>, frames: &Frames) -> Result<A> {
        let c = &self.config;
        let source = &frames.0[parents.source];
        let rules = Attributes {
            frame: match c.anchor_frame {
                AnchorFrame::World => None,
                AnchorFrame::SrcCam => Some(source.numbers()),
                AnchorFrame::View0 => Some(frames.0[0].numbers()),
            },
            source: source.numbers(),
            log_px: (c.scale == ScaleInput::LogPx)
                .then_some(f64::from(source.camera.intrinsics().fx)),
            position: c.mu,
            logit: (c.alpha == AlphaInput::Logit).then_some(LOGIT_MAX),
            z_min: Z_MIN,
            slope_max: SLOPE_MAX,
            scale_min: SCALE_MIN,
        };
        parents.rows()?.attributes(rules)
    }

    /// Returns z^g and z^a, `[n, E]`.
    ///
    /// # Errors
    /// Shapes do not fit.
    pub fn forward<A: Array>(
        &self,
        parents: &ParentChunk<A>,
        frames: &Frames,
    ) -> Result<Descriptors<A>> {
        let all = self.attributes(parents, frames)?;
        match &self.mlps {
            Mlps::Pg { geometry, w_g, colour } => {
                let mut sum = geometry[0].forward(&all.narrow(1, 0, WIDTHS[0].1)?)?;
                let mut first = WIDTHS[0].1;
                for (block, (_, width)) in geometry.iter().zip(WIDTHS).skip(1) {
                    let next = block.forward(&all.narrow(1, first, width)?)?;
                    sum = sum.add(&next)?;
                    first += width;
                }
                Ok(Descriptors {
                    geometry: affine(w_g, &sum)?,
                    appearance: colour.forward(&parents.sh)?,
                })
            }
            Mlps::Lite { geometry, w_g, ln_g, colour, ln_c } => {
                let hidden = affine_then(&side_by_side(geometry)?, &all, Activation::Gelu)?;
                let geometry = ln_g.forward(&affine(w_g, &hidden)?)?;
                let hidden = affine_then(&colour[0], &parents.sh, Activation::Gelu)?;
                let appearance = ln_c.forward(&affine(&colour[1], &hidden)?)?;
                Ok(Descriptors { geometry, appearance })
            }
        }
    }
}

/// One block-diagonal layer: all inputs side by side to all outputs side by side.
fn side_by_side(layers: &[Linear]) -> Result<Linear> {
    let widths = layers.iter().map(|l| l.weight().dim(1)).collect::<Result<Vec<_>>>()?;
    let all: usize = widths.iter().sum();
    let mut weights = Vec::new();
    let mut biases = Vec::new();
    let mut first = 0;
    for (layer, width) in layers.iter().zip(widths) {
        weights.push(layer.weight().pad_with_zeros(1, first, all - first - width)?);
        biases.extend(layer.bias());
        first += width;
    }
    Ok(Linear::new(Tensor::cat(&weights, 0)?, Some(Tensor::cat(&biases, 0)?)))
}
