//! Sums and moves of whole tensors on all of our threads: candle copies on one, and adds
//! on a pool of its own whose threads spin. Kernels: [`subsplat_kernels::cpu::moves`].

use super::{borrowed, output, slice, tensor_like};
use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, DType, Layout, Result, Shape, Storage, Tensor, bail,
};
use subsplat_kernels::cpu::moves as cpu;

/// a + b of one shape, f32; other dtypes go to candle.
///
/// # Errors
/// Shapes that differ.
pub fn sum(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    match a.dtype() == DType::F32 && a.dims() == b.dims() {
        true => a.contiguous()?.apply_op2(&b.contiguous()?, Sum),
        false => a + b,
    }
}

struct Sum;

impl CustomOp2 for Sum {
    fn name(&self) -> &'static str {
        "sum"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (a, b) = (slice::<f32>("sum", "a", s1, l1)?, slice::<f32>("sum", "b", s2, l2)?);
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

/// `parts` one after the other along the first dimension, as `Tensor::cat`, which does it
/// where a gradient must pass or the dtype is not f32.
///
/// # Errors
/// Shapes that differ in another dimension than the first; no part.
pub fn stacked(parts: &[Tensor]) -> Result<Tensor> {
    let plain = |t: &Tensor| t.dtype() == DType::F32 && !t.track_op() && t.rank() > 0;
    let Some(first) = parts.first().filter(|_| parts.iter().all(plain)) else {
        return Tensor::cat(parts, 0);
    };
    if parts.iter().any(|t| t.dims().get(1..) != first.dims().get(1..)) {
        return Tensor::cat(parts, 0);
    }
    let parts = parts.iter().map(Tensor::contiguous).collect::<Result<Vec<_>>>()?;
    let held: Vec<_> = parts.iter().map(Tensor::storage_and_layout).collect();
    let mut slices = Vec::with_capacity(held.len());
    for (storage, layout) in &held {
        let Storage::Cpu(storage) = &**storage else { bail!("stack: expected tensors on the CPU") };
        slices.push(slice::<f32>("stack", "part", storage, layout)?);
    }
    let mut dims = first.dims().to_vec();
    if let Some(d) = dims.first_mut() {
        *d = parts.iter().map(|t| t.dim(0)).sum::<Result<usize>>()?;
    }
    Tensor::from_vec(cpu::stacked(&slices), dims, first.device())
}

/// `[B, C, …]` to `[B, N, C]`, N the product of the others: channels innermost.
///
/// # Errors
/// Fewer than two dimensions; a dtype other than f32.
pub fn channels_last(x: &Tensor) -> Result<Tensor> {
    let x = x.flatten_from(2)?;
    let (_, c, n) = x.dims3()?;
    x.contiguous()?.apply_op1(Transposed([c, n]))
}

/// Rows and columns.
struct Transposed([usize; 2]);

impl CustomOp1 for Transposed {
    fn name(&self) -> &'static str {
        "transpose"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let (x, [rows, cols]) = (slice::<f32>("transpose", "x", s, l)?, self.0);
        output(cpu::transposed(x, rows, cols), (l.dims()[0], cols, rows))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let (dy, [rows, cols]) = (dy.contiguous()?, self.0);
        let dx = borrowed("transpose", [&dy], |[dy]: [&[f32]; 1]| cpu::transposed(dy, cols, rows))?;
        tensor_like(dx, x).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn agree_with_candle_and_so_do_gradients() -> Result<()> {
        let noise = |shape: &[usize]| Var::randn(0f32, 1.0, shape, &Device::Cpu);
        let (a, b) = (noise(&[3, 5, 7, 4])?, noise(&[3, 5, 7, 4])?);
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        assert_eq!(flat(&sum(&a, &b)?)?, flat(&(a.as_tensor() + b.as_tensor())?)?);
        let turned = channels_last(&a)?;
        let want = a.flatten_from(2)?.transpose(1, 2)?;
        assert_eq!((turned.dims(), flat(&turned)?), (want.dims(), flat(&want)?));
        let w = Tensor::randn(0f32, 1.0, (3, 28, 5), &Device::Cpu)?;
        let both = sum(&turned, &channels_last(&b)?)?;
        let got = (both * &w)?.sum_all()?.backward()?;
        let both = (a.as_tensor() + b.as_tensor())?.flatten_from(2)?.transpose(1, 2)?;
        let want = (both * &w)?.sum_all()?.backward()?;
        for var in [&a, &b] {
            let of = |g: &candle_core::backprop::GradStore| flat(g.get(var).unwrap());
            assert_eq!(of(&got)?, of(&want)?);
        }
        let parts = [a.detach(), b.detach().narrow(0, 1, 2)?];
        assert_eq!(flat(&stacked(&parts)?)?, flat(&Tensor::cat(&parts, 0)?)?);
        assert!(stacked(&[a.as_tensor().clone()])?.track_op());
        assert!(stacked(&[]).is_err());
        Ok(())
    }
}
