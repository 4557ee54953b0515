//! The operations of the network, on either executor.
//!
//! The modules of [`crate::network::model`] are written once, over [`Array`]. `candle_core::Tensor`
//! implements it with the CPU kernels and their gradients; `DeviceArray` implements it with WGSL
//! kernels over buffers that stay on a GPU, and a tape of its own.

use super::activation::{self as pointwise, Activation};
use super::attention::{Labels, attention};
use super::attention_gather::{Deferred, Gather, attention_gather_deferred, occlusion_gate};
use super::attributes::{Attributes, attributes};
use super::feed_forward::feed_forward;
use super::plane_sweep::Sweep;
use super::small::{self, Candidates, MeanOver, Start};
use super::spgr::{Spgr, spgr_into_on};
use super::{Backend, columns, conv2d, conv3d, join, linear, matching, moves, norm, resize};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{D, DType, Result, Tensor, bail};
use subsplat_kernels::camera::{Camera, NearFar};

/// Sizes of a convolution: stride and zero padding of every axis, px.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvSteps {
    /// Distance between outputs.
    pub stride: usize,
    /// Zeros on either side.
    pub padding: usize,
}

/// A tensor of the network: dimensions, f32 elements in row-major order, and the operations.
///
/// Shapes are those of the functions of the same names in [`crate::network::ops`].
pub trait Array: Clone + std::fmt::Debug {
    /// Returns the dimensions.
    fn dims(&self) -> &[usize];

    /// Returns a parameter of the network on this array's executor. A GPU keeps it there.
    ///
    /// # Errors
    /// Errors of the device.
    fn parameter(&self, parameter: &Tensor) -> Result<Self>;

