//! GroupNorm, InstanceNorm and LayerNorm as one candle op with gradients. Kernel:
//! [`subsplat_kernels::cpu::norm`]. Tests: `model::layers`.

use super::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::activation::Activation;
use subsplat_kernels::cpu::norm as cpu;
use subsplat_kernels::cpu::norm::{Rows, Saved};

/// ε of every normalisation (PyTorch's default).
pub(super) const EPS: f64 = 1e-5;

/// Over the channels of each of `groups` groups and all pixels: `x` `[B, C, …]`,
/// `weight` and `bias` `[C]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn group_norm(x: &Tensor, groups: usize, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    group_norm_then(x, groups, Affine { weight, bias }, None)
}

/// Factor and summand of each channel, `[C]`.
#[derive(Clone, Copy, Debug)]
pub struct Affine<'a> {
    /// Factors.
    pub weight: &'a Tensor,
    /// Summands.
    pub bias: &'a Tensor,
}

/// [`group_norm`], then `activation`, in one pass.
///
/// # Errors
/// As [`group_norm`].
pub fn group_norm_then(
    x: &Tensor,
    groups: usize,
    affine: Affine<'_>,
    activation: Option<Activation>,
) -> Result<Tensor> {
    let Affine { weight, bias } = affine;
    let dims = x.dims();
    let c = weight.elem_count();
    if dims.len() < 3 || dims[1] != c || groups == 0 || !c.is_multiple_of(groups) {
        bail!(
            "group norm: expected x [B, {c}, ..] and groups dividing {c}, got {dims:?}, {groups}"
        );
    }
    let run = dims[2..].iter().product();
    let rows = Rows { len: c / groups * run, run, groups, eps: EPS as f32, activation };
    normalise(x, rows, Some((weight, bias)))
}

/// Over the pixels of each channel of each picture, no parameters, then `activation`, in one pass:
/// `[B, C, H, W]`.
///
/// # Errors
/// Another rank; a dtype other than f32.
pub fn instance_norm_then(x: &Tensor, activation: Option<Activation>) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    normalise(x, Rows { len: h * w, run: h * w, groups: 1, eps: EPS as f32, activation }, None)
}

/// Over the last dimension: `x` `[…, C]`, `weight` and `bias` `[C]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let c = weight.elem_count();
    if x.dims().last() != Some(&c) {
        bail!("layer norm: expected x [.., {c}], got {:?}", x.dims());
    }
    let rows = Rows { len: c, run: 1, groups: 1, eps: EPS as f32, activation: None };
    normalise(x, rows, Some((weight, bias)))
}

fn normalise(x: &Tensor, rows: Rows, affine: Option<(&Tensor, &Tensor)>) -> Result<Tensor> {
    if rows.len == 0 {
        bail!("normalisation: expected at least one element to average, got {:?}", x.dims());
    }
    let x = x.contiguous()?;
    match affine {
        Some((w, b)) if w.dims() == b.dims() => {
            x.apply_op3(&w.contiguous()?, &b.contiguous()?, Normalise(rows))
        }
        Some((w, b)) => {
            bail!("normalisation bias: expected {:?} like weight, got {:?}", w.dims(), b.dims())
        }
        None => x.apply_op1(Normalise(rows)),
    }
}

struct Normalise(Rows);

impl Normalise {
    fn run(&self, x: &[f32], w: &[f32], b: &[f32], shape: &Shape) -> Result<(CpuStorage, Shape)> {
        output(cpu::forward(&self.0, x, w, b), shape.clone())
    }
}

impl CustomOp1 for Normalise {
    fn name(&self) -> &'static str {
        "normalise"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        self.run(slice::<f32>("normalise", "x", s, l)?, &[], &[], l.shape())
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let (dx, _, _) = borrowed("normalise", [x, &dy], |[x, dy]: [&[f32]; 2]| {
            cpu::backward(&self.0, &Saved { x, w: &[], b: &[], dy })
        })?;
        tensor_like(dx, x).map(Some)
    }
}

impl CustomOp3 for Normalise {
    fn name(&self) -> &'static str {
        "normalise"
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
        let x = slice::<f32>("normalise", "x", s1, l1)?;
        let w = slice::<f32>("normalise", "weight", s2, l2)?;
        let b = slice::<f32>("normalise", "bias", s3, l3)?;
        self.run(x, w, b, l1.shape())
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let (dx, dw, db) = borrowed("normalise", [x, w, b, &dy], |[x, w, b, dy]: [&[f32]; 4]| {
            cpu::backward(&self.0, &Saved { x, w, b, dy })
        })?;
        Ok((Some(tensor_like(dx, x)?), Some(tensor_like(dw, w)?), Some(tensor_like(db, b)?)))
    }
}
