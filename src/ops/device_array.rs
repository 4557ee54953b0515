//! The operations of the network on a GPU ([`Array`] for arrays in device memory).
//!
//! An [`Executor`] keeps the network's parameters on the device. Arrays carry no gradient.

use super::activation::Activation;
use super::array::{Array, ConvSteps};
use super::attention::{Labels, PENALTY};
use super::attention_gather::{Deferred, Gather};
use super::attributes::{Attributes, Frame};
use super::plane_sweep::Sweep;
use super::small::{Candidates, MeanOver, Start};
use super::spgr::{Spgr, finite};
use super::{Backend, matching};
use crate::abi::{AttributesUniform, MuInput, SPLAT_STRIDE};
use crate::camera::Camera;
use crate::cpu::attention_gather::OCCLUSION_TOLERANCE;
use crate::cpu::small::cross_check;
use crate::gpu::{
    self, AttentionCall, ConvolutionCall, CrossCheckCall, Function, GpuError, HeadOutputCall,
    PointwiseFunction, RawMatchingCall, Recorder, Reduction,
};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{DType, Error, Result, Tensor, TensorId, bail};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// A result of a call of the device.
type OnDevice<T> = std::result::Result<T, GpuError>;

/// Passes after whose end an unused parameter leaves the device.
const PASSES_KEPT: u64 = 8;
/// Factor of scores in [`Array::lifted`], as in [`super::small::lift`].
const LIFT_GAIN: f64 = 4.0;

/// A GPU that runs the network, with the network's parameters.
#[derive(Debug)]
pub struct Executor {
    recorder: Arc<Recorder>,
    parameters: Mutex<Parameters>,
    /// The first error of the device since [`Executor::attempt`] began.
    failure: Mutex<Option<GpuError>>,
}

/// Parameters on the device, with the pass that used them last.
#[derive(Debug, Default)]
struct Parameters {
    pass: u64,
    arrays: HashMap<TensorId, (u64, gpu::DeviceArray)>,
}

impl Executor {
    /// Returns an executor on the GPU of `backend`, if it is one.
    pub fn new(backend: &Backend) -> Option<Arc<Self>> {
        let recorder = Recorder::new(backend.gpu()?.clone());
        let (parameters, failure) = (Mutex::default(), Mutex::default());
        Some(Arc::new(Self { recorder, parameters, failure }))
    }

    /// Runs `f`, one pass of the network. `None`: the device failed, and `backend` knows the
    /// reason.
    ///
    /// # Errors
    /// Those of `f` that do not come from the device.
    pub fn attempt<R>(
        &self,
        backend: &Backend,
        f: impl FnOnce() -> Result<R>,
    ) -> Option<Result<R>> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        let result = f();
        let mut parameters = self.parameters.lock().unwrap_or_else(PoisonError::into_inner);
        parameters.pass += 1;
        let now = parameters.pass;
        parameters.arrays.retain(|_, (used, _)| *used + PASSES_KEPT >= now);
        let failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        match (&result, failure) {
            (Err(_), Some(error)) => {
                // A lost device first refuses a command; the loss is the reason.
                let error = self.recorder.gpu().check().err().unwrap_or(error);
                backend.offload(|_| Err::<(), _>(error));
                None
            }
            _ => Some(result),
        }
    }

    /// Returns the recorder of all operations, which counts them.
    pub fn recorder(&self) -> &Arc<Recorder> {
        &self.recorder
    }

    /// Copies `tensor`, f32, to the device.
    ///
    /// # Errors
    /// Another dtype; errors of the device.
    pub fn upload(self: &Arc<Self>, tensor: &Tensor) -> Result<DeviceArray> {
        let values = tensor.flatten_all()?.to_vec1::<f32>()?;
        self.array(self.recorder.upload(&values, tensor.dims()))
    }

    fn array(self: &Arc<Self>, result: OnDevice<gpu::DeviceArray>) -> Result<DeviceArray> {
        let array = self.checked(result)?;
        Ok(DeviceArray { array, executor: self.clone() })
    }

    /// Keeps the first error of the device for [`Executor::attempt`].
    fn checked<R>(&self, result: OnDevice<R>) -> Result<R> {
        result.map_err(|error| {
            let mut failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
            failure.get_or_insert_with(|| error.clone());
            Error::wrap(error)
        })
    }

    /// Returns `parameter` on the device, where it is kept unless its values can change.
    fn parameter(self: &Arc<Self>, parameter: &Tensor) -> Result<DeviceArray> {
        if parameter.track_op() {
            return self.upload(parameter);
        }
        let mut kept = self.parameters.lock().unwrap_or_else(PoisonError::into_inner);
        let now = kept.pass;
        if let Some((used, array)) = kept.arrays.get_mut(&parameter.id()) {
            *used = now;
            return Ok(DeviceArray { array: array.clone(), executor: self.clone() });
        }
        let uploaded = self.upload(parameter)?;
        kept.arrays.insert(parameter.id(), (now, uploaded.array.clone()));
        Ok(uploaded)
    }
}

