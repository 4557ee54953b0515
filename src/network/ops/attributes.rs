//! Attributes of parents as the embeddings read them, as a candle op with its gradient.
//! Formulas: [`subsplat_kernels::cpu::attributes`]. Tests: tests/network/trunk_parts.rs.

use super::{Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::attributes as cpu;
use subsplat_kernels::layout::SPLAT_STRIDE;

pub use cpu::{Attributes, Frame};

const NAME: &str = "attributes";

/// `[n, 11]` of packed rows `[n, 11]`, f32 or f64.
///
/// # Errors
/// Another shape.
pub fn attributes(rows: &Tensor, rules: Attributes) -> Result<Tensor> {
    if rows.rank() != 2 || rows.dims()[1] != SPLAT_STRIDE {
        bail!("{NAME}: expected rows [n, {SPLAT_STRIDE}], got {:?}", rows.dims());
    }
    rows.contiguous()?.apply_op1(Op(rules))
}

struct Op(Attributes);

impl CustomOp1 for Op {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        by_dtype!(NAME, s.dtype(), forward(&self.0, s, l))
    }

    fn bwd(&self, rows: &Tensor, _: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        by_dtype!(NAME, rows.dtype(), backward(&self.0, rows, &dy.contiguous()?)).map(Some)
    }
}

fn forward<T: Number>(
    rules: &Attributes,
    s: &CpuStorage,
    l: &Layout,
) -> Result<(CpuStorage, Shape)> {
    let rows = slice::<T>(NAME, "rows", s, l)?;
    let mut out = vec![T::default(); rows.len()];
    cpu::forward(rules, rows, &mut out);
    Ok((T::to_cpu_storage_owned(out), l.shape().clone()))
}

fn backward<T: Number>(rules: &Attributes, rows: &Tensor, dy: &Tensor) -> Result<Tensor> {
    let mut out = vec![T::default(); rows.elem_count()];
    borrowed::<T, _, 2>(NAME, [rows, dy], |[rows, dy]| cpu::backward(rules, rows, dy, &mut out))?;
    Tensor::from_vec(out, rows.dims(), rows.device())
}
