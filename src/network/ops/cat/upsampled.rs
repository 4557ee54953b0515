//! Channels of two maps as a candle op with gradients, the second upsampled. Kernel:
//! [`subsplat_kernels::cpu::join`]. Tests: tests/network/operators/small.rs.

use crate::network::ops::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::join as cpu;
use subsplat_kernels::cpu::join::Join;
use subsplat_kernels::cpu::zeros;

const NAME: &str = "cat upsampled";

/// Concatenates the channels of `[B, C₁, h, w]` and of `[B, C₂, h/s, w/s]`, each of whose pixels is
/// repeated s × s times: `[B, C₁ + C₂, h, w]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn cat_upsampled(fine: &Tensor, coarse: &Tensor, s: usize) -> Result<Tensor> {
    let (b, c1, h, w) = fine.dims4()?;
    let (cb, c2, ch, cw) = coarse.dims4()?;
    if cb != b || s == 0 || [s * ch, s * cw] != [h, w] || [h, w, c1, c2].contains(&0) {
        bail!(
            "{NAME}: expected [B, C, {s}·h, {s}·w] and [B, C', h, w], got {:?} and {:?}",
            fine.dims(),
            coarse.dims()
        );
    }
    let op = Op(Join { channels: [c1, c2], size: [h, w], repeat: s });
    fine.contiguous()?.apply_op2(&coarse.contiguous()?, op)
}

struct Op(Join);

impl CustomOp2 for Op {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let fine = slice::<f32>(NAME, "fine", s1, l1)?;
        let coarse = slice::<f32>(NAME, "coarse", s2, l2)?;
        let [c1, c2] = self.0.channels;
        let [h, w] = self.0.size;
        let shape = (l1.dims()[0], c1 + c2, h, w);
        output(cpu::forward(&self.0, shape.0, fine, coarse), shape)
    }

    fn bwd(
        &self,
        fine: &Tensor,
        coarse: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let of = |x: &Tensor, run: fn(&Join, &[f32], &mut [f32])| -> Result<Option<Tensor>> {
            if !x.track_op() {
                return Ok(None);
            }
            let mut dx = zeros(x.elem_count());
            borrowed(NAME, [&dy], |[dy]: [&[f32]; 1]| run(&self.0, dy, &mut dx))?;
            tensor_like(dx, x).map(Some)
        };
        Ok((of(fine, cpu::backward_fine)?, of(coarse, cpu::backward_coarse)?))
    }
}
