//! Convolution with bias as one candle op, with gradients of input, weight and bias, for
//! [`super::conv2d`] and [`super::conv3d`]. Kernels: [`subsplat_kernels::cpu::conv`]; candle's own are 6
//! to 12 times slower.

use super::{output, slice};
use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail,
};
use subsplat_kernels::cpu::SimdLevel;
use subsplat_kernels::cpu::conv as cpu;
use subsplat_kernels::cpu::conv::Sizes;
use subsplat_kernels::cpu::zeros;

/// Computes y = x ∗ w + bias for tensors whose shapes `sizes` describes; `name` is used in
/// errors.
pub(super) fn apply(
    name: &'static str,
    x: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    sizes: Sizes,
) -> Result<Tensor> {
    let conv = Conv { name, sizes };
    let x = x.contiguous()?;
    let weight = weight.contiguous()?;
    let o = sizes.out_channels;
    match bias {
        Some(bias) if bias.dims() == [o] => x.apply_op3(&weight, &bias.contiguous()?, conv),
        Some(bias) => bail!("{name} bias: expected [{o}], got {:?}", bias.dims()),
        None => x.apply_op2(&weight, conv),
    }
}

/// The op.
#[derive(Clone, Copy)]
struct Conv {
    name: &'static str,
    sizes: Sizes,
}

impl Conv {
    /// Returns `[batch, channels, …size]` with as many spatial axes as `like` has: two or
    /// three.
    fn shape(like: &Layout, channels: usize, size: [usize; 3]) -> Shape {
        let axes = like.dims().len().saturating_sub(2).min(3);
        let mut dims = vec![like.dims()[0], channels];
        dims.extend(&size[3 - axes..]);
        dims.into()
    }

    /// Runs the forward kernel; `like` is the layout of x.
    fn forward(
        &self,
        like: &Layout,
        x: &[f32],
        w: &[f32],
        bias: &[f32],
    ) -> Result<(CpuStorage, Shape)> {
        let shape = Self::shape(like, self.sizes.out_channels, self.sizes.out_size());
        output(cpu::forward(SimdLevel::best(), &self.sizes, like.dims()[0], x, w, bias), shape)
    }

    /// Computes ∂L/∂x and ∂L/∂w of the tensors that are tracked.
    fn grads(
        &self,
        x: &Tensor,
        w: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let dx = if x.track_op() { Some(dy.apply_op2_no_bwd(w, &InputGrad(*self))?) } else { None };
        let dw =
            if w.track_op() { Some(x.apply_op2_no_bwd(dy, &WeightGrad(*self))?) } else { None };
        Ok((dx, dw))
    }
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        self.name
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>(self.name, "x", s1, l1)?;
        let w = slice::<f32>(self.name, "weight", s2, l2)?;
        self.forward(l1, x, w, &[])
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _res: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        self.grads(x, w, &dy.contiguous()?)
    }
}

impl CustomOp3 for Conv {
    fn name(&self) -> &'static str {
        self.name
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>(self.name, "x", s1, l1)?;
        let w = slice::<f32>(self.name, "weight", s2, l2)?;
        let bias = slice::<f32>(self.name, "bias", s3, l3)?;
        self.forward(l1, x, w, bias)
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        bias: &Tensor,
        _res: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let (dx, dw) = self.grads(x, w, &dy)?;
        let db = if bias.track_op() { Some(dy.apply_op1_no_bwd(&BiasGrad(*self))?) } else { None };
        Ok((dx, dw, db))
    }
}

/// Computes ∂L/∂x from (∂L/∂y, w).
struct InputGrad(Conv);

impl CustomOp2 for InputGrad {
    fn name(&self) -> &'static str {
        "conv-input-grad"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let Conv { name, sizes } = self.0;
        let dy = slice::<f32>(name, "dy", s1, l1)?;
        let w = slice::<f32>(name, "weight", s2, l2)?;
        let shape = Conv::shape(l1, sizes.in_channels, sizes.size);
        output(cpu::input_grad(SimdLevel::best(), &sizes, l1.dims()[0], dy, w), shape)
    }
}

/// Computes ∂L/∂w from (x, ∂L/∂y).
struct WeightGrad(Conv);

impl CustomOp2 for WeightGrad {
    fn name(&self) -> &'static str {
        "conv-weight-grad"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let Conv { name, sizes } = self.0;
        let x = slice::<f32>(name, "x", s1, l1)?;
        let dy = slice::<f32>(name, "dy", s2, l2)?;
        let axes = l1.dims().len().saturating_sub(2).min(3);
        let mut dims = vec![sizes.out_channels, sizes.in_channels];
        dims.extend(&sizes.kernel[3 - axes..]);
        let shape = Shape::from(dims);
        let mut dw = zeros(shape.elem_count());
        cpu::weight_grad(SimdLevel::best(), &sizes, x, dy, &mut dw);
        output(dw, shape)
    }
}

/// Computes ∂L/∂bias `[O]` from ∂L/∂y.
struct BiasGrad(Conv);

impl CustomOp1 for BiasGrad {
    fn name(&self) -> &'static str {
        "conv-bias-grad"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let Conv { name, sizes } = self.0;
        let dy = slice::<f32>(name, "dy", s, l)?;
        let mut db = vec![0.0; sizes.out_channels];
        cpu::bias_grad(sizes.out_pixels(), dy, &mut db);
        output(db, sizes.out_channels)
    }
}