    /// Returns new data on this array's executor.
    ///
    /// # Errors
    /// A length that differs from the shape; errors of the device.
    fn constant(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self>;

    /// Returns a tensor on this array's executor.
    ///
    /// # Errors
    /// Errors of the device.
    fn like(&self, tensor: &Tensor) -> Result<Self>;

    /// Returns the elements in host memory.
    ///
    /// # Errors
    /// Errors of the device.
    fn to_host(&self) -> Result<Tensor>;

    /// Returns the same values without a gradient.
    #[must_use]
    fn detached(&self) -> Self;

    /// Returns whether a gradient must reach this array.
    fn is_tracked(&self) -> bool;

    /// Returns the same elements under another shape; `()` is the size that fits.
    ///
    /// # Errors
    /// Another number of elements.
    fn reshape<S: ShapeWithOneHole>(&self, shape: S) -> Result<Self>;

    /// Returns `len` indices from `start` on of dimension `dim`.
    ///
    /// # Errors
    /// A range outside the dimension.
    fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self>;

    /// Reorders the dimensions: dimension i of the result is dimension `order[i]`.
    ///
    /// # Errors
    /// `order` is no permutation.
    fn permuted(&self, order: &[usize]) -> Result<Self>;

    /// Returns the given indices of dimension `dim`.
    ///
    /// # Errors
    /// An index outside the dimension.
    fn selected(&self, dim: usize, indices: &[u32]) -> Result<Self>;

    /// Joins arrays along dimension `dim`.
    ///
    /// # Errors
    /// Shapes that differ in another dimension; no array.
    fn joined(parts: &[&Self], dim: usize) -> Result<Self>;

    /// Computes factor·x + offset.
    ///
    /// # Errors
    /// Errors of the executor; so for the following functions, beside shapes that do not fit.
    fn affine(&self, factor: f64, offset: f64) -> Result<Self>;

    /// Computes an activation function.
    fn activated(&self, kind: Activation) -> Result<Self>;

    /// Computes |x|.
    fn absolute(&self) -> Result<Self>;

    /// Computes x².
    fn squared(&self) -> Result<Self>;

    /// Computes 1/x.
    fn reciprocal(&self) -> Result<Self>;

    /// Clamps to [low, high].
    fn clamped(&self, low: f64, high: f64) -> Result<Self>;

    /// Returns x where the element of `other` is above `least`, else `fill`; sizes of 1 of `other`
    /// are repeated.
    fn where_above(&self, other: &Self, least: f64, fill: f64) -> Result<Self>;

    /// Repeats sizes of 1 until the dimensions are `dims`.
    fn expanded(&self, dims: &[usize]) -> Result<Self>;

    /// Computes a + b; sizes of 1 of `other` are repeated.
    fn plus(&self, other: &Self) -> Result<Self>;

    /// Computes [`Array::plus`], then an activation function.
    fn plus_then(&self, other: &Self, activation: Activation) -> Result<Self> {
        self.plus(other)?.activated(activation)
    }

    /// Computes a − b; sizes of 1 of `other` are repeated.
    fn minus(&self, other: &Self) -> Result<Self>;

    /// Computes a·b; sizes of 1 of `other` are repeated.
    fn times(&self, other: &Self) -> Result<Self>;

    /// Computes a/b; sizes of 1 of `other` are repeated.
    fn over(&self, other: &Self) -> Result<Self>;

    /// Sums over dimension `dim`, which disappears.
    fn summed(&self, dim: usize) -> Result<Self>;

    /// Computes the mean over dimension `dim`, which disappears.
    fn averaged(&self, dim: usize) -> Result<Self>;

    /// Returns the largest element along the last dimension, whose size becomes 1.
    fn largest(&self) -> Result<Self>;

    /// Computes Σ_d x·weight of `[R, n, D]` and weights `[R, D]`: `[R, n, 1]`.
    fn weighted_sum(&self, weights: &Self) -> Result<Self>;

    /// Computes the softmax over the last dimension.
    fn softmax(&self) -> Result<Self>;

    /// Computes a convolution over two or three axes, then applies `activation`.
    fn convolved(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        steps: ConvSteps,
        activation: Option<Activation>,
    ) -> Result<Self>;

    /// Computes x·Wᵀ + b of `[N, C]`, then applies `activation`.
    fn projected(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        activation: Option<Activation>,
    ) -> Result<Self>;

    /// Normalises groups of channels of `[B, C, …]`, applies `activation`, then adds `residual`.
    fn group_norm(
        &self,
        groups: usize,
        affine: [&Self; 2],
        activation: Option<Activation>,
        residual: Option<&Self>,
    ) -> Result<Self>;

    /// Normalises each channel of `[B, C, H, W]`, then applies `activation`.
    fn instance_norm(&self, activation: Option<Activation>) -> Result<Self>;

    /// Normalises the last dimension, then adds `residual`.
    fn layer_norm(&self, affine: [&Self; 2], residual: Option<&Self>) -> Result<Self>;

    /// Normalises the last dimension of self + other.
    fn layer_norm_of_sum(&self, other: &Self, affine: [&Self; 2]) -> Result<Self> {
        self.plus(other)?.layer_norm(affine, None)
    }

    /// Resizes `[B, C, h, w]`, corners aligned, then applies `activation`.
    fn resized(&self, size: [usize; 2], activation: Option<Activation>) -> Result<Self>;

    /// Repeats each pixel of `[B, C, h, w]` `s` × `s` times.
    fn repeated(&self, s: usize) -> Result<Self>;

    /// Computes the mean of blocks of `s` × `s` pixels.
    fn pooled(&self, s: usize) -> Result<Self>;

    /// Joins the channels of `[B, C, h, w]` and of `coarse`, each of whose pixels is repeated
    /// `s` × `s` times.
    fn beside(&self, coarse: &Self, s: usize) -> Result<Self>;

    /// Maps `[B, C, …]` to `[B, N, C]`.
    fn channels_last(&self) -> Result<Self>;

    /// Joins the columns of up to three matrices.
    fn columns(&self, second: &Self, third: Option<&Self>) -> Result<Self>;

    /// Computes attention of queries `self` to keys and values.
    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self>;

    /// Computes a feed-forward block of `[N, C]` without a gradient.
    fn feed_forward(&self, message: &Self, weights: [&Self; 2], norm: [&Self; 2]) -> Result<Self>;

    /// Correlates `self` with `source` along `sweep`. `backend` executes it for host tensors.
    fn plane_sweep(&self, source: &Self, sweep: Sweep, backend: &Backend) -> Result<Self>;

    /// Scales the channels of each pixel to unit length.
    fn unit_channels(&self) -> Result<Self>;

    /// Computes the raw matching channels of images `[B, V, 3, H, W]`.
    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self>;

    /// Computes self + 4·factor·scores.
    fn lifted(&self, scores: &Self, factor: &Tensor) -> Result<Self>;

    /// Computes expected candidate and mass around the mode.
    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]>;

