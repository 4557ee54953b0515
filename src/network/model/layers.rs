//! Layers of both backbones, with PyTorch's parameter names and initialisation. All have
//! gradients.

pub use crate::network::ops::activation::Activation;
use crate::network::ops::{Array, ConvConfig};
use candle_core::{Result, Tensor, bail};
use candle_nn::{Init, VarBuilder};

/// Returns PyTorch's default for weights and biases of Linear and Conv: U(±1/√fan_in).
pub fn default_init(fan_in: usize) -> Init {
    let bound = 1.0 / (fan_in.max(1) as f64).sqrt();
    Init::Uniform { lo: -bound, up: bound }
}

/// Uniform in ±√(6/(in + out)) (Xavier, Glorot).
pub(crate) fn xavier(inputs: usize, outputs: usize) -> Init {
    let bound = (6.0 / (inputs + outputs) as f64).sqrt();
    Init::Uniform { lo: -bound, up: bound }
}

/// Initial values of a layer's parameters.
#[derive(Clone, Copy, Debug)]
pub struct LayerInit {
    /// Of the weight.
    pub weight: Init,
    /// Of the bias; `None`: the layer has no bias.
    pub bias: Option<Init>,
}

impl LayerInit {
    /// Weight and bias start at zero.
    pub const ZERO: Self = Self { weight: Init::Const(0.0), bias: Some(Init::Const(0.0)) };
}

/// Kernel, stride and padding of a [`Conv2d`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// Side of the kernel, px.
    pub kernel: usize,
    /// Stride of both axes, px.
    pub stride: usize,
    /// Zero padding on every side, px.
    pub padding: usize,
}

impl ConvShape {
    /// 3×3, stride 1, same size.
    pub const K3: Self = Self { kernel: 3, stride: 1, padding: 1 };
    /// 3×3, stride 2, half the size.
    pub const K3S2: Self = Self { kernel: 3, stride: 2, padding: 1 };
    /// 1×1.
    pub const K1: Self = Self { kernel: 1, stride: 1, padding: 0 };
    /// 7×7, stride 2, half the size.
    pub const K7S2: Self = Self { kernel: 7, stride: 2, padding: 3 };

    /// Returns the same shape with another stride.
    #[must_use]
    pub const fn stride(self, stride: usize) -> Self {
        Self { stride, ..self }
    }
}

/// Two-dimensional convolution: `weight` `[O, C, k, k]`, `bias` `[O]`; `[B, C, H, W]` to
/// `[B, O, H', W']`.
#[derive(Clone, Debug)]
pub struct Conv2d {
    weight: Tensor,
    bias: Option<Tensor>,
    shape: ConvShape,
}

impl Conv2d {
    /// Builds the layer with bias and PyTorch's default initialisation.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(c_in: usize, c_out: usize, shape: ConvShape, vb: VarBuilder) -> Result<Self> {
        let init = default_init(c_in * shape.kernel * shape.kernel);
        Self::with(c_in, c_out, shape, LayerInit { weight: init, bias: Some(init) }, vb)
    }

    /// Builds the layer without bias, Kaiming-normal over fan-out (for ReLU), as in ResNets.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new_no_bias(c_in: usize, c_out: usize, s: ConvShape, vb: VarBuilder) -> Result<Self> {
        let stdev = (2.0 / (c_out * s.kernel * s.kernel) as f64).sqrt();
        let init = LayerInit { weight: Init::Randn { mean: 0.0, stdev }, bias: None };
        Self::with(c_in, c_out, s, init, vb)
    }

    /// Builds the layer with the given initialisation.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn with(
        c_in: usize,
        c_out: usize,
        shape: ConvShape,
        init: LayerInit,
        vb: VarBuilder,
    ) -> Result<Self> {
        let k = shape.kernel;
        let weight = vb.get_with_hints((c_out, c_in, k, k), "weight", init.weight)?;
        let bias = match init.bias {
            Some(init) => Some(vb.get_with_hints(c_out, "bias", init)?),
            None => None,
        };
        Ok(Self { weight, bias, shape })
    }

    /// Maps `[B, C, H, W]` to `[B, O, H', W']`.
    ///
    /// # Errors
    /// Another rank or number of channels.
    pub fn forward<A: Array>(&self, x: &A) -> Result<A> {
        self.apply(x, None)
    }

    /// Applies [`Conv2d::forward`], then `activation`.
    ///
    /// # Errors
    /// As [`Conv2d::forward`].
    pub fn forward_then<A: Array>(&self, x: &A, activation: Activation) -> Result<A> {
        self.apply(x, Some(activation))
    }

    fn apply<A: Array>(&self, x: &A, activation: Option<Activation>) -> Result<A> {
        let bias = self.bias.as_ref().map(|bias| x.parameter(bias)).transpose()?;
        let ConvShape { stride, padding, .. } = self.shape;
        let steps = ConvConfig { stride, padding };
        x.conv2d(&x.parameter(&self.weight)?, bias.as_ref(), steps, activation)
    }
}

