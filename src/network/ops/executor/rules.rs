//! Rules of gradients that several operations share, arguments of kernels, and the gradient of the
//! children.
//!
//! A rule reuses forward kernels where the gradient is the same operation: a convolution's input gradient
//! is a convolution with the mirrored weight, a linear layer's one with the transposed weight.
//! Gradients of parameters are sums of parts whose number depends on sizes alone. A rule that leaves out
//! the gradient of a tracked input ends the pass with an error that names it.

use super::{DeviceGradients, OnDevice, TapeArray};
use crate::network::ops::Array;
use crate::network::ops::activation::Activation;
use crate::network::ops::attention::{Labels, PENALTY};
use crate::network::ops::attributes::{Attributes, Frame};
use crate::network::ops::spgr::Spgr;
use candle_core::{Result, bail};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::uniforms::AttributesUniform;
use subsplat_kernels::gpu::{AttentionCall, Function, PointwiseFunction, Reduction};
use subsplat_kernels::layout::MuInput;

/// Computes a gradient if it is wanted.
pub(super) fn wanted(
    wanted: bool,
    gradient: impl FnOnce() -> OnDevice<gpu::Array>,
) -> OnDevice<Option<gpu::Array>> {
    wanted.then(gradient).transpose()
}

/// Returns factor·x.
pub(super) fn scaled(x: &gpu::Array, factor: f32) -> OnDevice<gpu::Array> {
    x.map(Function::Affine(factor, 0.0))
}

/// Returns 16 floats for each camera ([`gpu::CrossCheckCall::cameras`]).
pub(super) fn camera_floats(cameras: &[Vec<Camera>]) -> Vec<f32> {
    let floats = |camera: &Camera| -> Vec<f32> {
        let (r, p, k) = (camera.rotation(), camera.position(), camera.intrinsics());
        let row = |i: usize| [r.row(i).x, r.row(i).y, r.row(i).z, p[i]];
        [row(0), row(1), row(2), [k.fx, k.fy, k.cx, k.cy]].concat()
    };
    cameras.iter().flatten().flat_map(floats).collect()
}

impl TapeArray {
    pub(super) fn of(&self, result: OnDevice<gpu::Array>) -> Result<Self> {
        self.executor.array(result)
    }

    /// Records a convolution or a linear layer, which `compute` returns with an activation function, with
    /// the gradients of input, weight and bias. A gradient needs the value before the activation, which is
    /// then an operation of its own.
    pub(super) fn product(
        &self,
        name: &'static str,
        (weight, bias): (&Self, Option<&Self>),
        rules: ProductRules,
        activation: Option<Activation>,
        compute: impl FnOnce(PointwiseFunction) -> OnDevice<gpu::Array>,
    ) -> Result<Self> {
        // Without a bias, an array without a node takes its place.
        let none = weight.detach();
        let bias = bias.unwrap_or(&none);
        let tracked = [self, weight, bias].into_iter().any(Self::track_op);
        let (within, after) = if tracked { (None, activation) } else { (activation, None) };
        let result = compute(pointwise(within));
        let ProductRules { input, weight: of_weight, channel } = rules;
        let product = self.recorded(name, result, [self, weight, bias], |want, _| {
            let (x, w) = (self.array.clone(), weight.array.clone());
            let bias_dims = bias.array.dims().to_vec();
            move |dy| {
                let of_bias = || {
                    let mut dims = vec![1; dy.dims().len()];
                    dims[channel] = dy.dims()[channel];
                    dy.sum_to(&dims)?.reshape(&bias_dims)
                };
                Ok([
                    wanted(want[0], || input(dy, &x, &w))?,
                    wanted(want[1], || of_weight(dy, &x, &w))?,
                    wanted(want[2], of_bias)?,
                ])
            }
        })?;
        match after {
            Some(kind) => product.activate(kind),
            None => Ok(product),
        }
    }

    /// Records a norm with factors and summands, to which a residual is added. `rule` makes the rule of the
    /// gradients of input, factors and summands; that of the residual is the result's.
    pub(super) fn normalised<R>(
        &self,
        name: &'static str,
        result: OnDevice<gpu::Array>,
        [factors, summands]: [&Self; 2],
        residual: Option<&Self>,
        rule: impl FnOnce() -> R,
    ) -> Result<Self>
    where
        R: FnOnce(&gpu::Array) -> OnDevice<[gpu::Array; 3]> + Send + Sync + 'static,
    {
        // Without a residual, an array without a node takes its place.
        let none = self.detach();
        let inputs = [self, factors, summands, residual.unwrap_or(&none)];
        self.recorded(name, result, inputs, |want, _| {
            let rule = rule();
            move |dy| {
                let [dx, of_factors, of_summands] = if want[..3].contains(&true) {
                    rule(dy)?.map(Some)
                } else {
                    [None, None, None]
                };
                Ok([
                    dx.filter(|_| want[0]),
                    of_factors.filter(|_| want[1]),
                    of_summands.filter(|_| want[2]),
                    want[3].then(|| dy.clone()),
                ])
            }
        })
    }