    /// Repeats the edge pixels of `[B, C, h, w]` once on every side.
    fn edges_repeated(&self) -> Result<Self>;

    /// Upsamples two maps by the masks `self`.
    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]>;

    /// Computes the heads' input from features `self`.
    fn head_input(&self, rgb: &Self, sides: [&Self; 2], share: f32) -> Result<Self>;

    /// Computes raw rows and opacity from the heads' output `self`.
    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]>;

    /// Computes distances along rays from candidate indices.
    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self>;

    /// Computes opacity factors from images `self` and distances.
    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self>;

    /// Computes the distances that most views support, from images `self`, then distances and
    /// confidences.
    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self>;

    /// Computes the attributes of packed rows `[N, 11]`.
    fn attributes(&self, rules: Attributes) -> Result<Self>;

    /// Computes the attention gather from maps `self`, then adds `residual`; `backend` executes it
    /// for host tensors.
    fn attention_gather(
        &self,
        query: &Self,
        points: &Self,
        gather: Gather,
        deferred: Option<&Deferred>,
        residual: Option<&Self>,
        backend: &Backend,
    ) -> Result<Self>;

    /// Computes the visibility `[N, V]` of points `self` `[N, V, 2]` with camera z `[N, V]` before
    /// the surfaces `depths` `[V, H, W]`, without a gradient.
    fn occlusion(&self, z: &Self, depths: &Self) -> Result<Self>;

    /// Writes the children of head records `self` and `parents` to `rows` and `gains`; `backend`
    /// computes them for host tensors.
    fn write_children(
        &self,
        parents: &Self,
        call: &Spgr,
        backend: &Backend,
        rows: &mut [f32],
        gains: &mut [f32],
    ) -> Result<()>;

    /// Returns the number of elements.
    fn count(&self) -> usize {
        self.dims().iter().product()
    }

    /// Returns the dimensions, of which there must be N.
    ///
    /// # Errors
    /// Another rank.
    fn sizes<const N: usize>(&self) -> Result<[usize; N]> {
        match self.dims().try_into() {
            Ok(sizes) => Ok(sizes),
            Err(_) => bail!("expected {N} dimensions, got {:?}", self.dims()),
        }
    }
}