/// Linear layer: `weight` `[O, C]`, `bias` `[O]`; `[…, C]` to `[…, O]`.
#[derive(Clone, Debug)]
pub struct Linear {
    weight: Tensor,
    bias: Option<Tensor>,
}

impl Linear {
    /// Builds the layer with bias and PyTorch's default initialisation.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(c_in: usize, c_out: usize, vb: VarBuilder) -> Result<Self> {
        let init = default_init(c_in);
        Self::with(c_in, c_out, LayerInit { weight: init, bias: Some(init) }, vb)
    }

    /// Builds the layer without bias, Xavier-uniform, as in transformers.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new_no_bias(c_in: usize, c_out: usize, vb: VarBuilder) -> Result<Self> {
        let init = LayerInit { weight: xavier(c_in, c_out), bias: None };
        Self::with(c_in, c_out, init, vb)
    }

    /// Builds the layer with the given initialisation.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn with(c_in: usize, c_out: usize, init: LayerInit, vb: VarBuilder) -> Result<Self> {
        let weight = vb.get_with_hints((c_out, c_in), "weight", init.weight)?;
        let bias = match init.bias {
            Some(init) => Some(vb.get_with_hints(c_out, "bias", init)?),
            None => None,
        };
        Ok(Self { weight, bias })
    }

    /// Returns the weight, `[O, C]`.
    pub(crate) fn weight(&self) -> &Tensor {
        &self.weight
    }

    /// Maps `[…, C]` to `[…, O]`.
    ///
    /// # Errors
    /// Another last dimension.
    pub fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let (o, c) = self.weight.dims2()?;
        let mut dims = x.dims().to_vec();
        if dims.last() != Some(&c) {
            bail!("linear: expected x [.., {c}], got {:?}", x.dims());
        }
        let x = x.reshape(((), c))?;
        let bias = self.bias.as_ref().map(|bias| x.parameter(bias)).transpose()?;
        let y = x.linear(&x.parameter(&self.weight)?, bias.as_ref(), None)?;
        if let Some(last) = dims.last_mut() {
            *last = o;
        }
        y.reshape(dims)
    }
}

/// Normalises groups of channels over their channels and pixels, then scales and
/// shifts each channel: `weight`, `bias` `[C]`; `[B, C, H, W]`.
#[derive(Clone, Debug)]
pub struct GroupNorm {
    weight: Tensor,
    bias: Tensor,
    groups: usize,
}

impl GroupNorm {
    /// Builds the layer with initial scale 1 and shift 0.
    ///
    /// # Errors
    /// A tensor is missing or has another shape; `groups` does not divide `channels`.
    pub fn new(groups: usize, channels: usize, vb: VarBuilder) -> Result<Self> {
        Self::with(groups, channels, Init::Const(1.0), vb)
    }

    /// Builds the layer with initial scale 0 and shift 0, for a residual branch that
    /// starts at zero.
    ///
    /// # Errors
    /// As [`GroupNorm::new`].
    pub fn new_zero(groups: usize, channels: usize, vb: VarBuilder) -> Result<Self> {
        Self::with(groups, channels, Init::Const(0.0), vb)
    }

