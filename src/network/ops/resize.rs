//! Bilinear resize (corners aligned) and nearest upsampling as candle ops with
//! gradients: candle's bilinear has none, and its nearest overwrites instead of
//! adding. Kernels: [`subsplat_kernels::cpu::resize`]. Tests: `model::layers`.

use super::{borrowed, output, slice};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::activation::Activation;
use subsplat_kernels::cpu::resize as cpu;
use subsplat_kernels::cpu::resize::Resize;
use subsplat_kernels::cpu::zeros;

/// `[B, C, h, w]` to `[B, C, H, W]`, corner pixels on corner pixels
/// (`align_corners = true`).
///
/// # Errors
/// Another rank, an empty size, a dtype other than f32.
pub fn resize_bilinear(x: &Tensor, height: usize, width: usize) -> Result<Tensor> {
    run(x, [height, width], Kind::Bilinear(None))
}

/// `activation` of [`resize_bilinear`] in one pass.
///
/// # Errors
/// As [`resize_bilinear`].
pub fn resize_bilinear_then(
    x: &Tensor,
    height: usize,
    width: usize,
    activation: Activation,
) -> Result<Tensor> {
    run(x, [height, width], Kind::Bilinear(Some(activation)))
}

/// `[B, C, h, w]` to `[B, C, s·h, s·w]`, each pixel repeated s × s times.
///
/// # Errors
/// Another rank, an empty size, a dtype other than f32.
pub fn upsample_nearest(x: &Tensor, s: usize) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    run(x, [s * h, s * w], Kind::Nearest(s))
}

fn run(x: &Tensor, to: [usize; 2], kind: Kind) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    if h * w == 0 || to[0] * to[1] == 0 {
        bail!("resize: expected sizes of at least 1, got {h}x{w} to {}x{}", to[0], to[1]);
    }
    x.contiguous()?.apply_op1(Op { sizes: Resize { from: [h, w], to }, kind })
}

#[derive(Clone, Copy)]
enum Kind {
    Bilinear(Option<Activation>),
    /// By a whole factor.
    Nearest(usize),
}

struct Op {
    sizes: Resize,
    kind: Kind,
}

impl CustomOp1 for Op {
    fn name(&self) -> &'static str {
        "resize"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>("resize", "x", s, l)?;
        let (b, c, _, _) = l.shape().dims4()?;
        let [h, w] = self.sizes.to;
        let y = match self.kind {
            Kind::Bilinear(Some(f)) => cpu::bilinear_then(&self.sizes, f, x),
            Kind::Bilinear(None) => cpu::bilinear(&self.sizes, x),
            Kind::Nearest(s) => cpu::nearest(&self.sizes, s, x),
        };
        output(y, (b, c, h, w))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let mut dx = zeros(x.elem_count());
        borrowed("resize", [x, &dy], |[x, dy]: [&[f32]; 2]| match self.kind {
            Kind::Nearest(s) => cpu::nearest_transposed(&self.sizes, s, dy, &mut dx),
            Kind::Bilinear(None) => cpu::bilinear_transposed(&self.sizes, dy, &mut dx),
            Kind::Bilinear(Some(f)) => {
                cpu::bilinear_then_backward(&self.sizes, f, x, dy, &mut dx);
            }
        })?;
        super::tensor_like(dx, x).map(Some)
    }
}
