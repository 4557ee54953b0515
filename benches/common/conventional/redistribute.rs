//! Opacity redistribution as a chain of tensor operations, differentiable.

use candle_core::{D, Result, Tensor};
use candle_nn::ops::softmax;

/// α·softmax(ℓ − ln(A + ε)): `logits` and `areas` `[P, K]`, `opacities` `[P]`.
pub fn linear(logits: &Tensor, areas: &Tensor, opacities: &Tensor) -> Result<Tensor> {
    let weights = softmax(&logits.sub(&areas.affine(1.0, 1e-8)?.log()?)?, D::Minus1)?;
    weights.broadcast_mul(&opacities.unsqueeze(1)?)
}

/// 1 − exp(−τ·softmax(ℓ)/B) with τ = −ln(1 − α) and B = A / the area of the parent.
pub fn optical_depth(
    logits: &Tensor,
    areas: &Tensor,
    opacities: &Tensor,
    parent_areas: &Tensor,
) -> Result<Tensor> {
    let relative = areas.broadcast_div(&parent_areas.unsqueeze(1)?)?.maximum(1e-12)?;
    let tau = opacities.minimum(0.9999)?.affine(-1.0, 1.0)?.log()?.neg()?.unsqueeze(1)?;
    let share = softmax(logits, D::Minus1)?.div(&relative)?;
    share.broadcast_mul(&tau)?.neg()?.exp()?.affine(-1.0, 1.0)
}
