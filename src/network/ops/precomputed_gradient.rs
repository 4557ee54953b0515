//! A scalar with a precomputed gradient. It connects a loss or a pass that is computed
//! outside candle to candle's graph.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

const NAME: &str = "precomputed_gradient";

/// The op's value and its derivative by each element of the argument.
struct PrecomputedGradient {
    value: f64,
    gradient: Vec<f32>,
}

impl CustomOp1 for PrecomputedGradient {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        Ok((CpuStorage::F32(vec![self.value as f32]), Shape::from(())))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
        let by = f64::from(upstream.to_scalar::<f32>()?);
        let gradient = Tensor::from_slice(&self.gradient, x.shape(), x.device())?;
        Ok(Some(if by == 1.0 { gradient } else { (gradient * by)? }))
    }
}

/// Returns the scalar `value`, whose derivative by `x` (f32, on the CPU) is `gradient`.
///
/// # Errors
/// `gradient` and `x` differ in length.
pub fn precomputed_gradient(x: &Tensor, value: f64, gradient: Vec<f32>) -> Result<Tensor> {
    if gradient.len() != x.elem_count() {
        bail!("{NAME}: expected {} elements, got {}", x.elem_count(), gradient.len());
    }
    x.contiguous()?.apply_op1(PrecomputedGradient { value, gradient })
}