    fn with(groups: usize, channels: usize, weight: Init, vb: VarBuilder) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            bail!("group norm: expected groups that divide {channels} channels, got {groups}");
        }
        Ok(Self {
            weight: vb.get_with_hints(channels, "weight", weight)?,
            bias: vb.get_with_hints(channels, "bias", Init::Const(0.0))?,
            groups,
        })
    }

    /// Normalises `[B, C, …]`.
    ///
    /// # Errors
    /// Another number of channels.
    pub fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let affine = [&x.parameter(&self.weight)?, &x.parameter(&self.bias)?];
        x.group_norm(self.groups, affine, None, None)
    }

    /// Applies [`GroupNorm::forward`] and `activation` in one pass.
    ///
    /// # Errors
    /// As [`GroupNorm::forward`].
    pub fn forward_then<A: Array>(&self, x: &A, activation: Activation) -> Result<A> {
        let affine = [&x.parameter(&self.weight)?, &x.parameter(&self.bias)?];
        x.group_norm(self.groups, affine, Some(activation), None)
    }

    /// Applies [`GroupNorm::forward`] and `activation`, then adds `residual`: the end of a residual
    /// block in one call.
    ///
    /// # Errors
    /// As [`GroupNorm::forward`]; a residual of another shape.
    pub fn forward_onto<A: Array>(
        &self,
        residual: &A,
        x: &A,
        activation: Option<Activation>,
    ) -> Result<A> {
        let affine = [&x.parameter(&self.weight)?, &x.parameter(&self.bias)?];
        x.group_norm(self.groups, affine, activation, Some(residual))
    }
}

/// Normalises each channel of each image to zero mean and unit variance over its pixels,
/// without parameters; `[B, C, H, W]`.
///
/// # Errors
/// Another rank.
pub fn instance_norm<A: Array>(x: &A) -> Result<A> {
    x.instance_norm(None)
}

/// Computes max(0, [`instance_norm`]) in one pass.
///
/// # Errors
/// As [`instance_norm`].
pub fn instance_norm_relu<A: Array>(x: &A) -> Result<A> {
    x.instance_norm(Some(Activation::Relu))
}

/// Normalises the last dimension, then scales and shifts: `weight`, `bias` `[C]`.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    /// Builds the layer with initial scale 1 and shift 0.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(width: usize, vb: VarBuilder) -> Result<Self> {
        Ok(Self {
            weight: vb.get_with_hints(width, "weight", Init::Const(1.0))?,
            bias: vb.get_with_hints(width, "bias", Init::Const(0.0))?,
        })
    }

    /// Returns scale and shift, `[C]` each.
    pub(crate) fn parameters(&self) -> [&Tensor; 2] {
        [&self.weight, &self.bias]
    }

    /// Normalises `[…, C]`.
    ///
    /// # Errors
    /// Another last dimension.
    pub fn forward<A: Array>(&self, x: &A) -> Result<A> {
        x.layer_norm([&x.parameter(&self.weight)?, &x.parameter(&self.bias)?], None)
    }

    /// Applies [`LayerNorm::forward`] to x + other, in one call.
    ///
    /// # Errors
    /// As [`LayerNorm::forward`]; arrays of different shapes.
    pub fn forward_of_sum<A: Array>(&self, x: &A, other: &A) -> Result<A> {
        x.add_layer_norm(other, [&x.parameter(&self.weight)?, &x.parameter(&self.bias)?])
    }

    /// Applies [`LayerNorm::forward`], then adds `residual`, in one call.
    ///
    /// # Errors
    /// As [`LayerNorm::forward`]; a residual of another shape.
    pub fn forward_onto<A: Array>(&self, residual: &A, x: &A) -> Result<A> {
        x.layer_norm([&x.parameter(&self.weight)?, &x.parameter(&self.bias)?], Some(residual))
    }
}

/// Computes max(0, x).
///
/// # Errors
/// `x` is not f32.
pub fn relu<A: Array>(x: &A) -> Result<A> {
    x.activate(Activation::Relu)
}

/// Computes x·sigmoid(x).
///
/// # Errors
/// `x` is not f32.
pub fn silu<A: Array>(x: &A) -> Result<A> {
    x.activate(Activation::Silu)
}

/// Computes x·Φ(x), the exact (erf) form.
///
/// # Errors
/// `x` is not f32.
pub fn gelu<A: Array>(x: &A) -> Result<A> {
    x.activate(Activation::Gelu)
}

/// Computes 1/(1 + e⁻ˣ).
///
/// # Errors
/// `x` is not f32.
pub fn sigmoid<A: Array>(x: &A) -> Result<A> {
    x.activate(Activation::Sigmoid)
}

