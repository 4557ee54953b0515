//! Linear layers with chosen initial values, and a LayerNorm: fused ops for f32, tensor
//! operations for f64, which the tests' references use.

use crate::ops::Array;
use crate::ops::activation::Activation;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, VarBuilder};

/// Purpose of a forward pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Inference: nothing is random.
    Infer,
    /// Training: `seed` determines the attention weights that are dropped.
    Train {
        /// Seed of this step.
        seed: u64,
    },
}

/// Uniform in ±√(6/(in + out)) (Xavier, Glorot).
pub(crate) fn xavier(inputs: usize, outputs: usize) -> Init {
    let bound = (6.0 / (inputs + outputs) as f64).sqrt();
    Init::Uniform { lo: -bound, up: bound }
}

/// y = x·Wᵀ + b; `weight` starts as given, `bias` at zero.
pub(crate) fn linear(
    inputs: usize,
    outputs: usize,
    weight: Init,
    vb: VarBuilder,
) -> Result<Linear> {
    let w = vb.get_with_hints((outputs, inputs), "weight", weight)?;
    let b = vb.get_with_hints(outputs, "bias", Init::Const(0.0))?;
    Ok(Linear::new(w, Some(b)))
}

/// x·Wᵀ + b of `x` `[n, inputs]`. f32 runs on the caller's thread ([`ops::linear`]),
/// because chunks of parents or scenes are the parallel tasks.
pub(crate) fn affine<A: Array>(layer: &Linear, x: &A) -> Result<A> {
    let bias = layer.bias().map(|bias| x.parameter(bias)).transpose()?;
    x.projected(&x.parameter(layer.weight())?, bias.as_ref())
}

/// x·Φ(x), exact form.
pub(crate) fn gelu<A: Array>(x: &A) -> Result<A> {
    x.activated(Activation::Gelu)
}

/// (x − mean)/√(variance + ε)·weight + bias over the last axis.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    /// Reads the parameters `weight` and `bias`, `[dim]`.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(dim: usize, vb: VarBuilder) -> Result<Self> {
        Ok(Self {
            weight: vb.get_with_hints(dim, "weight", Init::Const(1.0))?,
            bias: vb.get_with_hints(dim, "bias", Init::Const(0.0))?,
        })
    }

    /// Normalises `x` `[.., dim]`.
    ///
    /// # Errors
    /// Another last dimension.
    pub fn forward<A: Array>(&self, x: &A) -> Result<A> {
        x.layer_norm([&x.parameter(&self.weight)?, &x.parameter(&self.bias)?])
    }
}

/// (Linear, ReLU, LayerNorm) twice: an attribute MLP of PixelGaussian and
/// GaussianFormer. Parameters `lin0`, `ln0`, `lin1`, `ln1`.
#[derive(Clone, Debug)]
pub(crate) struct Block2 {
    lin: [Linear; 2],
    ln: [LayerNorm; 2],
}

impl Block2 {
    pub(crate) fn new(inputs: usize, dim: usize, vb: VarBuilder) -> Result<Self> {
        let relu = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
        Ok(Self {
            lin: [
                linear(inputs, dim, relu, vb.pp("lin0"))?,
                linear(dim, dim, relu, vb.pp("lin1"))?,
            ],
            ln: [LayerNorm::new(dim, vb.pp("ln0"))?, LayerNorm::new(dim, vb.pp("ln1"))?],
        })
    }

    pub(crate) fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let mut x = x.clone();
        for (lin, ln) in self.lin.iter().zip(&self.ln) {
            x = ln.forward(&affine(lin, &x)?.activated(Activation::Relu)?)?;
        }
        Ok(x)
    }
}