/// Returns residual + x.
fn onto(residual: Option<&Tensor>, x: Tensor) -> Result<Tensor> {
    match residual {
        Some(residual) => Array::plus(residual, &x),
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

    fn constant(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self> {
        Tensor::from_vec(values, dims, self.device())?.to_dtype(self.dtype())
    }

    fn like(&self, tensor: &Tensor) -> Result<Self> {
        tensor.to_dtype(self.dtype())
    }

    fn to_host(&self) -> Result<Tensor> {
        Ok(self.clone())
    }

    fn detached(&self) -> Self {
        self.detach()
    }

    fn is_tracked(&self) -> bool {
        self.track_op()
    }

    fn reshape<S: ShapeWithOneHole>(&self, shape: S) -> Result<Self> {
        self.reshape(shape)
    }

    fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self> {
        self.narrow(dim, start, len)
    }

    fn permuted(&self, order: &[usize]) -> Result<Self> {
        self.permute(order)?.contiguous()
    }

    fn selected(&self, dim: usize, indices: &[u32]) -> Result<Self> {
        self.index_select(&Tensor::new(indices, self.device())?, dim)
    }

    fn joined(parts: &[&Self], dim: usize) -> Result<Self> {
        match dim {
            0 => moves::stacked(&parts.iter().map(|t| (*t).clone()).collect::<Vec<_>>()),
            _ => Tensor::cat(parts, dim),
        }
    }

    fn affine(&self, factor: f64, offset: f64) -> Result<Self> {
        self.affine(factor, offset)
    }

    fn activated(&self, kind: Activation) -> Result<Self> {
        match (self.dtype(), kind) {
            (DType::F32, _) => pointwise::activation(self, kind),
            (_, Activation::Relu) => self.relu(),
            (_, Activation::Silu) => self.silu(),
            (_, Activation::Gelu) => self.gelu_erf(),
            (_, Activation::Sigmoid) => candle_nn::ops::sigmoid(self),
        }
    }

    fn absolute(&self) -> Result<Self> {
        self.abs()
    }

    fn squared(&self) -> Result<Self> {
        self.sqr()
    }

    fn reciprocal(&self) -> Result<Self> {
        self.recip()
    }

    fn clamped(&self, low: f64, high: f64) -> Result<Self> {
        match high == f64::INFINITY {
            true => self.maximum(low),
            false => self.clamp(low, high),
        }
    }

    fn where_above(&self, other: &Self, least: f64, fill: f64) -> Result<Self> {
        let above = other.gt(least)?.broadcast_as(self.shape())?;
        above.where_cond(self, &self.zeros_like()?.affine(1.0, fill)?)
    }

    fn expanded(&self, dims: &[usize]) -> Result<Self> {
        self.broadcast_as(dims)
    }

    fn plus(&self, other: &Self) -> Result<Self> {
        match self.dims() == other.dims() {
            true => moves::sum(self, other),
            false => self.broadcast_add(other),
        }
    }

    fn minus(&self, other: &Self) -> Result<Self> {
        self.broadcast_sub(other)
    }

    fn times(&self, other: &Self) -> Result<Self> {
        self.broadcast_mul(other)
    }

    fn over(&self, other: &Self) -> Result<Self> {
        self.broadcast_div(other)
    }

    fn summed(&self, dim: usize) -> Result<Self> {
        self.sum(dim)
    }

    fn averaged(&self, dim: usize) -> Result<Self> {
        self.mean(dim)
    }

    fn largest(&self) -> Result<Self> {
        self.max_keepdim(D::Minus1)
    }

    fn weighted_sum(&self, weights: &Self) -> Result<Self> {
        self.matmul(&weights.unsqueeze(2)?)
    }

    fn softmax(&self) -> Result<Self> {
        pointwise::softmax(self)
    }

    fn convolved(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        steps: ConvSteps,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let ConvSteps { stride, padding } = steps;
        let y = match (weight.rank(), stride) {
            (5, 1) => conv3d::conv3d(self, weight, bias, padding)?,
            (5, _) => bail!("conv3d: expected stride 1, got {stride}"),
            _ => conv2d::conv2d(self, weight, bias, stride, padding)?,
        };
        match activation {
            Some(kind) => y.activated(kind),
            None => Ok(y),
        }
    }

    fn projected(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let y = match (bias, self.dtype()) {
            (Some(bias), DType::F32) => linear::linear(self, weight, bias)?,
            (None, DType::F32) => linear::linear_no_bias(self, weight)?,
            (Some(bias), _) => self.matmul(&weight.t()?)?.broadcast_add(bias)?,
            (None, _) => self.matmul(&weight.t()?)?,
        };
        match activation {
            Some(kind) => y.activated(kind),
            None => Ok(y),
        }
    }

    fn group_norm(
        &self,
        groups: usize,
        [weight, bias]: [&Self; 2],
        activation: Option<Activation>,
        residual: Option<&Self>,
    ) -> Result<Self> {
        onto(
            residual,
            norm::group_norm_then(self, groups, norm::Affine { weight, bias }, activation)?,
        )
    }

    fn instance_norm(&self, activation: Option<Activation>) -> Result<Self> {
        norm::instance_norm_then(self, activation)
    }

    fn layer_norm(&self, [weight, bias]: [&Self; 2], residual: Option<&Self>) -> Result<Self> {
        if self.dtype() == DType::F32 {
            return onto(residual, norm::layer_norm(self, weight, bias)?);
        }
        // The fused kernel has f32 only.
        let x = self.broadcast_sub(&self.mean_keepdim(D::Minus1)?)?;
        let variance = x.sqr()?.mean_keepdim(D::Minus1)?;
        let scaled = x.broadcast_div(&(variance + norm::EPS)?.sqrt()?)?.broadcast_mul(weight)?;
        onto(residual, scaled.broadcast_add(bias)?)
    }

    fn resized(&self, [h, w]: [usize; 2], activation: Option<Activation>) -> Result<Self> {
        match activation {
            Some(activation) => resize::resize_bilinear_then(self, h, w, activation),
            None => resize::resize_bilinear(self, h, w),
        }
    }

    fn repeated(&self, s: usize) -> Result<Self> {
        resize::upsample_nearest(self, s)
    }

    fn pooled(&self, s: usize) -> Result<Self> {
        self.avg_pool2d(s)
    }

    fn beside(&self, coarse: &Self, s: usize) -> Result<Self> {
        join::join(self, coarse, s)
    }

    fn channels_last(&self) -> Result<Self> {
        match self.dtype() {
            DType::F32 => moves::channels_last(self),
            _ => self.flatten_from(2)?.transpose(1, 2)?.contiguous(),
        }
    }

    fn columns(&self, second: &Self, third: Option<&Self>) -> Result<Self> {
        columns::columns(self, second, third)
    }

    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self> {
        attention(self, k, v, scale, labels)
    }

    fn feed_forward(&self, message: &Self, weights: [&Self; 2], norm: [&Self; 2]) -> Result<Self> {
        feed_forward(self, message, weights, norm)
    }

    fn plane_sweep(&self, source: &Self, sweep: Sweep, backend: &Backend) -> Result<Self> {
        super::plane_sweep::plane_sweep_on(backend, self, source, sweep)
    }

    fn unit_channels(&self) -> Result<Self> {
        small::unit_channels(self)
    }

    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self> {
        matching::raw_matching(self, cameras, disparities, rows)
    }

    fn lifted(&self, scores: &Self, factor: &Tensor) -> Result<Self> {
        small::lift(self, scores, factor)
    }

    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]> {
        let (mean, mass) = small::expectation(self, window, mean)?;
        Ok([mean, mass])
    }

    fn edges_repeated(&self) -> Result<Self> {
        self.pad_with_same(2, 1, 1)?.pad_with_same(3, 1, 1)
    }

    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]> {
        small::upsample_convex(self, maps, start)
    }

    fn head_input(&self, rgb: &Self, [index, confidence]: [&Self; 2], share: f32) -> Result<Self> {
        small::head_input(self, rgb, index, confidence, share)
    }

    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]> {
        let (raw, density) = small::head_output(self, confidence, rgb, start)?;
        Ok([raw, density])
    }

    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self> {
        small::ray_distance(self, ranges, lengths)
    }

    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self> {
        small::cross_check(self, cameras, distances)
    }

    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self> {
        small::depth_consensus(self, cameras, ranges, depths)
    }

    fn attributes(&self, rules: Attributes) -> Result<Self> {
        attributes(self, rules)
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
        onto(residual, y)
    }

    fn occlusion(&self, z: &Self, depths: &Self) -> Result<Self> {
        occlusion_gate(self, z, depths)
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
