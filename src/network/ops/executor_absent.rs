//! The executor of a build without the feature `gpu`: types without values, so that the code of
//! GPUs is written once. [`Executor::new`] returns none.

use super::activation::Activation;
use super::adapter::Adapter;
use super::attention::Labels;
use super::attention_gather::{Deferred, Gather};
use super::attributes::Attributes;
use super::device::{ColourLayout, DeviceSplats, ParameterStep, SharedStep};
use super::plane_sweep::Sweep;
use super::small::{Candidates, MeanOver, SmallArray, Start};
use super::spgr::Spgr;
use super::{Array, Backend, ConvConfig};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{Result, Tensor, bail};
use std::ops::Range;
use std::sync::Arc;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::layout::RasterOptions;

/// No value.
#[derive(Clone, Debug)]
enum Never {}

/// A GPU that runs the network: none.
#[derive(Debug)]
pub struct Executor(Never);

/// An array in the memory of a GPU: none.
#[derive(Clone, Debug)]
pub struct TapeArray(Never);

/// Gradients of the leaves of a tape: none.
#[derive(Debug)]
pub struct DeviceGradients(Never);

/// Parameters in training in device memory: none.
#[derive(Debug)]
pub struct DeviceAdam(Never);

impl Executor {
    /// Returns none: the build has no GPU.
    pub fn new(_: &Backend) -> Option<Arc<Self>> {
        None
    }

    /// Runs one pass of the network.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn attempt<R, E>(
        &self,
        _: &Backend,
        _: impl FnOnce() -> std::result::Result<R, E>,
    ) -> Option<std::result::Result<R, E>> {
        match self.0 {}
    }

    /// Copies a tensor to the device.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn upload(self: &Arc<Self>, _: &Tensor) -> Result<TapeArray> {
        match self.0 {}
    }

    /// Keeps parameters in training on the device.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn keep_trained(&self, _: &[(Tensor, TapeArray)]) -> Result<()> {
        match self.0 {}
    }

    /// Copies arrays to host memory.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn read(&self, _: &[&TapeArray]) -> Result<Vec<Tensor>> {
        match self.0 {}
    }

    /// Waits for the device.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn finish(&self) -> Result<()> {
        match self.0 {}
    }

    /// Renders Gaussians.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn rasterize(
        self: &Arc<Self>,
        _: &[DeviceSplats],
        _: usize,
        _: &Camera,
        _: &RasterOptions,
    ) -> Result<Tensor> {
        match self.0 {}
    }

    /// Computes the gradients of all leaves.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn backward(self: &Arc<Self>, _: &[(&TapeArray, &TapeArray)]) -> Result<DeviceGradients> {
        match self.0 {}
    }
}

impl TapeArray {
    /// Places primaries.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn placed(&self, _: &Self, _: &Self, _: &Adapter) -> Result<Self> {
        match self.0 {}
    }

    /// Turns SH of primaries.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn placed_colours(&self, _: &Adapter, _: ColourLayout) -> Result<Self> {
        match self.0 {}
    }

    /// Computes children and gains.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn children(&self, _: &Self, _: &Spgr) -> Result<[Self; 2]> {
        match self.0 {}
    }

    /// Propagates the gradients of children.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn children_backward(
        &self,
        _: &Self,
        _: &Spgr,
        _: [Vec<f32>; 2],
    ) -> Result<DeviceGradients> {
        match self.0 {}
    }

    /// Returns the executor of the array.
    pub fn executor(&self) -> &Arc<Executor> {
        match self.0 {}
    }

    /// Returns the elements as a leaf of a tape.
    #[must_use]
    pub fn leaf(&self) -> Self {
        match self.0 {}
    }
}

impl DeviceGradients {
    /// Returns the gradient of a leaf.
    pub fn of(&self, _: &TapeArray) -> Option<TapeArray> {
        match self.0 {}
    }

    /// Returns scalars that continue candle's backward pass.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn scalars(&self) -> Result<Vec<Tensor>> {
        match self.0 {}
    }
}

impl DeviceAdam {
    /// Copies values and moments to the device.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn new(executor: &Arc<Executor>, _: Vec<Range<usize>>, _: [&[f32]; 4]) -> Result<Self> {
        match executor.0 {}
    }

    /// Returns a parameter.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn value(&self, _: usize, _: &[usize]) -> Result<TapeArray> {
        match self.0 {}
    }

    /// Computes the norm of gradients.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn norm(&self, _: &[f32]) -> Result<f64> {
        match self.0 {}
    }

    /// Makes a step.
    ///
    /// # Errors
    /// None: there is no value.
    pub fn step(
        &self,
        _: &[f32],
        _: SharedStep,
        _: &[Option<ParameterStep>],
    ) -> Result<[Vec<f32>; 4]> {
        match self.0 {}
    }
}