/// An array in the memory of an [`Executor`]'s GPU.
#[derive(Clone, Debug)]
pub struct DeviceArray {
    array: gpu::DeviceArray,
    executor: Arc<Executor>,
}

impl DeviceArray {
    fn of(&self, result: OnDevice<gpu::DeviceArray>) -> Result<Self> {
        self.executor.array(result)
    }

    fn pair(&self, result: OnDevice<[gpu::DeviceArray; 2]>) -> Result<[Self; 2]> {
        let [first, second] = self.executor.checked(result)?;
        Ok([self.of(Ok(first))?, self.of(Ok(second))?])
    }

    fn map(&self, function: Function) -> Result<Self> {
        self.of(self.array.map(function))
    }

    fn with(&self, other: &Self, function: Function) -> Result<Self> {
        self.of(self.array.with(&other.array, function))
    }

    /// Reduces dimension `dim`, which disappears.
    fn reduced(&self, dim: usize, reduction: Reduction) -> Result<Self> {
        let mut dims = self.dims().to_vec();
        if dim >= dims.len() {
            bail!("reduction: expected a dimension below {}, got {dim}", dims.len());
        }
        dims.remove(dim);
        self.of(self.array.reduced(dim, reduction).and_then(|array| array.reshape(&dims)))
    }
}

fn pointwise(activation: Option<Activation>) -> PointwiseFunction {
    match activation {
        None => PointwiseFunction::None,
        Some(Activation::Relu) => PointwiseFunction::Relu,
        Some(Activation::Silu) => PointwiseFunction::Silu,
        Some(Activation::Gelu) => PointwiseFunction::Gelu,
        Some(Activation::Sigmoid) => PointwiseFunction::Sigmoid,
    }
}

impl Array for DeviceArray {
    fn dims(&self) -> &[usize] {
        self.array.dims()
    }

    fn parameter(&self, parameter: &Tensor) -> Result<Self> {
        self.executor.parameter(parameter)
    }

