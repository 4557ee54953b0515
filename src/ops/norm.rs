//! GroupNorm, InstanceNorm and LayerNorm as one candle op with gradients. Kernel:
//! [`crate::cpu::norm`]. Tests: `model::layers`.

use super::{borrowed, output, slice, tensor_like};
use crate::cpu::activation::Activation;
use crate::cpu::norm::{self as cpu, Rows, Saved};
use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};

/// ε of every normalisation (PyTorch's default).
const EPS: f32 = 1e-5;

/// Over the channels of each of `groups` groups and all pixels: `x` `[B, C, …]`,
/// `weight` and `bias` `[C]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn group_norm(x: &Tensor, groups: usize, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    group_norm_then(x, groups, (weight, bias), None)
}

/// [`group_norm`] with `affine` = (weight, bias), then `activation`, in one pass.
///
/// # Errors
/// As [`group_norm`].
pub fn group_norm_then(
    x: &Tensor,
    groups: usize,
    affine: (&Tensor, &Tensor),
    activation: Option<Activation>,
) -> Result<Tensor> {
    let (weight, bias) = affine;
    let dims = x.dims();
    let c = weight.elem_count();
    if dims.len() < 3 || dims[1] != c || groups == 0 || !c.is_multiple_of(groups) {
        bail!(
            "group norm: expected x [B, {c}, ..] and groups dividing {c}, got {dims:?}, {groups}"
        );
    }
    let run = dims[2..].iter().product();
    let rows = Rows { len: c / groups * run, run, groups, eps: EPS, activation };
    normalise(x, rows, Some((weight, bias)))
}

/// Over the pixels of each channel of each picture, no parameters: `[B, C, H, W]`.
///
/// # Errors
/// Another rank; a dtype other than f32.
pub fn instance_norm(x: &Tensor) -> Result<Tensor> {
    instance_norm_then(x, None)
}

/// [`instance_norm`], then `activation`, in one pass.
///
/// # Errors
/// As [`instance_norm`].
pub fn instance_norm_then(x: &Tensor, activation: Option<Activation>) -> Result<Tensor> {
    let (_, _, h, w) = x.dims4()?;
    normalise(x, Rows { len: h * w, run: h * w, groups: 1, eps: EPS, activation }, None)
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
    let rows = Rows { len: c, run: 1, groups: 1, eps: EPS, activation: None };
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::same::{noise, same};
    use candle_core::{DType, Device};

    fn erf_gelu(x: &Tensor) -> Result<Tensor> {
        ((x / 2f64.sqrt())?.erf()? + 1.0)? * (x * 0.5)?
    }

    /// `[R, n]` to zero mean and unit variance.
    fn unit(x: &Tensor) -> Result<Tensor> {
        let centred = x.broadcast_sub(&x.mean_keepdim(1)?)?;
        centred.broadcast_div(&(centred.sqr()?.mean_keepdim(1)? + 1e-5)?.sqrt()?)
    }

    fn plain(x: &[Tensor], groups: usize) -> Result<Tensor> {
        let (b, c) = (x[0].dim(0)?, x[1].elem_count());
        let y = unit(&x[0].reshape((b * groups, ()))?)?.reshape(x[0].shape())?;
        let y = y.broadcast_mul(&x[1].reshape((1, c, 1, 1))?)?;
        y.broadcast_add(&x[2].reshape((1, c, 1, 1))?)
    }

    /// Where e^{-v} leaves the range of f32, and where there is no number.
    #[test]
    fn silu_of_far_values() -> Result<()> {
        let (w, b) = (
            Tensor::new(&[400f32, -90.0], &Device::Cpu)?,
            Tensor::zeros(2, DType::F32, &Device::Cpu)?,
        );
        let x = noise(&[1, 2, 5, 9], 7)?;
        let got = group_norm_then(&x, 1, (&w, &b), Some(Activation::Silu))?;
        let values = group_norm(&x, 1, &w, &b)?.flatten_all()?.to_vec1::<f32>()?;
        assert!(values.iter().any(|v| *v < -300.0) && values.iter().any(|v| *v > 300.0));
        for (got, v) in got.flatten_all()?.to_vec1::<f32>()?.into_iter().zip(values) {
            let want = f64::from(v) / (1.0 + (-f64::from(v)).exp());
            assert!(
                (f64::from(got) - want).abs() <= 1e-6 * want.abs().max(1.0),
                "{v}: {got} {want}"
            );
        }
        let lost = group_norm_then(&(x * f64::NAN)?, 1, (&w, &b), Some(Activation::Silu))?;
        assert!(lost.flatten_all()?.to_vec1::<f32>()?.iter().all(|v| v.is_nan()));
        Ok(())
    }

    #[test]
    fn norm_and_activation_agree_with_their_definitions() -> Result<()> {
        let inputs = [noise(&[3, 6, 7, 11], 1)?, noise(&[6], 2)?, noise(&[6], 3)?];
        for (kind, f) in [
            (None, (|x: &Tensor| Ok(x.clone())) as fn(&Tensor) -> Result<Tensor>),
            (Some(Activation::Gelu), erf_gelu),
            (Some(Activation::Silu), |x: &Tensor| x / (x.neg()?.exp()? + 1.0)?),
        ] {
            same(
                &inputs,
                |x| Ok(vec![group_norm_then(&x[0], 3, (&x[1], &x[2]), kind)?]),
                |x| Ok(vec![f(&plain(x, 3)?)?]),
            )?;
        }
        same(
            &inputs[..1],
            |x| Ok(vec![instance_norm_then(&x[0], Some(Activation::Silu))?]),
            |x| {
                let y = unit(&x[0].reshape((18, ()))?)?.reshape(x[0].shape())?;
                Ok(vec![(&y / (y.neg()?.exp()? + 1.0)?)?])
            },
        )?;
        // More rows than one task takes; whole vectors, parts of them, long rows.
        for (rows, n) in [(5000, 9), (37, 128), (11, 41), (5, 700)] {
            let inputs = [noise(&[rows, n], 4)?, noise(&[n], 5)?, noise(&[n], 6)?];
            same(
                &inputs,
                |x| Ok(vec![layer_norm(&x[0], &x[1], &x[2])?]),
                |x| Ok(vec![unit(&x[0])?.broadcast_mul(&x[1])?.broadcast_add(&x[2])?]),
            )?;
        }
        Ok(())
    }
}
