//! Transpose of maps, so that a pixel's channels are consecutive, on all threads of the current
//! pool; candle copies on one. Kernel: [`subsplat_kernels::cpu::moves`]. Tests: below (against candle's transpose).

use super::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use subsplat_kernels::cpu::moves as cpu;

/// Maps `[B, C, …]` to `[B, N, C]`, N the product of the other sizes: channels innermost.
///
/// # Errors
/// Fewer than two dimensions; a dtype other than f32.
pub fn channels_last(x: &Tensor) -> Result<Tensor> {
    let x = x.flatten_from(2)?;
    let (_, c, n) = x.dims3()?;
    x.contiguous()?.apply_op1(Transposed { rows: c, cols: n })
}

struct Transposed {
    rows: usize,
    cols: usize,
}

impl CustomOp1 for Transposed {
    fn name(&self) -> &'static str {
        "transpose"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("transpose", "x", s, l)?;
        let Self { rows, cols } = *self;
        output(cpu::transposed(x, rows, cols), (l.dims()[0], cols, rows))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let Self { rows, cols } = *self;
        let dx = borrowed("transpose", [&dy], |[dy]: [&[f32]; 1]| cpu::transposed(dy, cols, rows))?;
        tensor_like(dx, x).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn agrees_with_candle_and_so_does_its_gradient() -> Result<()> {
        let x = Var::randn(0f32, 1.0, (3, 5, 7, 4), &Device::Cpu)?;
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let turned = channels_last(&x)?;
        let want = x.flatten_from(2)?.transpose(1, 2)?;
        assert_eq!(turned.dims(), want.dims());
        assert_eq!(flat(&turned)?, flat(&want)?);
        let w = Tensor::randn(0f32, 1.0, (3, 28, 5), &Device::Cpu)?;
        let got = (turned * &w)?.sum_all()?.backward()?;
        let want = (want * &w)?.sum_all()?.backward()?;
        let of = |g: &candle_core::backprop::GradStore| flat(g.get(&x).unwrap());
        assert_eq!(of(&got)?, of(&want)?);
        Ok(())
    }
}