    fn constant(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self> {
        self.of(self.executor.recorder.upload(&values, dims))
    }

    fn like(&self, tensor: &Tensor) -> Result<Self> {
        self.executor.upload(tensor)
    }

    fn to_host(&self) -> Result<Tensor> {
        let values = self.executor.checked(self.array.to_vec())?;
        Tensor::from_vec(values, self.dims(), &candle_core::Device::Cpu)
    }

    fn detached(&self) -> Self {
        self.clone()
    }

    fn is_tracked(&self) -> bool {
        false
    }

    fn reshape<S: ShapeWithOneHole>(&self, shape: S) -> Result<Self> {
        self.of(self.array.reshape(shape.into_shape(self.array.count())?.dims()))
    }

    fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self> {
        self.of(self.array.narrow(dim, start, len))
    }

    fn permuted(&self, order: &[usize]) -> Result<Self> {
        self.of(self.array.permuted(order))
    }

    fn selected(&self, dim: usize, indices: &[u32]) -> Result<Self> {
        self.of(self.array.selected(dim, indices))
    }

    fn joined(parts: &[&Self], dim: usize) -> Result<Self> {
        match parts.first() {
            Some(first) => {
                let arrays: Vec<_> = parts.iter().map(|part| &part.array).collect();
                first.of(gpu::DeviceArray::joined(&arrays, dim))
            }
            None => bail!("join: expected an array, got none"),
        }
    }

    fn affine(&self, factor: f64, offset: f64) -> Result<Self> {
        self.map(Function::Affine(factor as f32, offset as f32))
    }

    fn activated(&self, kind: Activation) -> Result<Self> {
        self.map(Function::Activation(pointwise(Some(kind))))
    }

    fn absolute(&self) -> Result<Self> {
        self.map(Function::Absolute)
    }

    fn squared(&self) -> Result<Self> {
        self.map(Function::Square)
    }

    fn reciprocal(&self) -> Result<Self> {
        self.map(Function::Reciprocal)
    }

    fn clamped(&self, low: f64, high: f64) -> Result<Self> {
        self.map(Function::Clamp(low as f32, high.min(f64::from(f32::MAX)) as f32))
    }

    fn where_above(&self, other: &Self, least: f64, fill: f64) -> Result<Self> {
        self.with(other, Function::WhereAbove(least as f32, fill as f32))
    }

    fn expanded(&self, dims: &[usize]) -> Result<Self> {
        self.of(self.array.expanded(dims))
    }

    fn plus(&self, other: &Self) -> Result<Self> {
        self.with(other, Function::Plus)
    }

    fn minus(&self, other: &Self) -> Result<Self> {
        self.with(other, Function::Minus)
    }

    fn times(&self, other: &Self) -> Result<Self> {
        self.with(other, Function::Times)
    }

    fn over(&self, other: &Self) -> Result<Self> {
        self.with(other, Function::Over)
    }

    fn summed(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Sum)
    }

