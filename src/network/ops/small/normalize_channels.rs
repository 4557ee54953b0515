use crate::network::ops::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::small::unit as cpu;

const NAME: &str = "normalize channels";

/// `x` `[B, C, h, w]` with the channels of each pixel scaled to unit length (1e-8 added
/// to its square).
///
/// # Errors
/// Another rank, an empty tensor, a dtype other than f32.
pub fn normalize_channels(x: &Tensor) -> Result<Tensor> {
    let (b, c, h, w) = x.dims4()?;
    if b * c * h * w == 0 {
        bail!("{NAME}: expected sizes of at least 1, got {:?}", x.dims());
    }
    x.contiguous()?.apply_op1(Op { channels: c, pixels: h * w })
}

struct Op {
    channels: usize,
    pixels: usize,
}

impl CustomOp1 for Op {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>(NAME, "x", s, l)?;
        let mut y = vec![0.0; x.len()];
        cpu::forward(self.channels, self.pixels, x, &mut y);
        output(y, l.shape().clone())
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let mut dx = vec![0.0; x.elem_count()];
        borrowed(NAME, [x, &dy], |[x, dy]: [&[f32]; 2]| {
            cpu::backward(self.channels, self.pixels, x, dy, &mut dx);
        })?;
        tensor_like(dx, x).map(Some)
    }
}