pub use crate::network::ops::activation::softmax;
pub use crate::network::ops::resize::{resize_bilinear, resize_bilinear_then, upsample_nearest};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::model::weights::Weights;
    use candle_core::{DType, Device, Var};

    /// Compares the gradient of Σ f(x)·r with central differences.
    fn check_grad(x: Tensor, f: impl Fn(&Tensor) -> Result<Tensor>) -> Result<()> {
        let var = Var::from_tensor(&x)?;
        let r = f(&x)?.randn_like(0.0, 1.0)?;
        let loss = |t: &Tensor| (f(t)? * &r)?.sum_all();
        let grad = loss(var.as_tensor())?.backward()?;
        let grad = grad.get(&var).unwrap().flatten_all()?.to_vec1::<f32>()?;
        let at = x.flatten_all()?.to_vec1::<f32>()?;
        for i in (0..at.len()).step_by(1 + at.len() / 23) {
            let eval = |h: f32| -> Result<f64> {
                let mut v = at.clone();
                v[i] += h;
                let y = f(&Tensor::from_vec(v, x.shape(), x.device())?)?;
                let terms = (y * &r)?.flatten_all()?.to_vec1::<f32>()?;
                Ok(terms.iter().map(|v| f64::from(*v)).sum())
            };
            let numeric = (eval(1e-2)? - eval(-1e-2)?) / 2e-2;
            let g = f64::from(grad[i]);
            assert!((numeric - g).abs() < 4e-3 * (1.0 + g.abs()), "[{i}] {numeric} {g}");
        }
        Ok(())
    }

    fn noise(shape: &[usize]) -> Result<Tensor> {
        Tensor::randn(0.3f32, 1.2, shape, &Device::Cpu)
    }

    fn far(a: &Tensor, b: &Tensor) -> Result<f32> {
        (a - b)?.abs()?.flatten_all()?.max(0)?.to_scalar()
    }

    /// `[R, n]`: each row to zero mean and unit variance, in tensor operations.
    fn normalised(x: &Tensor) -> Result<Tensor> {
        let centred = x.broadcast_sub(&x.mean_keepdim(1)?)?;
        centred.broadcast_div(&(centred.sqr()?.mean_keepdim(1)? + 1e-5)?.sqrt()?)
    }

    #[test]
    fn layers_agree_with_their_definitions() -> Result<()> {
        let x = (noise(&[3, 8, 37, 41])? + 2.0)?;
        let (w, b) = (noise(&[8])?, noise(&[8])?);
        let norm = GroupNorm { weight: w.clone(), bias: b.clone(), groups: 2 };
        let want = normalised(&x.reshape((6, ()))?)?.reshape(x.shape())?;
        let want = want.broadcast_mul(&w.reshape((1, 8, 1, 1))?)?;
        let want = want.broadcast_add(&b.reshape((1, 8, 1, 1))?)?;
        assert!(far(&norm.forward(&x)?, &want)? < 2e-5);
        let want = normalised(&x.reshape((24, ()))?)?.reshape(x.shape())?;
        assert!(far(&instance_norm(&x)?, &want)? < 2e-5);
        let x = (noise(&[5000, 8])? + 2.0)?;
        let norm = LayerNorm { weight: w.clone(), bias: b.clone() };
        let want = normalised(&x)?.broadcast_mul(&w)?.broadcast_add(&b)?;
        assert!(far(&norm.forward(&x)?, &want)? < 2e-5);
        // Long enough that several chunks take part.
        let x = noise(&[40_001])?;
        assert!(far(&gelu(&x)?, &x.gelu_erf()?)? < 1e-6);
        assert!(far(&silu(&x)?, &x.silu()?)? < 1e-6);
        assert!(far(&relu(&x)?, &x.relu()?)? == 0.0);
        assert!(far(&sigmoid(&x)?, &((x.clone() * 0.5)?.tanh()?.affine(0.5, 0.5)?))? < 1e-6);
        let x = noise(&[301, 67])?;
        let e = x.exp()?;
        assert!(far(&softmax(&x)?, &e.broadcast_div(&e.sum_keepdim(1)?)?)? < 1e-6);
        let spread = Tensor::new(&[-1e30f32, 0.0, 88.0, 1e30], &Device::Cpu)?;
        assert_eq!(softmax(&spread)?.to_vec1::<f32>()?, [0.0, 0.0, 0.0, 1.0]);
        // Rows longer than a part of the sum, numbers far apart, and one NaN.
        let mut x = (noise(&[3, 5003])? * 20.0)?.flatten_all()?.to_vec1::<f32>()?;
        x[5003] = f32::NAN;
        let x = Tensor::from_vec(x, (3, 5003), &Device::Cpu)?;
        let e = x.to_dtype(DType::F64)?.exp()?;
        let want = e.broadcast_div(&e.sum_keepdim(1)?)?.to_vec2::<f64>()?;
        for (row, (got, want)) in softmax(&x)?.to_vec2::<f32>()?.into_iter().zip(want).enumerate() {
            for (got, want) in got.into_iter().zip(want) {
                let off = (f64::from(got) - want).abs();
                assert!(
                    if row == 1 { got.is_nan() } else { off <= 2e-6 * want + 1e-11 },
                    "{got} {want}"
                );
            }
        }
        Ok(())
    }

    #[test]
    fn resizes_agree_with_their_definitions() -> Result<()> {
        let x = Tensor::arange(0f32, 12.0, &Device::Cpu)?.reshape((1, 2, 2, 3))?;
        // Linear in both indices, so bilinear interpolation is exact: 3·v + u.
        let y = resize_bilinear(&x, 5, 9)?;
        for (i, v) in y.flatten_all()?.to_vec1::<f32>()?.into_iter().enumerate() {
            let c = i / 45;
            let row = i / 9 % 5;
            let col = i % 9;
            let want = 6.0 * c as f32 + 3.0 * row as f32 / 4.0 + 2.0 * col as f32 / 8.0;
            assert!((v - want).abs() < 1e-5, "{i}: {v} {want}");
        }
        assert_eq!(resize_bilinear(&x, 2, 3)?.flatten_all()?.to_vec1::<f32>()?, values(&x)?);
        assert_eq!(resize_bilinear(&x, 1, 1)?.flatten_all()?.to_vec1::<f32>()?, [0.0, 6.0]);
        let got = resize_bilinear_then(&x, 5, 9, Activation::Gelu)?;
        let want = gelu(&resize_bilinear(&x, 5, 9)?)?;
        assert_eq!(values(&got)?, values(&want)?);
        let y = upsample_nearest(&x, 3)?;
        for (i, v) in values(&y)?.into_iter().enumerate() {
            let c = i / 54;
            let row = i / 9 % 6;
            let col = i % 9;
            assert_eq!(v, (6 * c + 3 * (row / 3) + col / 3) as f32);
        }
        Ok(())
    }

    fn values(t: &Tensor) -> Result<Vec<f32>> {
        t.flatten_all()?.to_vec1()
    }

    #[test]
    fn misfits_are_named() -> Result<()> {
        let vb = Weights::seeded(1).builder();
        let x = noise(&[2, 8, 5, 6])?;
        let e = GroupNorm::new(3, 8, vb.pp("gn")).unwrap_err().to_string();
        assert!(e.contains("group norm"), "{e}");
        let e = LayerNorm::new(8, vb.pp("ln"))?.forward(&x).unwrap_err().to_string();
        assert!(e.contains("layer norm"), "{e}");
        let e = Linear::new(8, 2, vb.pp("l"))?.forward(&x).unwrap_err().to_string();
        assert!(e.contains("linear"), "{e}");
        assert!(resize_bilinear(&x, 0, 4).is_err());
        Ok(())
    }

    #[test]
    fn every_layer_has_its_gradient() -> Result<()> {
        let vb = Weights::seeded(1).builder();
        let x = noise(&[2, 8, 5, 6])?;
        let conv = Conv2d::new(8, 4, ConvShape::K3S2, vb.pp("conv"))?;
        check_grad(x.clone(), |x| conv.forward(x))?;
        let norm = GroupNorm::new(4, 8, vb.pp("gn"))?;
        check_grad(x.clone(), |x| norm.forward(x))?;
        check_grad(x.clone(), instance_norm)?;
        check_grad(x.clone(), silu)?;
        check_grad(x.clone(), gelu)?;
        check_grad(x.clone(), sigmoid)?;
        check_grad(x.clone(), softmax)?;
        check_grad(x.clone(), |x| resize_bilinear(x, 9, 11))?;
        check_grad(x.clone(), |x| resize_bilinear_then(x, 9, 11, Activation::Gelu))?;
        check_grad(x.clone(), |x| upsample_nearest(x, 2))?;
        let linear = Linear::new(6, 7, vb.pp("linear"))?;
        check_grad(x.clone(), |x| linear.forward(x))?;
        let norm = LayerNorm::new(6, vb.pp("ln"))?;
        check_grad(x, |x| norm.forward(x))
    }
}
