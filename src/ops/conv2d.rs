//! 2-D convolution with bias as one candle op, with gradients for input, weight and
//! bias. Kernel: [`crate::cpu::conv2d`]; candle's own is 6 to 12 times slower.
//! Tests: below (finite differences), and the kernel's own.

use super::{output, slice};
use crate::cpu::conv2d::{self as cpu, Geometry};
use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail,
};

/// y = x ∗ w + bias: `x` `[B, C, H, W]`, `w` `[O, C, kh, kw]`, `bias` `[O]`, giving
/// `[B, O, H', W']`. Zero padding; stride and padding are the same on both axes.
///
/// # Errors
/// Shapes that do not fit one another, a dtype other than f32, a kernel larger than
/// the padded picture.
pub fn conv2d(
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let (_, c, h, w) = x.dims4()?;
    let (o, wc, kh, kw) = weight.dims4()?;
    if wc != c {
        bail!("conv2d weight: expected {c} input channels like x, got {:?}", weight.dims());
    }
    if stride == 0 || kh == 0 || kw == 0 || h + 2 * padding < kh || w + 2 * padding < kw {
        bail!(
            "conv2d: expected a kernel inside the padded picture and stride ≥ 1, got kernel \
             {kh}x{kw}, picture {h}x{w}, padding {padding}, stride {stride}"
        );
    }
    let g = Geometry {
        in_channels: c,
        out_channels: o,
        kernel: [kh, kw],
        stride,
        padding,
        size: [h, w],
    };
    let (x, weight) = (x.contiguous()?, weight.contiguous()?);
    match bias {
        Some(bias) if bias.dims() == [o] => x.apply_op3(&weight, &bias.contiguous()?, Conv(g)),
        Some(bias) => bail!("conv2d bias: expected [{o}], got {:?}", bias.dims()),
        None => x.apply_op2(&weight, Conv(g)),
    }
}

struct Conv(Geometry);

impl Conv {
    fn run(&self, batch: usize, x: &[f32], w: &[f32], bias: &[f32]) -> Result<(CpuStorage, Shape)> {
        let [h, wi] = self.0.out_size();
        let mut y = vec![0.0; batch * self.0.out_channels * h * wi];
        cpu::forward(&self.0, x, w, bias, &mut y);
        output(y, (batch, self.0.out_channels, h, wi))
    }

    fn grads(
        &self,
        x: &Tensor,
        w: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let dx = match x.track_op() {
            true => Some(dy.apply_op2_no_bwd(w, &InputGrad(self.0))?),
            false => None,
        };
        let dw = match w.track_op() {
            true => Some(x.apply_op2_no_bwd(dy, &WeightGrad(self.0))?),
            false => None,
        };
        Ok((dx, dw))
    }
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("conv2d", "x", s1, l1)?;
        let w = slice::<f32>("conv2d", "weight", s2, l2)?;
        self.run(l1.dims()[0], x, w, &[])
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _res: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        self.grads(x, w, &dy.contiguous()?)
    }
}

impl CustomOp3 for Conv {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("conv2d", "x", s1, l1)?;
        let w = slice::<f32>("conv2d", "weight", s2, l2)?;
        let bias = slice::<f32>("conv2d", "bias", s3, l3)?;
        self.run(l1.dims()[0], x, w, bias)
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        bias: &Tensor,
        _res: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let (dx, dw) = self.grads(x, w, &dy)?;
        let db = match bias.track_op() {
            true => Some(dy.apply_op1_no_bwd(&BiasGrad)?),
            false => None,
        };
        Ok((dx, dw, db))
    }
}

/// (dy, w) to dx.
struct InputGrad(Geometry);

impl CustomOp2 for InputGrad {
    fn name(&self) -> &'static str {
        "conv2d-input-grad"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let dy = slice::<f32>("conv2d", "dy", s1, l1)?;
        let w = slice::<f32>("conv2d", "weight", s2, l2)?;
        let ([h, wi], batch) = (self.0.size, l1.dims()[0]);
        let mut dx = vec![0.0; batch * self.0.in_channels * h * wi];
        cpu::input_grad(&self.0, dy, w, &mut dx);
        output(dx, (batch, self.0.in_channels, h, wi))
    }
}

/// (x, dy) to dw.
struct WeightGrad(Geometry);

impl CustomOp2 for WeightGrad {
    fn name(&self) -> &'static str {
        "conv2d-weight-grad"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("conv2d", "x", s1, l1)?;
        let dy = slice::<f32>("conv2d", "dy", s2, l2)?;
        let (c, o, [kh, kw]) = (self.0.in_channels, self.0.out_channels, self.0.kernel);
        let mut dw = vec![0.0; o * c * kh * kw];
        cpu::weight_grad(&self.0, x, dy, &mut dw);
        output(dw, (o, c, kh, kw))
    }
}

/// dy `[B, O, H, W]` to db `[O]`.
struct BiasGrad;

impl CustomOp1 for BiasGrad {
    fn name(&self) -> &'static str {
        "conv2d-bias-grad"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let dy = slice::<f32>("conv2d", "dy", s, l)?;
        let (_, o, h, w) = l.shape().dims4()?;
        let mut db = vec![0.0; o];
        cpu::bias_grad(h * w, dy, &mut db);
        output(db, o)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn gradients_agree_with_finite_differences() -> Result<()> {
        let d = &Device::Cpu;
        let x = Var::randn(0f32, 1.0, (2, 3, 6, 5), d)?;
        let w = Var::randn(0f32, 1.0, (4, 3, 3, 3), d)?;
        let b = Var::randn(0f32, 1.0, 4, d)?;
        let weights = Tensor::randn(0f32, 1.0, (2, 4, 3, 3), d)?;
        let loss = |x: &Tensor, w: &Tensor, b: &Tensor| -> Result<Tensor> {
            (conv2d(x, w, Some(b), 2, 1)? * &weights)?.sum_all()
        };
        let grads = loss(&x, &w, &b)?.backward()?;
        for (name, var) in [("x", &x), ("w", &w), ("b", &b)] {
            let grad = grads.get(var).unwrap().flatten_all()?.to_vec1::<f32>()?;
            let at = var.flatten_all()?.to_vec1::<f32>()?;
            for i in (0..at.len()).step_by(7) {
                let eval = |h: f32| -> Result<f32> {
                    let mut v = at.clone();
                    v[i] += h;
                    let t = Tensor::from_vec(v, var.shape(), d)?;
                    let pick = |n: &str, v: &Var| {
                        if n == name { t.clone() } else { v.as_tensor().clone() }
                    };
                    loss(&pick("x", &x), &pick("w", &w), &pick("b", &b))?.to_scalar()
                };
                let numeric = (eval(0.5)? - eval(-0.5)?) as f64;
                assert!(
                    (numeric - grad[i] as f64).abs() < 1e-3,
                    "{name}[{i}] {numeric} {}",
                    grad[i]
                );
            }
        }
        Ok(())
    }

    #[test]
    fn misfits_are_named() -> Result<()> {
        let d = &Device::Cpu;
        let x = Tensor::zeros((1, 3, 4, 4), candle_core::DType::F32, d)?;
        let w = Tensor::zeros((2, 5, 3, 3), candle_core::DType::F32, d)?;
        assert!(conv2d(&x, &w, None, 1, 1).unwrap_err().to_string().contains("input channels"));
        let w = Tensor::zeros((2, 3, 9, 9), candle_core::DType::F32, d)?;
        assert!(conv2d(&x, &w, None, 1, 1).unwrap_err().to_string().contains("kernel 9x9"));
        Ok(())
    }
}
