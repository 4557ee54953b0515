//! The operations of the network, on either executor.
//!
//! The modules of [`crate::network::model`] are written once, over [`Array`]. `candle_core::Tensor`
//! implements it with the CPU kernels and their gradients (`tensor.rs`); `TapeArray` implements it
//! with WGSL kernels over buffers that stay on a GPU, and a tape of its own (`ops/executor/`). The
//! small backbone's own operations are in [`crate::network::ops::small::SmallArray`].
//!
//! Names are those of candle or PyTorch. On a `Tensor`, candle's inherent method of the same name
//! takes precedence over the trait's (`x.add(y)` does not broadcast there, `x.permute(..)` is not
//! contiguous); `Array::add(x, y)` calls the trait's.

mod tensor;

use super::Backend;
use super::activation::Activation;
use super::attention::Labels;
use super::attention_gather::{Deferred, Gather};
use super::attributes::Attributes;
use super::plane_sweep::Sweep;
use super::spgr::Spgr;
use candle_core::shape::ShapeWithOneHole;
use candle_core::{Result, Tensor, bail};

/// Stride and zero padding of a convolution, the same for every axis, px.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvConfig {
    /// Distance between outputs.
    pub stride: usize,
    /// Zeros on either side.
    pub padding: usize,
}

/// A tensor of the network: dimensions, f32 elements in row-major order, and the operations.
///
/// Operations on more than one array repeat sizes of 1 of the second where they say so. Errors are
/// those of the executor, and shapes that do not fit.
pub trait Array: Clone + std::fmt::Debug {
    // Executors and memory.

    /// Returns the dimensions.
    fn dims(&self) -> &[usize];

    /// Returns the dimensions, of which there must be N.
    ///
    /// # Errors
    /// Another rank.
    fn sizes<const N: usize>(&self) -> Result<[usize; N]> {
        let Ok(sizes) = self.dims().try_into() else {
            bail!("expected {N} dimensions, got {:?}", self.dims())
        };
        Ok(sizes)
    }

    /// Returns the number of elements.
    fn elem_count(&self) -> usize {
        self.dims().iter().product()
    }

    /// Returns a parameter of the network on this array's executor. A GPU keeps it there.
    ///
    /// # Errors
    /// Errors of the device.
    fn parameter(&self, parameter: &Tensor) -> Result<Self>;

