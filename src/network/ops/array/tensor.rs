//! [`Array`] for candle's tensors: CPU kernels with gradients, in f32; single operations also in f64.
//!
//! A call of a method that candle has too is a call of candle's, which is inherent.

use super::{Array, ConvConfig};
use crate::network::ops::Backend;
use crate::network::ops::activation as pointwise;
use crate::network::ops::activation::Activation;
use crate::network::ops::add::add;
use crate::network::ops::attention::{Labels, attention};
use crate::network::ops::attention_gather::{
    Deferred, Gather, attention_gather_deferred, occlusion_gate,
};
use crate::network::ops::attributes::{Attributes, attributes};
use crate::network::ops::cat::{cat_columns, cat_rows, cat_upsampled};
use crate::network::ops::channels_last::channels_last;
use crate::network::ops::conv2d::conv2d;
use crate::network::ops::conv3d::conv3d;
use crate::network::ops::feed_forward::feed_forward;
use crate::network::ops::linear::{linear, linear_no_bias};
use crate::network::ops::norm;
use crate::network::ops::plane_sweep::{Sweep, plane_sweep_on};
use crate::network::ops::resize::{resize_bilinear, resize_bilinear_then, upsample_nearest};
use crate::network::ops::spgr::{Spgr, spgr_into_on};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{D, DType, Result, Tensor, bail};

/// Returns residual + x.
fn add_residual(residual: Option<&Tensor>, x: Tensor) -> Result<Tensor> {
    match residual {
        Some(residual) => Array::add(residual, &x),
        None => Ok(x),
    }
}

/// Applies `activation`, if there is one.
fn activated(x: Tensor, activation: Option<Activation>) -> Result<Tensor> {
    match activation {
        Some(kind) => x.activate(kind),
        None => Ok(x),
    }
}

impl Array for Tensor {
    fn dims(&self) -> &[usize] {
        self.dims()
    }

    fn parameter(&self, parameter: &Tensor) -> Result<Self> {
        Ok(parameter.clone())
    }

