//! Custom candle ops over the kernels of [`crate::cpu`]: shape, dtype and layout
//! checks live here, the arithmetic there. Every op either has a gradient or says
//! plainly that it has none; none drops it silently.

pub mod activation;
pub mod attention;
pub mod attention_gather;
pub mod conv2d;
pub mod matching;
pub mod norm;
pub mod plane_sweep;
mod rasterize;
pub mod redistribute;
pub mod resize;
pub mod spgr;

pub use rasterize::rasterize;

use candle_core::{CpuStorage, Layout, Result, Shape, Tensor, bail};

/// The elements of an op's argument, which must be contiguous `f32`.
pub(crate) fn f32_slice<'a>(
    op: &str,
    what: &str,
    storage: &'a CpuStorage,
    layout: &Layout,
) -> Result<&'a [f32]> {
    let CpuStorage::F32(data) = storage else {
        bail!("{op} {what}: expected f32, got another dtype")
    };
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&data[start..end]),
        None => {
            bail!("{op} {what}: expected a contiguous tensor, got strides {:?}", layout.stride())
        }
    }
}

/// An op's result.
pub(crate) fn output(data: Vec<f32>, shape: impl Into<Shape>) -> Result<(CpuStorage, Shape)> {
    Ok((CpuStorage::F32(data), shape.into()))
}

/// A tensor's elements in order, copied.
pub(crate) fn values(t: &Tensor) -> Result<Vec<f32>> {
    t.flatten_all()?.to_vec1()
}

/// A tensor of `like`'s shape and device.
pub(crate) fn tensor_like(data: Vec<f32>, like: &Tensor) -> Result<Tensor> {
    Tensor::from_vec(data, like.shape(), like.device())
}