    /// Sums or averages over dimension `dim`, which disappears.
    pub(super) fn reduced(&self, dim: usize, reduction: Reduction) -> Result<Self> {
        let mut dims = self.dims().to_vec();
        if dim >= dims.len() {
            bail!("reduction: expected a dimension below {}, got {dim}", dims.len());
        }
        let length = dims.remove(dim);
        let result = self.array.reduced(dim, reduction).and_then(|array| array.reshape(&dims));
        self.recorded_alone("reduction", result, |x, _| {
            let whole = x.dims().to_vec();
            move |dy| {
                let mut kept = whole.clone();
                kept[dim] = 1;
                let dy = match reduction {
                    Reduction::Mean => scaled(dy, 1.0 / length as f32)?,
                    Reduction::Sum | Reduction::Maximum => dy.clone(),
                };
                dy.reshape(&kept)?.expanded(&whole)
            }
        })
    }

    /// Propagates the gradients of children, `rows` `[N·K·11]` and their gains, to the leaves of
    /// head records `[N, K, 11]`, this array, and of `parents` `[N, 11]`.
    ///
    /// # Errors
    /// Lengths that do not fit; those of [`super::Executor::backward`].
    pub fn children_backward(
        &self,
        parents: &Self,
        call: &Spgr,
        [rows, gains]: [Vec<f32>; 2],
    ) -> Result<DeviceGradients> {
        let upload = |values: Vec<f32>| {
            let dims = [values.len()];
            self.new_tensor(values, &dims)
        };
        let (rows, gains) = (upload(rows)?, upload(gains)?);
        let args = call.on_gpu(&[], &[]);
        let made = self.array.spgr_backward(&parents.array, &args, [&rows.array, &gains.array]);
        let [of_head, of_parents] = self.executor.checked(made)?;
        let (of_head, of_parents) = (self.of(Ok(of_head))?, self.of(Ok(of_parents))?);
        self.executor.backward(&[(self, &of_head), (parents, &of_parents)])
    }

    /// Divides the first dimension, of size 2.
    pub(super) fn halves(&self, dims: &[usize]) -> Result<[Self; 2]> {
        Ok([self.narrow(0, 0, 1)?.reshape(dims)?, self.narrow(0, 1, 1)?.reshape(dims)?])
    }

    /// Computes √x.
    pub(super) fn sqrt(&self) -> Result<Self> {
        self.recorded_alone("square root", self.array.map(Function::SquareRoot), |_, y| {
            let y = y.clone();
            move |dy| scaled(&dy.with(&y, Function::Over)?, 0.5)
        })
    }
}

/// Computes a gradient of a product from the gradient of the result, the input and the weight.
pub(super) type ProductRule =
    Box<dyn FnOnce(&gpu::Array, &gpu::Array, &gpu::Array) -> OnDevice<gpu::Array> + Send + Sync>;

/// Gradients of a convolution or a linear layer.
pub(super) struct ProductRules {
    pub(super) input: ProductRule,
    pub(super) weight: ProductRule,
    /// Dimension of the outputs in the result.
    pub(super) channel: usize,
}

pub(super) fn pointwise(activation: Option<Activation>) -> PointwiseFunction {
    match activation {
        None => PointwiseFunction::None,
        Some(Activation::Relu) => PointwiseFunction::Relu,
        Some(Activation::Silu) => PointwiseFunction::Silu,
        Some(Activation::Gelu) => PointwiseFunction::Gelu,
        Some(Activation::Sigmoid) => PointwiseFunction::Sigmoid,
    }
}

pub(super) fn attention_call(scale: f32, labels: &Option<Labels>) -> AttentionCall<'_> {
    let labels = labels.as_ref().map(|l| (l.windows, &*l.queries, &*l.keys));
    AttentionCall { scale, penalty: PENALTY, labels }
}

/// `rules` as the kernel reads them.
pub(super) fn attributes_uniform(rules: &Attributes) -> AttributesUniform {
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
