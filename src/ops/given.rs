//! A scalar whose gradient is known already: how a loss that is no graph of candle's, or
//! a pass that was walked elsewhere, hangs in candle's graph.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

/// A value and its derivative by each element of the argument.
struct Given(f64, Vec<f32>);

impl CustomOp1 for Given {
    fn name(&self) -> &'static str {
        "given"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        Ok((CpuStorage::F32(vec![self.0 as f32]), Shape::from(())))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
        let by = f64::from(upstream.to_scalar::<f32>()?);
        let gradient = Tensor::from_slice(&self.1, x.shape(), x.device())?;
        Ok(Some(if by == 1.0 { gradient } else { (gradient * by)? }))
    }
}

/// The scalar `value` whose derivative by `x` (f32, on the CPU) is `gradient`.
///
/// # Errors
/// A gradient of another length than `x`.
pub fn given(x: &Tensor, value: f64, gradient: Vec<f32>) -> Result<Tensor> {
    if gradient.len() != x.elem_count() {
        let got = gradient.len();
        bail!("given gradient: expected {} elements, got {got}", x.elem_count());
    }
    x.contiguous()?.apply_op1(Given(value, gradient))
}
