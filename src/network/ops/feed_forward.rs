//! A transformer's feed-forward block in one pass, without gradient. Kernel:
//! [`subsplat_kernels::cpu::feed_forward`].

use super::{borrowed, tensor_like};
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::cpu::feed_forward as cpu;
use subsplat_kernels::cpu::feed_forward::FeedForward;

const NAME: &str = "feed forward";
/// LayerNorm's ε (PyTorch's default).
const EPS: f32 = 1e-5;

/// x + LayerNorm(GELU([x ; message]·upᵀ)·downᵀ): `x`, `message` `[N, C]`, `up`
/// `[H, 2C]`, `down` `[C, H]`, `norm` scale and shift `[C]`. The result carries no
/// gradient.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32; an argument that tracks gradients.
pub fn feed_forward(
    x: &Tensor,
    message: &Tensor,
    [up, down]: [&Tensor; 2],
    norm: [&Tensor; 2],
) -> Result<Tensor> {
    let (_, c) = x.dims2()?;
    let (h, both) = up.dims2()?;
    let fits = message.dims() == x.dims()
        && both == 2 * c
        && down.dims() == [c, h]
        && norm.iter().all(|t| t.dims() == [c]);
    if !fits {
        bail!(
            "{NAME}: expected x and message [N, C], weights [H, 2C] and [C, H], norm [C], got \
             {:?}, {:?}, {:?}, {:?}, {:?}",
            x.dims(),
            message.dims(),
            up.dims(),
            down.dims(),
            norm.map(|t| t.dims().to_vec())
        );
    }
    let all = [x, message, up, down, norm[0], norm[1]];
    if all.iter().any(|t| t.track_op()) {
        bail!("{NAME}: expected arguments without gradients");
    }
    let held = all.map(Tensor::contiguous);
    let [x, message, up, down, scale, shift] = held;
    let (x, message, up, down, scale, shift) = (x?, message?, up?, down?, scale?, shift?);
    let all = [&x, &message, &up, &down, &scale, &shift];
    let y = borrowed(NAME, all, |[x, message, up, down, scale, shift]: [&[f32]; 6]| {
        let norm = [scale, shift];
        let block = FeedForward { up, down, norm, eps: EPS, width: c, hidden: h };
        cpu::forward(&block, x, message)
    })?;
    tensor_like(y, &x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::ops::activation::{Activation, activation};
    use crate::network::ops::norm::layer_norm;
    use candle_core::{Device, Var};

    #[test]
    fn agrees_with_the_single_ops() -> Result<()> {
        // More than a block, and one that is not full.
        let n = 96 + 37;
        let c = 24;
        let h = 70;
        let dev = &Device::Cpu;
        let noise = |shape: &[usize], s: f32| Tensor::randn(0f32, s, shape, dev);
        let (x, m) = (noise(&[n, c], 1.0)?, noise(&[n, c], 1.0)?);
        let up = noise(&[h, 2 * c], 0.3)?;
        let down = noise(&[c, h], 0.3)?;
        let (w, b) = (noise(&[c], 1.0)?, noise(&[c], 1.0)?);
        let got = feed_forward(&x, &m, [&up, &down], [&w, &b])?;
        let hidden = Tensor::cat(&[&x, &m], 1)?.matmul(&up.t()?)?;
        let narrow = activation(&hidden, Activation::Gelu)?.matmul(&down.t()?)?;
        let want = (x.clone() + layer_norm(&narrow, &w, &b)?)?;
        let far = (got - want)?.abs()?.flatten_all()?.max(0)?.to_scalar::<f32>()?;
        assert!(far < 2e-5, "{far}");
        Ok(())
    }

    #[test]
    fn misfits_and_gradients_are_refused() -> Result<()> {
        let zeros = |shape: &[usize]| Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu);
        let x = zeros(&[5, 4])?;
        let up = zeros(&[6, 8])?;
        let down = zeros(&[4, 6])?;
        let n = zeros(&[4])?;
        assert_eq!(feed_forward(&x, &x, [&up, &down], [&n, &n])?.dims(), [5, 4]);
        assert!(feed_forward(&x, &x, [&down, &up], [&n, &n]).is_err());
        let var = Var::zeros((5, 4), candle_core::DType::F32, &Device::Cpu)?;
        let e = feed_forward(&var, &x, [&up, &down], [&n, &n]).unwrap_err().to_string();
        assert!(e.contains("gradients"), "{e}");
        Ok(())
    }
}
