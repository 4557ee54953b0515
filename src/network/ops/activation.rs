//! Pointwise functions and softmax over the last dimension as candle ops with
//! gradients. Kernels: [`subsplat_kernels::cpu::activation`], [`subsplat_kernels::cpu::softmax`]. Tests:
//! `model::layers` (values, gradients), tests/network/operators/norm.rs (behind a norm).

use super::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::activation as cpu;
pub use subsplat_kernels::cpu::activation::Activation;
use subsplat_kernels::cpu::{softmax, zeros};

/// y = f(x), any shape.
///
/// # Errors
/// A dtype other than f32.
pub fn activation(x: &Tensor, kind: Activation) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Pointwise(kind))
}

struct Pointwise(Activation);

impl CustomOp1 for Pointwise {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("activation", "x", s, l)?;
        output(cpu::forward(self.0, x), l.shape().clone())
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let mut dx = zeros(x.elem_count());
        borrowed("activation", [x, &dy], |[x, dy]: [&[f32]; 2]| {
            cpu::backward(self.0, x, dy, &mut dx);
        })?;
        tensor_like(dx, x).map(Some)
    }
}

/// Softmax over the last dimension.
///
/// # Errors
/// A scalar; a dtype other than f32.
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    match x.dims().last() {
        Some(&n) if n > 0 => x.contiguous()?.apply_op1(Softmax(n)),
        _ => bail!("softmax: expected a last dimension of at least 1, got {:?}", x.dims()),
    }
}

/// Over rows of this many elements.
struct Softmax(usize);

impl CustomOp1 for Softmax {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("softmax", "x", s, l)?;
        output(softmax::softmax(self.0, x), l.shape().clone())
    }

    fn bwd(&self, x: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let mut dx = zeros(x.elem_count());
        borrowed("softmax", [y, &dy], |[y, dy]: [&[f32]; 2]| {
            softmax::backward(self.0, y, dy, &mut dx);
        })?;
        tensor_like(dx, x).map(Some)
    }
}