    /// Returns an array of new data on this array's executor.
    ///
    /// # Errors
    /// A length that differs from the shape; errors of the device.
    fn new_tensor(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self>;

    /// Copies a tensor to this array's executor, in this array's dtype.
    ///
    /// # Errors
    /// Errors of the device.
    fn upload(&self, tensor: &Tensor) -> Result<Self>;

    /// Returns the elements in host memory.
    ///
    /// # Errors
    /// Errors of the device.
    fn to_host(&self) -> Result<Tensor>;

    // Gradients.

    /// Returns the same values without a gradient.
    #[must_use]
    fn detach(&self) -> Self;

    /// Returns whether a gradient must reach this array.
    fn track_op(&self) -> bool;

    // Shapes, parts and orders.

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

    /// Reorders the dimensions: dimension i of the result is dimension `order[i]`. The result is
    /// contiguous.
    ///
    /// # Errors
    /// `order` is no permutation.
    fn permute(&self, order: &[usize]) -> Result<Self>;

    /// Returns the given indices of dimension `dim`.
    ///
    /// # Errors
    /// An index outside the dimension.
    fn index_select(&self, indices: &[u32], dim: usize) -> Result<Self>;

    /// Repeats sizes of 1 until the dimensions are `dims`.
    fn broadcast_as(&self, dims: &[usize]) -> Result<Self>;

    /// Maps `[B, C, …]` to `[B, N, C]`.
    fn channels_last(&self) -> Result<Self>;

    /// Concatenates arrays along dimension `dim`.
    ///
    /// # Errors
    /// Shapes that differ in another dimension; no array.
    fn cat(parts: &[&Self], dim: usize) -> Result<Self>;

    /// Concatenates the channels of `[B, C, h, w]` and of `other` `[B, C', h, w]`.
    fn cat_channels(&self, other: &Self) -> Result<Self> {
        self.cat_upsampled(other, 1)
    }

    /// Concatenates the channels of `[B, C, h, w]` and of `coarse` `[B, C', h/scale, w/scale]`, each
    /// of whose pixels is repeated `scale` × `scale` times.
    fn cat_upsampled(&self, coarse: &Self, scale: usize) -> Result<Self>;

    /// Concatenates the columns of two or three matrices.
    fn cat_columns(&self, second: &Self, third: Option<&Self>) -> Result<Self>;

    // Elementwise functions.

    /// Computes factor·x + offset.
    fn affine(&self, factor: f64, offset: f64) -> Result<Self>;

    /// Computes |x|.
    fn abs(&self) -> Result<Self>;

    /// Computes x².
    fn sqr(&self) -> Result<Self>;

    /// Computes 1/x.
    fn recip(&self) -> Result<Self>;

    /// Clamps to [min, max]; `max` may be infinite.
    fn clamp(&self, min: f64, max: f64) -> Result<Self>;

    /// Returns x where the element of `other` is greater than `threshold`, else `fill`; sizes of 1
    /// of `other` are repeated.
    fn where_gt(&self, other: &Self, threshold: f64, fill: f64) -> Result<Self>;

    /// Computes an activation function.
    fn activate(&self, kind: Activation) -> Result<Self>;

    /// Computes a + b; sizes of 1 of `other` are repeated.
    fn add(&self, other: &Self) -> Result<Self>;

    /// Computes [`Array::add`], then an activation function.
    fn add_activation(&self, other: &Self, activation: Activation) -> Result<Self> {
        self.add(other)?.activate(activation)
    }

    /// Computes a − b; sizes of 1 of `other` are repeated.
    fn sub(&self, other: &Self) -> Result<Self>;

    /// Computes a·b; sizes of 1 of `other` are repeated.
    fn mul(&self, other: &Self) -> Result<Self>;

    /// Computes a/b; sizes of 1 of `other` are repeated.
    fn div(&self, other: &Self) -> Result<Self>;

    // Reductions.

    /// Sums over dimension `dim`, which disappears.
    fn sum(&self, dim: usize) -> Result<Self>;

    /// Computes the mean over dimension `dim`, which disappears.
    fn mean(&self, dim: usize) -> Result<Self>;

    /// Returns the largest element along dimension `dim`, whose size becomes 1.
    fn max_keepdim(&self, dim: usize) -> Result<Self>;

    /// Computes Σ_d x·weight of `[R, n, D]` and weights `[R, D]`: `[R, n, 1]`.
    fn weighted_sum(&self, weights: &Self) -> Result<Self>;

    /// Computes the softmax over the last dimension.
    fn softmax(&self) -> Result<Self>;

    // Layers.

    /// Computes a convolution of `[B, C, H, W]` by `weight` `[O, C, k, k]`, adds `bias` `[O]`, then
    /// applies `activation`.
    fn conv2d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        config: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self>;

    /// Computes a convolution of `[B, C, D, H, W]` by `weight` `[O, C, k, k, k]`, as
    /// [`Array::conv2d`]. Its stride is 1.
    fn conv3d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        config: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self>;

    /// Computes x·Wᵀ + b of `[N, C]`, then applies `activation`.
    fn linear(
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
    fn add_layer_norm(&self, other: &Self, affine: [&Self; 2]) -> Result<Self> {
        self.add(other)?.layer_norm(affine, None)
    }

    /// Resizes `[B, C, h, w]` bilinearly, corners aligned, then applies `activation`.
    fn upsample_bilinear2d(&self, size: [usize; 2], activation: Option<Activation>)
    -> Result<Self>;

    /// Repeats each pixel of `[B, C, h, w]` `scale` × `scale` times.
    fn upsample_nearest2d(&self, scale: usize) -> Result<Self>;

    /// Computes the mean of blocks of `size` × `size` pixels.
    fn avg_pool2d(&self, size: usize) -> Result<Self>;

    /// Computes attention of queries `self` to keys and values.
    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self>;

    /// Computes a feed-forward block of `[N, C]` without a gradient.
    fn feed_forward(&self, message: &Self, weights: [&Self; 2], norm: [&Self; 2]) -> Result<Self>;

    // Views and children.

    /// Correlates `self` with `source` along `sweep`. `backend` executes it for host tensors.
    fn plane_sweep(&self, source: &Self, sweep: Sweep, backend: &Backend) -> Result<Self>;

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
    fn occlusion_gate(&self, z: &Self, depths: &Self) -> Result<Self>;

    /// Computes the attributes of packed rows `[N, 11]`.
    fn attributes(&self, rules: Attributes) -> Result<Self>;

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
}
