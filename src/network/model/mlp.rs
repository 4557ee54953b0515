//! Linear layers with chosen initial values, and an MLP of them.

use super::layers::{Activation, LayerNorm};
use crate::network::ops::Array;
use candle_core::Result;
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
    projected(layer, x, None)
}

/// [`affine`], then an activation function.
pub(crate) fn affine_then<A: Array>(layer: &Linear, x: &A, activation: Activation) -> Result<A> {
    projected(layer, x, Some(activation))
}

fn projected<A: Array>(layer: &Linear, x: &A, activation: Option<Activation>) -> Result<A> {
    let bias = layer.bias().map(|bias| x.parameter(bias)).transpose()?;
    x.linear(&x.parameter(layer.weight())?, bias.as_ref(), activation)
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
            x = ln.forward(&affine_then(lin, &x, Activation::Relu)?)?;
        }
        Ok(x)
    }
}
