//! 3-D convolution with bias as one candle op, with gradients of input, weight and bias.
//! Kernel: [`subsplat_kernels::cpu::conv`]. Tests: below (against 2-D convolutions of neighbouring
//! slices), and the kernel's own.

use super::conv::apply;
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::cpu::conv::Sizes;

/// Computes y = x ∗ w + bias: `x` `[B, C, D, H, W]`, `w` `[O, C, kd, kh, kw]`, `bias` `[O]`,
/// y `[B, O, D', H', W']`. Stride 1, `padding` zeros on every side.
///
/// # Errors
/// Where shapes disagree, a dtype is not f32, or the kernel is larger than the padded volume.
pub fn conv3d(
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    padding: usize,
) -> Result<Tensor> {
    let (_, c, d, h, w) = x.dims5()?;
    let (o, wc, kd, kh, kw) = weight.dims5()?;
    if wc != c {
        bail!("conv3d weight: expected {c} input channels like x, got {:?}", weight.dims());
    }
    let sides = [(d, kd), (h, kh), (w, kw)];
    if sides.iter().any(|&(size, kernel)| kernel == 0 || size + 2 * padding < kernel) {
        bail!(
            "conv3d: expected a kernel inside the padded volume, got kernel {kd}x{kh}x{kw}, volume \
             {d}x{h}x{w}, padding {padding}"
        );
    }
    apply("conv3d", x, weight, bias, Sizes::conv3d([c, o], [kd, kh, kw], padding, [d, h, w]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::ops::conv2d::conv2d;
    use candle_core::{DType, Device, Var};

    /// Computes the same as 2-D convolutions over the channels of three neighbouring slices.
    fn by_slices(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
        let (b, c, d, h, w) = x.dims5()?;
        let o = weight.dim(0)?;
        let x = x.transpose(1, 2)?.contiguous()?.pad_with_zeros(1, 1, 1)?;
        let slices = (0..3).map(|k| x.narrow(1, k, d)).collect::<Result<Vec<_>>>()?;
        let x = Tensor::cat(&slices, 2)?.reshape((b * d, 3 * c, h, w))?;
        let weight = weight.transpose(1, 2)?.contiguous()?.reshape((o, 3 * c, 3, 3))?;
        conv2d(&x, &weight, Some(bias), 1, 1)?
            .reshape((b, d, o, h, w))?
            .transpose(1, 2)?
            .contiguous()
    }

    #[test]
    fn agrees_with_2d_convolutions_of_slices() -> Result<()> {
        let dev = &Device::Cpu;
        for (c, o) in [(5, 8), (8, 1)] {
            let x = Var::randn(0f32, 1.0, (2, c, 6, 5, 7), dev)?;
            let w = Var::randn(0f32, 1.0, (o, c, 3, 3, 3), dev)?;
            let b = Var::randn(0f32, 1.0, o, dev)?;
            let weights = Tensor::randn(0f32, 1.0, (2, o, 6, 5, 7), dev)?;
            let one = conv3d(&x, &w, Some(&b), 1)?;
            let other = by_slices(&x, &w, &b)?;
            let apart = |a: &Tensor, b: &Tensor| -> Result<f32> {
                assert_eq!(a.dims(), b.dims());
                (a - b)?.abs()?.max_all()?.to_scalar()
            };
            assert!(apart(&one, &other)? < 1e-4);
            let one = (one * &weights)?.sum_all()?.backward()?;
            let other = (other * &weights)?.sum_all()?.backward()?;
            for var in [&x, &w, &b] {
                let (one, other) = (one.get(var).unwrap(), other.get(var).unwrap());
                assert!(apart(one, other)? < 2e-4, "{:?}", var.dims());
            }
        }
        Ok(())
    }

    #[test]
    fn wrong_shapes_are_errors() -> Result<()> {
        let zeros = |dims: [usize; 5]| Tensor::zeros(&dims[..], DType::F32, &Device::Cpu);
        let x = zeros([1, 3, 4, 4, 4])?;
        let refused = |w: Tensor| conv3d(&x, &w, None, 1).unwrap_err().to_string();
        assert!(refused(zeros([2, 5, 3, 3, 3])?).contains("input channels"));
        assert!(refused(zeros([2, 3, 7, 3, 3])?).contains("kernel 7x3x3"));
        Ok(())
    }
}
