//! Concatenation of tensors on all threads of the current pool: along the first dimension (here), of
//! the columns of matrices ([`cat_columns`]), and of the channels of maps of two sizes
//! ([`cat_upsampled`]).
//!
//! candle's `cat` copies on one thread. Its gradient reads strided views element by element.
//! Tests: below (against candle's `cat`), tests/network/trunk_parts.rs,
//! tests/network/operators/small.rs.

mod columns;
mod upsampled;

pub use columns::cat_columns;
pub use upsampled::cat_upsampled;

use super::slice;
use candle_core::{DType, Result, Storage, Tensor, bail};
use subsplat_kernels::cpu::moves::stacked;

/// Concatenates `parts` along the first dimension. `Tensor::cat` does it where a gradient must pass
/// or the dtype is not f32.
///
/// # Errors
/// Shapes that differ in another dimension than the first; no part.
pub fn cat_rows(parts: &[Tensor]) -> Result<Tensor> {
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
        let Storage::Cpu(storage) = &**storage else { bail!("cat: expected tensors on the CPU") };
        slices.push(slice::<f32>("cat", "part", storage, layout)?);
    }
    let mut dims = first.dims().to_vec();
    if let Some(d) = dims.first_mut() {
        *d = parts.iter().map(|t| t.dim(0)).sum::<Result<usize>>()?;
    }
    Tensor::from_vec(stacked(&slices), dims, first.device())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn rows_agree_with_candle() -> Result<()> {
        let noise = || Var::randn(0f32, 1.0, (3, 5, 7, 4), &Device::Cpu);
        let (a, b) = (noise()?, noise()?);
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let parts = [a.detach(), b.detach().narrow(0, 1, 2)?];
        assert_eq!(flat(&cat_rows(&parts)?)?, flat(&Tensor::cat(&parts, 0)?)?);
        assert!(cat_rows(&[a.as_tensor().clone()])?.track_op());
        assert!(cat_rows(&[]).is_err());
        Ok(())
    }
}
