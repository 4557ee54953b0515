//! [`Array`] for arrays in device memory: each operation, and the rule of its gradient.

use super::DeviceArray;
use super::rules::{
    ProductRules, attention_call, attributes_uniform, camera_floats, pointwise, scaled, wanted,
};
use crate::network::ops::activation::Activation;
use crate::network::ops::array::{Array, ConvSteps};
use crate::network::ops::attention::Labels;
use crate::network::ops::attention_gather::{Deferred, Gather};
use crate::network::ops::attributes::Attributes;
use crate::network::ops::plane_sweep::Sweep;
use crate::network::ops::small::{Candidates, LIFT_GAIN, MeanOver, Start, consensus_tolerances};
use crate::network::ops::spgr::{Spgr, finite};
use crate::network::ops::{Backend, matching};
use candle_core::shape::ShapeWithOneHole;
use candle_core::{DType, Result, Tensor, bail};
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::cpu::attention_gather::OCCLUSION_TOLERANCE;
use subsplat_kernels::cpu::small::{cross_check, depth_consensus};
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::{
    ConvolutionCall, CrossCheckCall, DepthConsensusCall, Function, HeadOutputCall, NormSum,
    PointwiseFunction, RawMatchingCall, Reduction,
};
use subsplat_kernels::layout::SPLAT_STRIDE;

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
        Self { node: None, ..self.clone() }
    }

    fn is_tracked(&self) -> bool {
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

    fn permuted(&self, order: &[usize]) -> Result<Self> {
        self.recorded_alone("permute", self.array.permuted(order), |_, _| {
            let mut inverse = vec![0; order.len()];
            order.iter().enumerate().for_each(|(to, from)| inverse[*from] = to);
            move |dy| dy.permuted(&inverse)
        })
    }

    fn selected(&self, dim: usize, indices: &[u32]) -> Result<Self> {
        self.recorded_alone("selection", self.array.selected(dim, indices), |x, _| {
            let (length, indices) = (x.dims()[dim], indices.to_vec());
            move |dy| dy.selected_backward(dim, length, &indices)
        })
    }

    fn joined(parts: &[&Self], dim: usize) -> Result<Self> {
        let Some(first) = parts.first() else { bail!("join: expected an array, got none") };
        let arrays: Vec<_> = parts.iter().map(|part| &part.array).collect();
        let result = gpu::DeviceArray::joined(&arrays, dim);
        let sizes: Vec<usize> = arrays.iter().map(|part| part.dims()[dim]).collect();
        first.recorded_parts("join", result, parts, move |dy, i| {
            dy.narrow(dim, sizes[..i].iter().sum(), sizes[i])
        })
    }

    fn affine(&self, factor: f64, offset: f64) -> Result<Self> {
        let result = self.array.map(Function::Affine(factor as f32, offset as f32));
        self.recorded_alone("affine", result, |_, _| move |dy| scaled(dy, factor as f32))
    }

    fn activated(&self, kind: Activation) -> Result<Self> {
        let kind = pointwise(Some(kind));
        let result = self.array.map(Function::Activation(kind));
        self.recorded_alone("activation", result, |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Slope(kind))
        })
    }

    fn absolute(&self) -> Result<Self> {
        self.recorded_alone("absolute", self.array.map(Function::Absolute), |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Signed)
        })
    }

    fn squared(&self) -> Result<Self> {
        self.recorded_alone("square", self.array.map(Function::Square), |x, _| {
            let x = x.clone();
            move |dy| scaled(&dy.with(&x, Function::Times)?, 2.0)
        })
    }

    fn reciprocal(&self) -> Result<Self> {
        self.recorded_alone("reciprocal", self.array.map(Function::Reciprocal), |_, y| {
            let y = y.clone();
            move |dy| scaled(&dy.with(&y, Function::Times)?.with(&y, Function::Times)?, -1.0)
        })
    }

    fn clamped(&self, low: f64, high: f64) -> Result<Self> {
        let (low, high) = (low as f32, high.min(f64::from(f32::MAX)) as f32);
        self.recorded_alone("clamp", self.array.map(Function::Clamp(low, high)), |x, _| {
            let x = x.clone();
            move |dy| dy.with(&x, Function::Within(low, high))
        })
    }

    fn where_above(&self, other: &Self, least: f64, fill: f64) -> Result<Self> {
        let result = self.array.with(&other.array, Function::WhereAbove(least as f32, fill as f32));
        // The comparison has no gradient.
        self.recorded_alone("choice", result, |_, _| {
            let other = other.array.clone();
            move |dy| dy.with(&other, Function::WhereAbove(least as f32, 0.0))
        })
    }

    fn expanded(&self, dims: &[usize]) -> Result<Self> {
        self.recorded_alone("expansion", self.array.expanded(dims), |x, _| {
            let dims = x.dims().to_vec();
            move |dy| dy.sum_to(&dims)
        })
    }

    fn plus(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Plus);
        self.recorded("sum", result, [self, other], |want, _| {
            let dims = other.dims().to_vec();
            move |dy| {
                let of_other = wanted(want[1], || dy.sum_to(&dims))?;
                Ok([want[0].then(|| dy.clone()), of_other])
            }
        })
    }

    fn minus(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Minus);
        self.recorded("difference", result, [self, other], |want, _| {
            let dims = other.dims().to_vec();
            move |dy| {
                let of_other = wanted(want[1], || scaled(&dy.sum_to(&dims)?, -1.0))?;
                Ok([want[0].then(|| dy.clone()), of_other])
            }
        })
    }

    fn times(&self, other: &Self) -> Result<Self> {
        let result = self.array.with(&other.array, Function::Times);
        self.recorded("product", result, [self, other], |want, _| {
            let (x, y) = (self.array.clone(), other.array.clone());
            move |dy| {
                let of_other = || dy.with(&x, Function::Times)?.sum_to(y.dims());
                Ok([wanted(want[0], || dy.with(&y, Function::Times))?, wanted(want[1], of_other)?])
            }
        })
    }

    fn over(&self, other: &Self) -> Result<Self> {
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

    fn summed(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Sum)
    }

    fn averaged(&self, dim: usize) -> Result<Self> {
        self.reduced(dim, Reduction::Mean)
    }

    fn largest(&self) -> Result<Self> {
        let last = self.dims().len().saturating_sub(1);
        let result = self.array.reduced(last, Reduction::Maximum);
        self.recorded_alone("largest", result, |x, y| {
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
        let sum = self.times(&weights.reshape((rows, 1, d))?)?.summed(2)?;
        let [rows, n] = sum.sizes()?;
        sum.reshape((rows, n, 1))
    }

    fn softmax(&self) -> Result<Self> {
        self.recorded_alone("softmax", self.array.softmax(), |_, y| {
            let y = y.clone();
            move |dy| y.softmax_backward(dy)
        })
    }

    fn convolved(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        steps: ConvSteps,
        activation: Option<Activation>,
    ) -> Result<Self> {
        let ConvSteps { stride, padding } = steps;
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

    fn projected(
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

    fn plus_then(&self, other: &Self, activation: Activation) -> Result<Self> {
        if self.is_tracked() || other.is_tracked() {
            return self.plus(other)?.activated(activation);
        }
        let kind = pointwise(Some(activation));
        self.of(self.array.with_then(&other.array, Function::Plus, kind))
    }

    fn group_norm(
        &self,
        groups: usize,
        affine: [&Self; 2],
        activation: Option<Activation>,
        residual: Option<&Self>,
    ) -> Result<Self> {
        let (arrays, activation) = (affine.map(|a| &a.array), pointwise(activation));
        let result = self.array.group_norm(
            groups,
            Some(arrays),
            activation,
            residual.map(|residual| &residual.array),
        );
        self.normalised("group norm", result, affine, residual, || {
            let (x, [factors, summands]) = (self.array.clone(), arrays.map(Clone::clone));
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
            let (x, factors) = (self.array.clone(), affine[0].array.clone());
            move |dy| x.layer_norm_backward(&factors, dy)
        })
    }

    fn layer_norm_of_sum(&self, other: &Self, affine: [&Self; 2]) -> Result<Self> {
        // A gradient needs the sum, which is then an operation of its own.
        if [self, other, affine[0], affine[1]].into_iter().any(Self::is_tracked) {
            return self.plus(other)?.layer_norm(affine, None);
        }
        self.of(self.array.layer_norm(affine.map(|a| &a.array), NormSum::Before(&other.array)))
    }

    fn resized(&self, size: [usize; 2], activation: Option<Activation>) -> Result<Self> {
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

    fn repeated(&self, s: usize) -> Result<Self> {
        self.recorded_alone("repetition", self.array.repeated(s), |_, _| {
            move |dy| dy.repeated_backward(s)
        })
    }

    fn pooled(&self, s: usize) -> Result<Self> {
        self.recorded_alone("pooling", self.array.pooled(s), |x, _| {
            let dims = x.dims().to_vec();
            move |dy| dy.pooled_backward(s, &dims)
        })
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
        let both = Self::joined(&[self, message], 1)?;
        let hidden = both.projected(up, None, Some(Activation::Gelu))?;
        hidden.projected(down, None, None)?.layer_norm(norm, Some(self))
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

    fn unit_channels(&self) -> Result<Self> {
        // The added 1e-8 is that of `cpu::small::unit`.
        let [b, _, h, w] = self.sizes()?;
        let sum = self.squared()?.summed(1)?.affine(1.0, 1e-8)?;
        self.over(&sum.square_root()?.reshape((b, 1, h, w))?)
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
        if factor.track_op() {
            let dims = vec![1; scores.dims().len()];
            let factor = self.executor.parameter(factor)?.reshape(dims)?;
            return self.plus(&scores.affine(f64::from(LIFT_GAIN), 0.0)?.times(&factor)?);
        }
        let factor = f64::from(factor.sum_all()?.to_dtype(DType::F32)?.to_scalar::<f32>()?);
        self.plus(&scores.affine(f64::from(LIFT_GAIN) * factor, 0.0)?)
    }

    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]> {
        let [b, _, h, w] = self.sizes()?;
        let window_alone = mean == MeanOver::Window;
        let result = self.array.expectation(window, window_alone);
        let both = self.recorded_alone("expectation", result, |x, _| {
            let x = x.clone();
            move |dy| x.expectation_backward(window, window_alone, dy)
        })?;
        both.halves(&[b, 1, h, w])
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
        let [b, _, h, w] = self.sizes()?;
        let arrays = maps.map(|map| &map.array);
        let result = self.array.upsample_convex(arrays, &start);
        let inputs = [self, maps[0], maps[1]];
        let both = self.recorded("convex upsampling", result, inputs, |want, _| {
            let (x, maps) = (self.array.clone(), arrays.map(Clone::clone));
            move |dy| {
                let maps = [&maps[0], &maps[1]];
                let [of_x, first, second] = x.upsample_convex_backward(maps, &start, dy)?;
                let all = [(want[0], of_x), (want[1], first), (want[2], second)];
                Ok(all.map(|(want, gradient)| want.then_some(gradient)))
            }
        })?;
        both.halves(&[b, 1, 4 * h, 4 * w])
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
        let result = self.array.head_output(&confidence.array, &rgb.array, call);
        let [rows, opacity] = self.executor.checked(result)?;
        let raw = row.len();
        let rows = self.recorded_alone("head output", Ok(rows), |x, _| {
            let (b, h, w) = (x.dims()[0], x.dims()[2], x.dims()[3]);
            move |dy| {
                let channels = dy.permuted(&[0, 2, 1])?.reshape(&[b, raw, h, w])?;
                channels.narrow_backward(1, 0, raw + 1)
            }
        })?;
        if self.node.is_none() && confidence.node.is_none() {
            return Ok([rows, self.of(Ok(opacity))?]);
        }
        // The opacity's formula in operations with gradients.
        let residual = self.narrow(1, raw, 1)?;
        let opacity = match confident {
            true => confidence.plus(&residual)?.activated(Activation::Sigmoid)?.squared()?,
            false => residual.affine(1.0, 2.0)?.activated(Activation::Sigmoid)?,
        };
        Ok([rows, opacity])
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
        let call = CrossCheckCall {
            views: cameras.first().map_or(0, Vec::len),
            cameras: &camera_floats(cameras),
            least: cross_check::MIN_FACTOR,
            colour: cross_check::COLOUR,
            behind: cross_check::BEHIND,
        };
        self.of(self.array.cross_check(&distances.array, call))
    }

    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self> {
        let call = DepthConsensusCall {
            views: cameras.first().map_or(0, Vec::len),
            cameras: &camera_floats(cameras),
            tolerances: &consensus_tolerances(cameras, ranges)?,
            own_weight: depth_consensus::OWN_WEIGHT,
            colour: depth_consensus::COLOUR,
            reach: depth_consensus::REACH,
            least_weight: depth_consensus::LEAST_WEIGHT,
            on_ray: depth_consensus::ON_RAY,
            steps: depth_consensus::STEPS,
        };
        self.of(self.array.depth_consensus(depths.map(|d| &d.array), call))
    }

    fn attributes(&self, rules: Attributes) -> Result<Self> {
        let call = attributes_uniform(&rules);
        self.recorded_alone("attributes", self.array.attributes(call), |x, _| {
            let x = x.clone();
            move |dy| x.attributes_backward(call, dy)
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
        let (none, added) = (self.detached(), residual.map(|residual| &residual.array));
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