    fn averaged(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Mean)
    }

    fn largest(&self) -> Result<Self> {
        let last = self.dims().len().saturating_sub(1);
        self.of(self.array.reduced(last, Reduction::Maximum))
    }

    fn weighted_sum(&self, weights: &Self) -> Result<Self> {
        let [rows, d] = weights.sizes()?;
        let weighted = self.times(&weights.reshape((rows, 1, d))?)?;
        self.of(weighted.array.reduced(2, Reduction::Sum))
    }

    fn softmax(&self) -> Result<Self> {
        self.of(self.array.softmax())
    }

    fn convolved(&self, weight: &Self, bias: Option<&Self>, steps: ConvSteps) -> Result<Self> {
        let ConvSteps { stride, padding } = steps;
        let call = ConvolutionCall { stride, padding };
        self.of(self.array.convolved(&weight.array, bias.map(|bias| &bias.array), call))
    }

    fn projected(&self, weight: &Self, bias: Option<&Self>) -> Result<Self> {
        self.of(self.array.projected(&weight.array, bias.map(|bias| &bias.array)))
    }

    fn group_norm(
        &self,
        groups: usize,
        affine: [&Self; 2],
        activation: Option<Activation>,
    ) -> Result<Self> {
        let affine = affine.map(|a| &a.array);
        self.of(self.array.group_norm(groups, Some(affine), pointwise(activation)))
    }

    fn instance_norm(&self, activation: Option<Activation>) -> Result<Self> {
        let [_, channels, ..] = self.sizes::<4>()?;
        self.of(self.array.group_norm(channels, None, pointwise(activation)))
    }

    fn layer_norm(&self, affine: [&Self; 2]) -> Result<Self> {
        self.of(self.array.layer_norm(affine.map(|a| &a.array)))
    }

    fn resized(&self, size: [usize; 2], activation: Option<Activation>) -> Result<Self> {
        self.of(self.array.resized(size, pointwise(activation)))
    }

    fn repeated(&self, s: usize) -> Result<Self> {
        self.of(self.array.repeated(s))
    }

    fn pooled(&self, s: usize) -> Result<Self> {
        self.of(self.array.pooled(s))
    }

    fn beside(&self, coarse: &Self, s: usize) -> Result<Self> {
        match s {
            1 => Self::joined(&[self, coarse], 1),
            _ => Self::joined(&[self, &coarse.repeated(s)?], 1),
        }
    }

    fn channels_last(&self) -> Result<Self> {
        let (b, c) = match self.dims() {
            &[b, c, ..] => (b, c),
            dims => bail!("transpose: expected [B, C, ..], got {dims:?}"),
        };
        self.reshape((b, c, ()))?.permuted(&[0, 2, 1])
    }

    fn columns(&self, second: &Self, third: Option<&Self>) -> Result<Self> {
        let parts: Vec<_> = [self, second].into_iter().chain(third).collect();
        Self::joined(&parts, 1)
    }

    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self> {
        let labels = labels.as_ref().map(|l| (l.windows, &*l.queries, &*l.keys));
        let call = AttentionCall { scale, penalty: PENALTY, labels };
        self.of(self.array.attention(&k.array, &v.array, call))
    }

    fn feed_forward(
        &self,
        message: &Self,
        [up, down]: [&Self; 2],
        norm: [&Self; 2],
    ) -> Result<Self> {
        let both = Self::joined(&[self, message], 1)?;
        let hidden = both.projected(up, None)?.activated(Activation::Gelu)?;
        self.plus(&hidden.projected(down, None)?.layer_norm(norm)?)
    }

    fn plane_sweep(&self, source: &Self, sweep: Sweep, _backend: &Backend) -> Result<Self> {
        self.of(self.array.plane_sweep(&source.array, &sweep))
    }

    fn unit_channels(&self) -> Result<Self> {
        // The added 1e-8 is that of `cpu::small::unit`.
        let squares = self.squared()?;
        let sum = self.of(squares.array.reduced(1, Reduction::Sum))?.affine(1.0, 1e-8)?;
        self.over(&self.of(sum.array.map(Function::SquareRoot))?)
    }

    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self> {
        let [_, v, _, h, w] = self.sizes()?;
        let warps = matching::warp_floats(cameras, rows, [h / 4, w / 4], v);
        let candidates = rows.iter().flat_map(|[i, _]| &disparities[i / v][i % v]);
        let call = RawMatchingCall {
            rows: &rows.iter().map(|row| row.map(|i| i as u32)).collect::<Vec<_>>(),
            warps: &warps,
            disparities: &candidates.copied().collect::<Vec<_>>(),
            z_min: matching::Z_MIN,
            variance_floor: matching::VARIANCE_FLOOR,
        };
        self.of(self.array.raw_matching(call))
    }

    fn lifted(&self, scores: &Self, factor: &Tensor) -> Result<Self> {
        let factor = f64::from(factor.sum_all()?.to_dtype(DType::F32)?.to_scalar::<f32>()?);
        self.plus(&scores.affine(LIFT_GAIN * factor, 0.0)?)
    }

    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]> {
        self.pair(self.array.expectation(window, mean == MeanOver::Window))
    }

    fn edges_repeated(&self) -> Result<Self> {
        let [_, _, h, w] = self.sizes()?;
        let indices = |n: usize| {
            (0..n + 2).map(|i| i.saturating_sub(1).min(n - 1) as u32).collect::<Vec<_>>()
        };
        self.selected(2, &indices(h))?.selected(3, &indices(w))
    }

    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]> {
        let start: Vec<f32> = start.iter().map(|share| share.ln()).collect();
        self.pair(self.array.upsample_convex(maps.map(|map| &map.array), &start))
    }

    fn head_input(&self, rgb: &Self, [index, confidence]: [&Self; 2], share: f32) -> Result<Self> {
        let [_, _, h, w] = rgb.sizes()?;
        let features = self.resized([h, w], None)?;
        let index = index.affine(f64::from(share), 0.0)?;
        let confidence = confidence.activated(Activation::Sigmoid)?;
        Self::joined(&[&features, rgb, &index, &confidence], 1)
    }

    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]> {
        let Start { row, colour, confident } = start;
        let call = HeadOutputCall { start: &row, colour, confident };
        self.pair(self.array.head_output(&confidence.array, &rgb.array, call))
    }

    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self> {
        let rows = ranges.len();
        let per_row = |f: fn(&Candidates) -> f32| {
            self.constant(ranges.iter().map(f).collect(), &[rows, 1, 1, 1])
        };
        let disparity = self.times(&per_row(|r| r.step)?)?.plus(&per_row(|r| r.low)?)?;
        self.constant(lengths, self.dims())?.over(&disparity)
    }

    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self> {
        let floats = |camera: &Camera| -> Vec<f32> {
            let (r, p, k) = (camera.rotation(), camera.position(), camera.intrinsics);
            let row = |i: usize| [r.row(i).x, r.row(i).y, r.row(i).z, p[i]];
            [row(0), row(1), row(2), [k.fx, k.fy, k.cx, k.cy]].concat()
        };
        let call = CrossCheckCall {
            views: cameras.first().map_or(0, Vec::len),
            cameras: &cameras.iter().flatten().flat_map(floats).collect::<Vec<_>>(),
            least: cross_check::MIN_FACTOR,
            colour: cross_check::COLOUR,
            behind: cross_check::BEHIND,
        };
        self.of(self.array.cross_check(&distances.array, call))
    }

    fn attributes(&self, rules: Attributes) -> Result<Self> {
        self.of(self.array.attributes(attributes_uniform(&rules)))
    }

    fn attention_gather(
        &self,
        query: &Self,
        points: &Self,
        gather: Gather,
        _deferred: Option<&Deferred>,
        _backend: &Backend,
    ) -> Result<Self> {
        self.of(self.array.gather(&query.array, &points.array, &gather))
    }

    fn occlusion(&self, z: &Self, depths: &Self) -> Result<Self> {
        self.of(self.array.occlusion(&z.array, &depths.array, OCCLUSION_TOLERANCE))
    }

    fn write_children(
        &self,
        parents: &Self,
        call: &Spgr,
        _backend: &Backend,
        rows: &mut [f32],
        gains: &mut [f32],
    ) -> Result<()> {
        let k = call.rules.children();
        let n = parents.count() / SPLAT_STRIDE;
        let expected = [n * k * SPLAT_STRIDE, n * k * call.rules.gain_channels()];
        if [rows.len(), gains.len()] != expected {
            let got = [rows.len(), gains.len()];
            bail!("spgr: expected buffers of {expected:?} floats, got {got:?}");
        }
        let made = self.array.spgr(&parents.array, &call.on_gpu(&[], &[]));
        let host = |array: &gpu::DeviceArray| self.executor.checked(array.to_vec());
        for (to, from) in [&mut *rows, &mut *gains].into_iter().zip(self.executor.checked(made)?) {
            to.copy_from_slice(&host(&from)?);
        }
        if rows.iter().chain(&*gains).any(|v| !v.is_finite()) {
            finite(call, &host(&self.array)?, &host(&parents.array)?, rows, gains)?;
        }
        Ok(())
    }
}

/// `rules` as the kernel reads them.
fn attributes_uniform(rules: &Attributes) -> AttributesUniform {
    let rows = |frame: &Frame| -> [[f32; 4]; 3] {
        std::array::from_fn(|i| {
            let [x, y, z] = frame.rotation[i];
            [x, y, z, frame.position[i]].map(|v| v as f32)
        })
    };
    let frame = rules.frame.unwrap_or(rules.source);
    AttributesUniform {
        frame: rows(&frame),
        turn: frame.turn.map(|row| row.map(|v| v as f32)),
        source: rows(&rules.source),
        parents: 0,
        framed: u32::from(rules.frame.is_some()),
        ray: u32::from(rules.position == MuInput::RayLogz),
        log_px: u32::from(rules.log_px.is_some()),
        logit: u32::from(rules.logit.is_some()),
        log_focal: rules.log_px.map_or(0.0, |focal| focal.ln() as f32),
        logit_low: rules.logit.map_or(0.0, |most| (1.0 / (1.0 + most.exp())) as f32),
        z_min: rules.z_min as f32,
        slope_max: rules.slope_max as f32,
        scale_min: rules.scale_min as f32,
        ..AttributesUniform::default()
    }
}