    fn new_tensor(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self> {
        Tensor::from_vec(values, dims, self.device())?.to_dtype(self.dtype())
    }

    fn upload(&self, tensor: &Tensor) -> Result<Self> {
        tensor.to_dtype(self.dtype())
    }

    fn to_host(&self) -> Result<Tensor> {
        Ok(self.clone())
    }

    fn detach(&self) -> Self {
        self.detach()
    }

    fn track_op(&self) -> bool {
        self.track_op()
    }

    fn reshape<S: ShapeWithOneHole>(&self, shape: S) -> Result<Self> {
        self.reshape(shape)
    }

    fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self> {
        self.narrow(dim, start, len)
    }

    fn permute(&self, order: &[usize]) -> Result<Self> {
        self.permute(order)?.contiguous()
    }

    fn index_select(&self, indices: &[u32], dim: usize) -> Result<Self> {
        self.index_select(&Tensor::new(indices, self.device())?, dim)
    }

    fn broadcast_as(&self, dims: &[usize]) -> Result<Self> {
        self.broadcast_as(dims)
    }

    fn channels_last(&self) -> Result<Self> {
        match self.dtype() {
            DType::F32 => channels_last(self),
            _ => self.flatten_from(2)?.transpose(1, 2)?.contiguous(),
        }
    }

    fn cat(parts: &[&Self], dim: usize) -> Result<Self> {
        if dim == 0 {
            return cat_rows(&parts.iter().map(|t| (*t).clone()).collect::<Vec<_>>());
        }
        Tensor::cat(parts, dim)
    }

    fn cat_upsampled(&self, coarse: &Self, scale: usize) -> Result<Self> {
        cat_upsampled(self, coarse, scale)
    }

    fn cat_columns(&self, second: &Self, third: Option<&Self>) -> Result<Self> {
        cat_columns(self, second, third)
    }

    fn affine(&self, factor: f64, offset: f64) -> Result<Self> {
        self.affine(factor, offset)
    }

    fn abs(&self) -> Result<Self> {
        self.abs()
    }

    fn sqr(&self) -> Result<Self> {
        self.sqr()
    }

    fn recip(&self) -> Result<Self> {
        self.recip()
    }

    fn clamp(&self, min: f64, max: f64) -> Result<Self> {
        if max == f64::INFINITY {
            return self.maximum(min);
        }
        self.clamp(min, max)
    }

    fn where_gt(&self, other: &Self, threshold: f64, fill: f64) -> Result<Self> {
        let greater = other.gt(threshold)?.broadcast_as(self.shape())?;
        greater.where_cond(self, &self.zeros_like()?.affine(1.0, fill)?)
    }

    fn activate(&self, kind: Activation) -> Result<Self> {
        match (self.dtype(), kind) {
            (DType::F32, _) => pointwise::activation(self, kind),
            (_, Activation::Relu) => self.relu(),
            (_, Activation::Silu) => self.silu(),
            (_, Activation::Gelu) => self.gelu_erf(),
            (_, Activation::Sigmoid) => candle_nn::ops::sigmoid(self),
        }
    }

    fn add(&self, other: &Self) -> Result<Self> {
        if self.dims() == other.dims() {
            return add(self, other);
        }
        self.broadcast_add(other)
    }

    fn sub(&self, other: &Self) -> Result<Self> {
        self.broadcast_sub(other)
    }

    fn mul(&self, other: &Self) -> Result<Self> {
        self.broadcast_mul(other)
    }

    fn div(&self, other: &Self) -> Result<Self> {
        self.broadcast_div(other)
    }

    fn sum(&self, dim: usize) -> Result<Self> {
        self.sum(dim)
    }

    fn mean(&self, dim: usize) -> Result<Self> {
        self.mean(dim)
    }

    fn max_keepdim(&self, dim: usize) -> Result<Self> {
        self.max_keepdim(dim)
    }

    fn weighted_sum(&self, weights: &Self) -> Result<Self> {
        self.matmul(&weights.unsqueeze(2)?)
    }

    fn softmax(&self) -> Result<Self> {
        pointwise::softmax(self)
    }

    fn conv2d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        ConvConfig { stride, padding }: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self> {
        activated(conv2d(self, weight, bias, stride, padding)?, activation)
    }

    fn conv3d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        ConvConfig { stride, padding }: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self> {
        if stride != 1 {
            bail!("conv3d: expected stride 1, got {stride}");
        }
        activated(conv3d(self, weight, bias, padding)?, activation)
    }

    fn linear(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let y = match (bias, self.dtype()) {
            (Some(bias), DType::F32) => linear(self, weight, bias)?,
            (None, DType::F32) => linear_no_bias(self, weight)?,
            (Some(bias), _) => self.matmul(&weight.t()?)?.broadcast_add(bias)?,
            (None, _) => self.matmul(&weight.t()?)?,
        };
        activated(y, activation)
    }

    fn group_norm(
        &self,
        groups: usize,
        [weight, bias]: [&Self; 2],
        activation: Option<Activation>,
        residual: Option<&Self>,
    ) -> Result<Self> {
        add_residual(
            residual,
            norm::group_norm_then(self, groups, norm::Affine { weight, bias }, activation)?,
        )
    }

    fn instance_norm(&self, activation: Option<Activation>) -> Result<Self> {
        norm::instance_norm_then(self, activation)
    }

    fn layer_norm(&self, [weight, bias]: [&Self; 2], residual: Option<&Self>) -> Result<Self> {
        if self.dtype() == DType::F32 {
            return add_residual(residual, norm::layer_norm(self, weight, bias)?);
        }
        // The fused kernel has f32 only.
        let x = self.broadcast_sub(&self.mean_keepdim(D::Minus1)?)?;
        let variance = x.sqr()?.mean_keepdim(D::Minus1)?;
        let scaled = x.broadcast_div(&(variance + norm::EPS)?.sqrt()?)?.broadcast_mul(weight)?;
        add_residual(residual, scaled.broadcast_add(bias)?)
    }

    fn upsample_bilinear2d(
        &self,
        [h, w]: [usize; 2],
        activation: Option<Activation>,
    ) -> Result<Self> {
        match activation {
            Some(activation) => resize_bilinear_then(self, h, w, activation),
            None => resize_bilinear(self, h, w),
        }
    }

    fn upsample_nearest2d(&self, scale: usize) -> Result<Self> {
        upsample_nearest(self, scale)
    }

    fn avg_pool2d(&self, size: usize) -> Result<Self> {
        self.avg_pool2d(size)
    }

    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self> {
        attention(self, k, v, scale, labels)
    }

    fn feed_forward(&self, message: &Self, weights: [&Self; 2], norm: [&Self; 2]) -> Result<Self> {
        feed_forward(self, message, weights, norm)
    }

    fn plane_sweep(&self, source: &Self, sweep: Sweep, backend: &Backend) -> Result<Self> {
        plane_sweep_on(backend, self, source, sweep)
    }

    fn attention_gather(
        &self,
        query: &Self,
        points: &Self,
        gather: Gather,
        deferred: Option<&Deferred>,
        residual: Option<&Self>,
        backend: &Backend,
    ) -> Result<Self> {
        let y = attention_gather_deferred(backend, self, query, points, gather, deferred)?;
        add_residual(residual, y)
    }

    fn occlusion_gate(&self, z: &Self, depths: &Self) -> Result<Self> {
        occlusion_gate(self, z, depths)
    }

    fn attributes(&self, rules: Attributes) -> Result<Self> {
        attributes(self, rules)
    }

    fn write_children(
        &self,
        parents: &Self,
        call: &Spgr,
        backend: &Backend,
        rows: &mut [f32],
        gains: &mut [f32],
    ) -> Result<()> {
        spgr_into_on(backend, self, parents, call, (rows, gains))
    }
}
