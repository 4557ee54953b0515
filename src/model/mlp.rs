//! Linear layers with chosen initial values, and a LayerNorm: fused ops for f32, tensor
//! operations for f64, which the tests' references use.

use crate::ops;
use crate::ops::activation::{Activation, activation};
use candle_core::{D, DType, Result, Tensor};
use candle_nn::{Init, Linear, Module, VarBuilder};

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
pub(crate) fn affine(layer: &Linear, x: &Tensor) -> Result<Tensor> {
    match layer.bias() {
        Some(bias) if x.dtype() == DType::F32 => ops::linear::linear(x, layer.weight(), bias),
        _ => layer.forward(x),
    }
}

/// x·Φ(x), exact form.
pub(crate) fn gelu(x: &Tensor) -> Result<Tensor> {
    match x.dtype() {
        DType::F32 => activation(x, Activation::Gelu),
        _ => x.gelu_erf(),
    }
}

/// ε of every LayerNorm (PyTorch's default).
const NORM_EPS: f64 = 1e-5;

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

    /// Normalises `x` `[.., dim]`. f64 uses tensor operations: the fused kernel has f32
    /// only.
    ///
    /// # Errors
    /// Another last dimension.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        if x.dtype() == DType::F32 {
            return ops::norm::layer_norm(x, &self.weight, &self.bias);
        }
        let x = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
        let variance = x.sqr()?.mean_keepdim(D::Minus1)?;
        x.broadcast_div(&(variance + NORM_EPS)?.sqrt()?)?
            .broadcast_mul(&self.weight)?
            .broadcast_add(&self.bias)
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

    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let mut x = x.clone();
        for (lin, ln) in self.lin.iter().zip(&self.ln) {
            x = ln.forward(&affine(lin, &x)?.relu()?)?;
        }
        Ok(x)
    }
}