impl Array for TapeArray {
    fn dims(&self) -> &[usize] {
        match self.0 {}
    }
    fn parameter(&self, _: &Tensor) -> Result<Self> {
        match self.0 {}
    }
    fn new_tensor(&self, _: Vec<f32>, _: &[usize]) -> Result<Self> {
        match self.0 {}
    }
    fn upload(&self, _: &Tensor) -> Result<Self> {
        match self.0 {}
    }
    fn to_host(&self) -> Result<Tensor> {
        match self.0 {}
    }
    fn detach(&self) -> Self {
        match self.0 {}
    }
    fn track_op(&self) -> bool {
        match self.0 {}
    }
    fn reshape<S: ShapeWithOneHole>(&self, _: S) -> Result<Self> {
        match self.0 {}
    }
    fn narrow(&self, _: usize, _: usize, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn permute(&self, _: &[usize]) -> Result<Self> {
        match self.0 {}
    }
    fn index_select(&self, _: &[u32], _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn broadcast_as(&self, _: &[usize]) -> Result<Self> {
        match self.0 {}
    }
    fn channels_last(&self) -> Result<Self> {
        match self.0 {}
    }
    fn cat(parts: &[&Self], dim: usize) -> Result<Self> {
        bail!("cat: expected arrays, got {} on no device, dimension {dim}", parts.len())
    }
    fn cat_upsampled(&self, _: &Self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn cat_columns(&self, _: &Self, _: Option<&Self>) -> Result<Self> {
        match self.0 {}
    }
    fn affine(&self, _: f64, _: f64) -> Result<Self> {
        match self.0 {}
    }
    fn abs(&self) -> Result<Self> {
        match self.0 {}
    }
    fn sqr(&self) -> Result<Self> {
        match self.0 {}
    }
    fn recip(&self) -> Result<Self> {
        match self.0 {}
    }
    fn clamp(&self, _: f64, _: f64) -> Result<Self> {
        match self.0 {}
    }
    fn where_gt(&self, _: &Self, _: f64, _: f64) -> Result<Self> {
        match self.0 {}
    }
    fn activate(&self, _: Activation) -> Result<Self> {
        match self.0 {}
    }
    fn add(&self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn sub(&self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn mul(&self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn div(&self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn sum(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn mean(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn max_keepdim(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn weighted_sum(&self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn softmax(&self) -> Result<Self> {
        match self.0 {}
    }
    fn conv2d(
        &self,
        _: &Self,
        _: Option<&Self>,
        _: ConvConfig,
        _: Option<Activation>,
    ) -> Result<Self> {
        match self.0 {}
    }
    fn conv3d(
        &self,
        _: &Self,
        _: Option<&Self>,
        _: ConvConfig,
        _: Option<Activation>,
    ) -> Result<Self> {
        match self.0 {}
    }
    fn linear(&self, _: &Self, _: Option<&Self>, _: Option<Activation>) -> Result<Self> {
        match self.0 {}
    }
    fn group_norm(
        &self,
        _: usize,
        _: [&Self; 2],
        _: Option<Activation>,
        _: Option<&Self>,
    ) -> Result<Self> {
        match self.0 {}
    }
    fn instance_norm(&self, _: Option<Activation>) -> Result<Self> {
        match self.0 {}
    }
    fn layer_norm(&self, _: [&Self; 2], _: Option<&Self>) -> Result<Self> {
        match self.0 {}
    }
    fn upsample_bilinear2d(&self, _: [usize; 2], _: Option<Activation>) -> Result<Self> {
        match self.0 {}
    }
    fn upsample_nearest2d(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn avg_pool2d(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn attention(&self, _: &Self, _: &Self, _: f32, _: Option<Labels>) -> Result<Self> {
        match self.0 {}
    }
    fn feed_forward(&self, _: &Self, _: [&Self; 2], _: [&Self; 2]) -> Result<Self> {
        match self.0 {}
    }
    fn plane_sweep(&self, _: &Self, _: Sweep, _: &Backend) -> Result<Self> {
        match self.0 {}
    }
    fn attention_gather(
        &self,
        _: &Self,
        _: &Self,
        _: Gather,
        _: Option<&Deferred>,
        _: Option<&Self>,
        _: &Backend,
    ) -> Result<Self> {
        match self.0 {}
    }
    fn occlusion_gate(&self, _: &Self, _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn attributes(&self, _: Attributes) -> Result<Self> {
        match self.0 {}
    }
    fn write_children(
        &self,
        _: &Self,
        _: &Spgr,
        _: &Backend,
        _: &mut [f32],
        _: &mut [f32],
    ) -> Result<()> {
        match self.0 {}
    }
}

impl SmallArray for TapeArray {
    fn normalize_channels(&self) -> Result<Self> {
        match self.0 {}
    }
    fn raw_matching(
        &self,
        _: &[Vec<Camera>],
        _: &[Vec<Vec<f32>>],
        _: &[[usize; 2]],
    ) -> Result<Self> {
        match self.0 {}
    }
    fn add_scores(&self, _: &Self, _: &Tensor) -> Result<Self> {
        match self.0 {}
    }
    fn expectation(&self, _: usize, _: MeanOver) -> Result<[Self; 2]> {
        match self.0 {}
    }
    fn replication_pad2d(&self, _: usize) -> Result<Self> {
        match self.0 {}
    }
    fn upsample_convex(&self, _: [&Self; 2], _: &[f32]) -> Result<[Self; 2]> {
        match self.0 {}
    }
    fn head_input(&self, _: &Self, _: [&Self; 2], _: f32) -> Result<Self> {
        match self.0 {}
    }
    fn head_output(&self, _: &Self, _: &Self, _: Start) -> Result<[Self; 2]> {
        match self.0 {}
    }
    fn ray_distance(&self, _: Vec<Candidates>, _: Vec<f32>) -> Result<Self> {
        match self.0 {}
    }
    fn cross_check(&self, _: &[Vec<Camera>], _: &Self) -> Result<Self> {
        match self.0 {}
    }
    fn depth_consensus(
        &self,
        _: &[Vec<Camera>],
        _: &[Vec<NearFar>],
        _: [&Self; 2],
    ) -> Result<Self> {
        match self.0 {}
    }
}
