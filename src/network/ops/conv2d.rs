//! 2-D convolution with bias as one candle op, with gradients of input, weight and bias.
//! Kernel: [`subsplat_kernels::cpu::conv`]. Tests: below (finite differences), and the kernel's own.

use super::conv::apply;
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::cpu::conv::Sizes;

/// Computes y = x ∗ w + bias: `x` `[B, C, H, W]`, `w` `[O, C, kh, kw]`, `bias` `[O]`,
/// y `[B, O, H', W']`. Zero padding; stride and padding are the same on both axes.
///
/// # Errors
/// Where shapes disagree, a dtype is not f32, or the kernel is larger than the padded image.
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
            "conv2d: expected a kernel inside the padded image and stride ≥ 1, got kernel \
             {kh}x{kw}, image {h}x{w}, padding {padding}, stride {stride}"
        );
    }
    apply("conv2d", x, weight, bias, Sizes::conv2d([c, o], [kh, kw], stride, padding, [h, w]))
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
    fn wrong_shapes_are_errors() -> Result<()> {
        let d = &Device::Cpu;
        let x = Tensor::zeros((1, 3, 4, 4), candle_core::DType::F32, d)?;
        let w = Tensor::zeros((2, 5, 3, 3), candle_core::DType::F32, d)?;
        assert!(conv2d(&x, &w, None, 1, 1).unwrap_err().to_string().contains("input channels"));
        let w = Tensor::zeros((2, 3, 9, 9), candle_core::DType::F32, d)?;
        assert!(conv2d(&x, &w, None, 1, 1).unwrap_err().to_string().contains("kernel 9x9"));
        Ok(())
    }
}
