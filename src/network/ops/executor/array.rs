//! [`Array`] for arrays in device memory: each operation, and the rule of its gradient.

use super::TapeArray;
use super::rules::{ProductRules, attention_call, attributes_uniform, pointwise, scaled, wanted};
use crate::network::ops::Backend;
use crate::network::ops::activation::Activation;
use crate::network::ops::array::{Array, ConvConfig};
use crate::network::ops::attention::Labels;
use crate::network::ops::attention_gather::{Deferred, Gather};
use crate::network::ops::attributes::Attributes;
use crate::network::ops::plane_sweep::Sweep;
use crate::network::ops::spgr::{Spgr, finite};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::cpu::attention_gather::OCCLUSION_TOLERANCE;
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::{ConvolutionCall, Function, NormSum, PointwiseFunction, Reduction};
use subsplat_kernels::layout::SPLAT_STRIDE;

impl Array for TapeArray {
    fn dims(&self) -> &[usize] {
        self.array.dims()
    }

    fn parameter(&self, parameter: &Tensor) -> Result<Self> {
        self.executor.parameter(parameter)
    }

    fn new_tensor(&self, values: Vec<f32>, dims: &[usize]) -> Result<Self> {
        self.of(self.executor.recorder.upload(&values, dims))
    }

    fn upload(&self, tensor: &Tensor) -> Result<Self> {
        self.executor.upload(tensor)
    }

    fn to_host(&self) -> Result<Tensor> {
        let values = self.executor.checked(self.array.to_vec())?;
        Tensor::from_vec(values, self.dims(), &candle_core::Device::Cpu)
    }

    fn detach(&self) -> Self {
        Self { node: None, ..self.clone() }
    }

    fn track_op(&self) -> bool {
        self.node.is_some()
    }

    fn reshape<S: ShapeWithOneHole>(&self, shape: S) -> Result<Self> {
        let result = self.array.reshape(shape.into_shape(self.array.count())?.dims());
        self.recorded_alone("reshape", result, |x, _| {
            let dims = x.dims().to_vec();
            move |dy| dy.reshape(&dims)
        })
    }

    fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self> {
        self.recorded_alone("narrow", self.array.narrow(dim, start, len), |x, _| {
            let length = x.dims()[dim];
            move |dy| dy.narrow_backward(dim, start, length)
        })
    }

    fn permute(&self, order: &[usize]) -> Result<Self> {
        self.recorded_alone("permute", self.array.permuted(order), |_, _| {
            let mut inverse = vec![0; order.len()];
            order.iter().enumerate().for_each(|(to, from)| inverse[*from] = to);
            move |dy| dy.permuted(&inverse)
        })
    }

    fn index_select(&self, indices: &[u32], dim: usize) -> Result<Self> {
        self.recorded_alone("selection", self.array.selected(dim, indices), |x, _| {
            let length = x.dims()[dim];
            let indices = indices.to_vec();
            move |dy| dy.selected_backward(dim, length, &indices)
        })
    }

    fn broadcast_as(&self, dims: &[usize]) -> Result<Self> {
        self.recorded_alone("expansion", self.array.expanded(dims), |x, _| {
            let dims = x.dims().to_vec();
            move |dy| dy.sum_to(&dims)
        })
    }

    fn channels_last(&self) -> Result<Self> {
        let &[b, c, ..] = self.dims() else {
            bail!("transpose: expected [B, C, ..], got {:?}", self.dims())
        };
        self.reshape((b, c, ()))?.permute(&[0, 2, 1])
    }

    fn cat(parts: &[&Self], dim: usize) -> Result<Self> {
        let Some(first) = parts.first() else { bail!("cat: expected an array, got none") };
        let arrays: Vec<_> = parts.iter().map(|part| &part.array).collect();
        let result = gpu::Array::joined(&arrays, dim);
        let sizes: Vec<usize> = arrays.iter().map(|part| part.dims()[dim]).collect();
        first.recorded_parts("cat", result, parts, move |dy, i| {
            dy.narrow(dim, sizes[..i].iter().sum(), sizes[i])
        })
    }

    fn cat_upsampled(&self, coarse: &Self, scale: usize) -> Result<Self> {
        if scale == 1 {
            return Self::cat(&[self, coarse], 1);
        }
        Self::cat(&[self, &coarse.upsample_nearest2d(scale)?], 1)
    }

    fn cat_columns(&self, second: &Self, third: Option<&Self>) -> Result<Self> {
        let parts: Vec<_> = [self, second].into_iter().chain(third).collect();
        Self::cat(&parts, 1)
    }

