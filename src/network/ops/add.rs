//! Sum of two tensors of one shape on all threads of the current pool: candle's sum runs on a pool
//! of its own whose threads spin. Kernel: [`subsplat_kernels::cpu::moves`]. Tests: below (against candle's sum).

use super::{output, slice};
use candle_core::{CpuStorage, CustomOp2, DType, Layout, Result, Shape, Tensor};
use subsplat_kernels::cpu::moves as cpu;

/// Computes a + b of one shape, f32; candle computes other dtypes.
///
/// # Errors
/// Shapes that differ.
pub fn add(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    if a.dtype() == DType::F32 && a.dims() == b.dims() {
        return a.contiguous()?.apply_op2(&b.contiguous()?, Add);
    }
    a + b
}

struct Add;

impl CustomOp2 for Add {
    fn name(&self) -> &'static str {
        "add"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let a = slice::<f32>("add", "a", s1, l1)?;
        let b = slice::<f32>("add", "b", s2, l2)?;
        output(cpu::sum(a, b), l1.shape().clone())
    }

    fn bwd(
        &self,
        _a: &Tensor,
        _b: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        Ok((Some(dy.clone()), Some(dy.clone())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn agrees_with_candle_and_so_do_gradients() -> Result<()> {
        let noise = |shape: &[usize]| Var::randn(0f32, 1.0, shape, &Device::Cpu);
        let (a, b) = (noise(&[3, 5, 7, 4])?, noise(&[3, 5, 7, 4])?);
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let expected = (a.as_tensor() + b.as_tensor())?;
        assert_eq!(flat(&add(&a, &b)?)?, flat(&expected)?);
        let w = Tensor::randn(0f32, 1.0, (3, 5, 7, 4), &Device::Cpu)?;
        let got = (add(&a, &b)? * &w)?.sum_all()?.backward()?;
        let want = (expected * &w)?.sum_all()?.backward()?;
        for var in [&a, &b] {
            let of = |g: &candle_core::backprop::GradStore| flat(g.get(var).unwrap());
            assert_eq!(of(&got)?, of(&want)?);
        }
        Ok(())
    }
}
