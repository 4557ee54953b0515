//! Custom candle ops over the kernels of [`subsplat_kernels::cpu`].
//!
//! The ops check shapes, dtypes and layouts; the kernels compute. Every op either has a gradient or
//! is documented to have none; no op drops a gradient silently. [`Array`] unites the operations that
//! the network uses; `executor` implements them on a GPU.

pub mod activation;
pub mod adapter;
pub mod add;
pub mod array;
pub mod attention;
pub mod attention_gather;
pub mod attributes;
mod backend;
pub mod cat;
pub mod channels_last;
mod conv;
pub mod conv2d;
pub mod conv3d;
mod device;
pub mod direct_rendering;
#[cfg(feature = "gpu")]
pub mod executor;
#[cfg(not(feature = "gpu"))]
#[path = "executor_absent.rs"]
pub mod executor;
pub mod feed_forward;
pub mod linear;
pub mod matching;
pub mod norm;
pub mod plane_sweep;
pub mod precomputed_gradient;
mod rasterize;
pub mod redistribute;
pub mod resize;
pub mod small;
pub mod spgr;
mod splat_tensors;

pub use array::{Array, ConvConfig};
pub use backend::{Backend, NoDevice};
pub use device::{ColourLayout, DeviceSplats, ParameterStep, SharedStep};
pub use executor::{DeviceAdam, DeviceGradients, Executor, TapeArray};
#[cfg(feature = "gpu")]
pub(crate) use rasterize::check_options as check_raster_options;
pub use rasterize::{over_background, rasterize, rasterize_on, rasterize_splats};
pub use splat_tensors::SplatTensors;

use candle_core::{CpuStorage, Layout, Result, Shape, Storage, Tensor, WithDType, bail};
use subsplat_kernels::cpu::simd::Real;

/// A number type of both candle and the kernels: `f32` or `f64`.
pub(crate) trait Number: Real + WithDType {}
impl Number for f32 {}
impl Number for f64 {}

/// Returns the elements of an op's argument, which must be contiguous and of type `T`.
pub(crate) fn slice<'a, T: Number>(
    op: &str,
    what: &str,
    storage: &'a CpuStorage,
    layout: &Layout,
) -> Result<&'a [T]> {
    let Ok(data) = storage.as_slice::<T>() else {
        let got = candle_core::backend::BackendStorage::dtype(storage);
        bail!("{op} {what}: expected {:?} like the first argument, got {got:?}", T::DTYPE)
    };
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&data[start..end]),
        None => {
            bail!("{op} {what}: expected a contiguous tensor, got strides {:?}", layout.stride())
        }
    }
}

/// Returns all elements in row-major order, for a kernel of a backward pass.
pub(crate) fn elements<T: Number>(tensor: &Tensor) -> Result<Vec<T>> {
    tensor.flatten_all()?.to_vec1::<T>()
}

/// Applies `f` to the elements of contiguous tensors on the CPU, without a copy.
pub(crate) fn borrowed<T: Number, R, const N: usize>(
    op: &str,
    tensors: [&Tensor; N],
    f: impl FnOnce([&[T]; N]) -> R,
) -> Result<R> {
    let held = tensors.map(Tensor::storage_and_layout);
    let mut slices: [&[T]; N] = [&[]; N];
    for (slice_of, (storage, layout)) in slices.iter_mut().zip(&held) {
        let Storage::Cpu(storage) = &**storage else { bail!("{op}: expected tensors on the CPU") };
        *slice_of = slice::<T>(op, "argument", storage, layout)?;
    }
    Ok(f(slices))
}

/// Returns an op's result.
pub(crate) fn output(data: Vec<f32>, shape: impl Into<Shape>) -> Result<(CpuStorage, Shape)> {
    Ok((CpuStorage::F32(data), shape.into()))
}

/// Returns a tensor of `like`'s shape and device.
pub(crate) fn tensor_like(data: Vec<f32>, like: &Tensor) -> Result<Tensor> {
    Tensor::from_vec(data, like.shape(), like.device())
}

/// Runs `$run::<T>($($arg),*)` for the `f32` or `f64` of `$dtype`.
macro_rules! by_dtype {
    ($op:expr, $dtype:expr, $run:ident ( $($arg:expr),* )) => {
        match $dtype {
            candle_core::DType::F32 => $run::<f32>($($arg),*),
            candle_core::DType::F64 => $run::<f64>($($arg),*),
            other => candle_core::bail!("{}: expected f32 or f64, got {other:?}", $op),
        }
    };
}
pub(crate) use by_dtype;