    fn affine(&self, factor: f64, offset: f64) -> Result<Self> {
        let result = self.array.map(Function::Affine(factor as f32, offset as f32));
        self.recorded_alone("affine", result, |_, _| move |dy| scaled(dy, factor as f32))
    }

    fn abs(&self) -> Result<Self> {
        self.recorded_alone("absolute", self.array.map(Function::Absolute), |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Signed)
        })
    }

    fn sqr(&self) -> Result<Self> {
        self.recorded_alone("square", self.array.map(Function::Square), |x, _| {
            let x = x.clone();
            move |dy| scaled(&dy.with(&x, Function::Times)?, 2.0)
        })
    }

    fn recip(&self) -> Result<Self> {
        self.recorded_alone("reciprocal", self.array.map(Function::Reciprocal), |_, y| {
            let y = y.clone();
            move |dy| scaled(&dy.with(&y, Function::Times)?.with(&y, Function::Times)?, -1.0)
        })
    }

    fn clamp(&self, min: f64, max: f64) -> Result<Self> {
        let min = min as f32;
        let max = max.min(f64::from(f32::MAX)) as f32;
        self.recorded_alone("clamp", self.array.map(Function::Clamp(min, max)), |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Within(min, max))
        })
    }

    fn where_gt(&self, other: &Self, threshold: f64, fill: f64) -> Result<Self> {
        let result =
            self.array.with(&other.array, Function::WhereAbove(threshold as f32, fill as f32));
        // The comparison has no gradient.
        self.recorded_alone("choice", result, |_, _| {
            let other = other.array.clone();
            move |dy| dy.with(&other, Function::WhereAbove(threshold as f32, 0.0))
        })
    }

    fn activate(&self, kind: Activation) -> Result<Self> {
        let kind = pointwise(Some(kind));
        let result = self.array.map(Function::Activation(kind));
        self.recorded_alone("activation", result, |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Slope(kind))
        })
    }

    fn add(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Plus);
        self.recorded("sum", result, [self, other], |want, _| {
            let dims = other.dims().to_vec();
            move |dy| {
                let of_other = wanted(want[1], || dy.sum_to(&dims))?;
                Ok([want[0].then(|| dy.clone()), of_other])
            }
        })
    }

    fn add_activation(&self, other: &Self, activation: Activation) -> Result<Self> {
        if self.track_op() || other.track_op() {
            return self.add(other)?.activate(activation);
        }
        let kind = pointwise(Some(activation));
        self.of(self.array.with_then(&other.array, Function::Plus, kind))
    }

    fn sub(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Minus);
        self.recorded("difference", result, [self, other], |want, _| {
            let dims = other.dims().to_vec();
            move |dy| {
                let of_other = wanted(want[1], || scaled(&dy.sum_to(&dims)?, -1.0))?;
                Ok([want[0].then(|| dy.clone()), of_other])
            }
        })
    }

    fn mul(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Times);
        self.recorded("product", result, [self, other], |want, _| {
            let (x, y) = (self.array.clone(), other.array.clone());
            move |dy| {
                let of_other = || dy.with(&x, Function::Times)?.sum_to(y.dims());
                Ok([wanted(want[0], || dy.with(&y, Function::Times))?, wanted(want[1], of_other)?])
            }
        })
    }

    fn div(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Over);
        self.recorded("quotient", result, [self, other], |want, quotient| {
            let (y, quotient) = (other.array.clone(), quotient.clone());
            move |dy| {
                let of_x = dy.with(&y, Function::Over)?;
                let of_other =
                    || scaled(&of_x.with(&quotient, Function::Times)?.sum_to(y.dims())?, -1.0);
                let of_other = wanted(want[1], of_other)?;
                Ok([want[0].then_some(of_x), of_other])
            }
        })
    }

    fn sum(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Sum)
    }

    fn mean(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Mean)
    }

    fn max_keepdim(&self, dim: usize) -> Result<Self> {
        let result = self.array.reduced(dim, Reduction::Maximum);
        self.recorded_alone("max", result, |x, y| {
            let (x, y) = (x.clone(), y.clone());
            move |dy| {
                // The elements that equal the largest.
                let below = x.with(&y, Function::Minus)?;
                dy.expanded(x.dims())?.with(&below, Function::WhereAbove(-f32::MIN_POSITIVE, 0.0))
            }
        })
    }

    fn weighted_sum(&self, weights: &Self) -> Result<Self> {
        let [rows, d] = weights.sizes()?;
        let sum = self.mul(&weights.reshape((rows, 1, d))?)?.sum(2)?;
        let [rows, n] = sum.sizes()?;
        sum.reshape((rows, n, 1))
    }

    fn softmax(&self) -> Result<Self> {
        self.recorded_alone("softmax", self.array.softmax(), |_, y| {
            let y = y.clone();
            move |dy| y.softmax_backward(dy)
        })
    }

    fn conv2d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        config: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self> {
        self.convolution(weight, bias, config, activation)
    }

    fn conv3d(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        config: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self> {
        self.convolution(weight, bias, config, activation)
    }

    fn linear(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let rules = ProductRules {
            input: Box::new(|dy, _, w| {
                dy.projected(&w.permuted(&[1, 0])?, None, PointwiseFunction::None)
            }),
            weight: Box::new(|dy, x, _| x.projected_weight_backward(dy)),
            channel: 1,
        };
        self.product("linear layer", (weight, bias), rules, activation, |kind| {
            self.array.projected(&weight.array, bias.map(|bias| &bias.array), kind)
        })
    }

    fn group_norm(
        &self,
        groups: usize,
        affine: [&Self; 2],
        activation: Option<Activation>,
        residual: Option<&Self>,
    ) -> Result<Self> {
        let arrays = affine.map(|a| &a.array);
        let activation = pointwise(activation);
        let result = self.array.group_norm(
            groups,
            Some(arrays),
            activation,
            residual.map(|residual| &residual.array),
        );
        self.normalised("group norm", result, affine, residual, || {
            let x = self.array.clone();
            let [factors, summands] = arrays.map(Clone::clone);
            move |dy| {
                let affine = Some([&factors, &summands]);
                let [dx, of_factors, of_summands] =
                    x.group_norm_backward(groups, affine, activation, dy)?;
                let of_factors = of_factors.reshape(factors.dims())?;
                Ok([dx, of_factors, of_summands.reshape(summands.dims())?])
            }
        })
    }

    fn instance_norm(&self, activation: Option<Activation>) -> Result<Self> {
        let [_, channels, ..] = self.sizes::<4>()?;
        let activation = pointwise(activation);
        let result = self.array.group_norm(channels, None, activation, None);
        self.recorded_alone("instance norm", result, |x, _| {
            let x = x.clone();
            move |dy| {
                let [dx, ..] = x.group_norm_backward(channels, None, activation, dy)?;
                Ok(dx)
            }
        })
    }

    fn layer_norm(&self, affine: [&Self; 2], residual: Option<&Self>) -> Result<Self> {
        let arrays = affine.map(|a| &a.array);
        let sum = residual.map_or(NormSum::None, |residual| NormSum::After(&residual.array));
        let result = self.array.layer_norm(arrays, sum);
        self.normalised("layer norm", result, affine, residual, || {
            let x = self.array.clone();
            let factors = affine[0].array.clone();
            move |dy| x.layer_norm_backward(&factors, dy)
        })
    }

    fn add_layer_norm(&self, other: &Self, affine: [&Self; 2]) -> Result<Self> {
        // A gradient needs the sum, which is then an operation of its own.
        if [self, other, affine[0], affine[1]].into_iter().any(Self::track_op) {
            return self.add(other)?.layer_norm(affine, None);
        }
        self.of(self.array.layer_norm(affine.map(|a| &a.array), NormSum::Before(&other.array)))
    }

    fn upsample_bilinear2d(
        &self,
        size: [usize; 2],
        activation: Option<Activation>,
    ) -> Result<Self> {
        let activation = pointwise(activation);
        self.recorded_alone("resize", self.array.resized(size, activation), |x, _| {
            let x = x.clone();
            move |dy| {
                let from = [x.dims()[x.dims().len() - 2], x.dims()[x.dims().len() - 1]];
                if activation == PointwiseFunction::None {
                    return dy.resized_backward(from);
                }
                let before = x.resized(size, PointwiseFunction::None)?;
                dy.with(&before, Function::Slope(activation))?.resized_backward(from)
            }
        })
    }

    fn upsample_nearest2d(&self, scale: usize) -> Result<Self> {
        self.recorded_alone("repetition", self.array.repeated(scale), |_, _| {
            move |dy| dy.repeated_backward(scale)
        })
    }

    fn avg_pool2d(&self, size: usize) -> Result<Self> {
        self.recorded_alone("pooling", self.array.pooled(size), |x, _| {
            let dims = x.dims().to_vec();
            move |dy| dy.pooled_backward(size, &dims)
        })
    }

    fn attention(&self, k: &Self, v: &Self, scale: f32, labels: Option<Labels>) -> Result<Self> {
        let result = self.array.attention(&k.array, &v.array, attention_call(scale, &labels));
        self.recorded("attention", result, [self, k, v], |want, _| {
            let [q, k, v] = [self, k, v].map(|x| x.array.clone());
            move |dy| {
                let call = attention_call(scale, &labels);
                let [of_q, of_k, of_v] = q.attention_backward(&k, &v, call, dy)?;
                let all = [(want[0], of_q), (want[1], of_k), (want[2], of_v)];
                Ok(all.map(|(want, gradient)| want.then_some(gradient)))
            }
        })
    }

    fn feed_forward(
        &self,
        message: &Self,
        [up, down]: [&Self; 2],
        norm: [&Self; 2],
    ) -> Result<Self> {
        let both = Self::cat(&[self, message], 1)?;
        let hidden = both.linear(up, None, Some(Activation::Gelu))?;
        hidden.linear(down, None, None)?.layer_norm(norm, Some(self))
    }

    fn plane_sweep(&self, source: &Self, sweep: Sweep, _backend: &Backend) -> Result<Self> {
        let result = self.array.plane_sweep(&source.array, &sweep);
        self.recorded("plane sweep", result, [self, source], |want, _| {
            let (reference, source) = (self.array.clone(), source.array.clone());
            move |dy| {
                let [own, other] = reference.plane_sweep_backward(&source, &sweep, dy)?;
                Ok([want[0].then_some(own), want[1].then_some(other)])
            }
        })
    }

    fn attention_gather(
        &self,
        query: &Self,
        points: &Self,
        gather: Gather,
        _deferred: Option<&Deferred>,
        residual: Option<&Self>,
        _backend: &Backend,
    ) -> Result<Self> {
        let none = self.detach();
        let added = residual.map(|residual| &residual.array);
        let result = self.array.gather(&query.array, &points.array, &gather, added);
        let inputs = [self, query, points, residual.unwrap_or(&none)];
        self.recorded("attention gather", result, inputs, |want, _| {
            let [maps, query, points] = [self, query, points].map(|x| x.array.clone());
            move |dy| {
                let [of_maps, of_query, of_points] =
                    maps.gather_backward(&query, &points, &gather, dy)?;
                let all = [of_maps, of_query, of_points, dy.clone()].map(Some);
                Ok(std::array::from_fn(|i| all[i].clone().filter(|_| want[i])))
            }
        })
    }

    fn occlusion_gate(&self, z: &Self, depths: &Self) -> Result<Self> {
        self.of(self.array.occlusion(&z.array, &depths.array, OCCLUSION_TOLERANCE))
    }

    fn attributes(&self, rules: Attributes) -> Result<Self> {
        let call = attributes_uniform(&rules);
        self.recorded_alone("attributes", self.array.attributes(call), |x, _| {
            let x = x.clone();
            move |dy| x.attributes_backward(call, dy)
        })
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
        let n = parents.elem_count() / SPLAT_STRIDE;
        let expected = [n * k * SPLAT_STRIDE, n * k * call.rules.gain_channels()];
        if [rows.len(), gains.len()] != expected {
            let got = [rows.len(), gains.len()];
            bail!("spgr: expected buffers of {expected:?} floats, got {got:?}");
        }
        let made = self.array.spgr(&parents.array, &call.on_gpu(&[], &[]));
        let host = |array: &gpu::Array| self.executor.checked(array.to_vec());
        let [own_rows, own_gains] = self.executor.checked(made)?;
        let read = self.executor.recorder.read(&[&own_rows, &own_gains]);
        for (to, from) in [&mut *rows, &mut *gains].into_iter().zip(self.executor.checked(read)?) {
            to.copy_from_slice(&from);
        }
        if rows.iter().chain(&*gains).any(|v| !v.is_finite()) {
            finite(call, &host(&self.array)?, &host(&parents.array)?, rows, gains)?;
        }
        Ok(())
    }
}

impl TapeArray {
    /// Computes a convolution over two or three axes, then applies `activation`.
    fn convolution(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        ConvConfig { stride, padding }: ConvConfig,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let call = ConvolutionCall { stride, padding };
        let rules = ProductRules {
            input: Box::new(move |dy, x, w| dy.convolved_input_backward(w, x.dims(), call)),
            weight: Box::new(move |dy, x, w| x.convolved_weight_backward(dy, w.dims(), call)),
            channel: 1,
        };
        self.product("convolution", (weight, bias), rules, activation, |kind| {
            self.array.convolved(&weight.array, bias.map(|bias| &bias.array), call, kind)
        })
    }
}
