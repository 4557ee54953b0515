//! Scaled dot-product attention as one candle op with gradients; the matrix of
//! logits never exists. Kernel: [`subsplat_kernels::cpu::attention`]. Tests: below.

use super::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::attention as cpu;
use subsplat_kernels::cpu::attention::Attention;
pub use subsplat_kernels::cpu::attention::{Labels, PENALTY};
use subsplat_kernels::cpu::zeros;

/// softmax(scale·q·kᵀ + mask)·v for `q` `[R, L, d]`, `k` `[R, M, d]`, `v`
/// `[R, M, e]`, giving `[R, L, e]`. With `labels`, pairs of different labels get
/// [`PENALTY`] added.
///
/// # Errors
/// Shapes that do not fit one another, a dtype other than f32.
pub fn attention(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    scale: f32,
    labels: Option<Labels>,
) -> Result<Tensor> {
    let (r, l, d) = q.dims3()?;
    let (kr, m, kd) = k.dims3()?;
    let (vr, vm, e) = v.dims3()?;
    if kr != r || vr != r || kd != d || vm != m || m == 0 {
        bail!(
            "attention: expected q [R, L, d], k [R, M, d], v [R, M, e], got {:?}, {:?}, {:?}",
            q.dims(),
            k.dims(),
            v.dims()
        );
    }
    if let Some(a) = &labels {
        let w = a.windows;
        if w == 0 || !r.is_multiple_of(w) || a.queries.len() != w * l || a.keys.len() != w * m {
            bail!(
                "attention labels: expected {l} queries and {m} keys for windows that divide {r} \
                 rows, got {w} windows, {} and {}",
                a.queries.len(),
                a.keys.len()
            );
        }
    }
    let op = Attention { queries: l, keys: m, width: d, value_width: e, scale, labels };
    q.contiguous()?.apply_op3(&k.contiguous()?, &v.contiguous()?, Op(op))
}

struct Op(Attention);

impl CustomOp3 for Op {
    fn name(&self) -> &'static str {
        "attention"
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
        let q = slice::<f32>("attention", "q", s1, l1)?;
        let k = slice::<f32>("attention", "k", s2, l2)?;
        let v = slice::<f32>("attention", "v", s3, l3)?;
        let shape = (l1.dims()[0], self.0.queries, self.0.value_width);
        let mut out = zeros(shape.0 * shape.1 * shape.2);
        cpu::forward(&self.0, q, k, v, &mut out);
        output(out, shape)
    }

    fn bwd(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let grad = grad.contiguous()?;
        let run = |[q, k, v, out, grad]: [&[f32]; 5]| {
            cpu::backward(&self.0, &cpu::Saved { q, k, v, out, grad })
        };
        let (dq, dk, dv) = borrowed("attention", [q, k, v, out, &grad], run)?;
        Ok((Some(tensor_like(dq, q)?), Some(tensor_like(dk, k)?), Some(tensor_like(dv, v)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{D, DType, Device, Var};

    /// The definition in tensor operations, with autograd's gradients.
    fn oracle(q: &Tensor, k: &Tensor, v: &Tensor, scale: f64, mask: &Tensor) -> Result<Tensor> {
        let logits = (q.matmul(&k.t()?)? * scale)?.broadcast_add(mask)?;
        let e = logits.broadcast_sub(&logits.detach().max_keepdim(D::Minus1)?)?.exp()?;
        e.broadcast_div(&e.sum_keepdim(D::Minus1)?)?.matmul(v)
    }

    fn mask(labels: &Labels, rows: usize, l: usize, m: usize) -> Result<Tensor> {
        let mut out = Vec::new();
        for r in 0..rows {
            let w = r % labels.windows;
            for i in 0..l {
                for j in 0..m {
                    let same = labels.queries[w * l + i] == labels.keys[w * m + j];
                    out.push(if same { 0f32 } else { -100.0 });
                }
            }
        }
        Tensor::from_vec(out, (rows, l, m), &Device::Cpu)
    }

    #[test]
    fn agrees_with_the_definition_in_value_and_gradient() -> Result<()> {
        let (r, l, m, d, e) = (4, 150, 37, 8, 5);
        let dev = &Device::Cpu;
        let labels = Labels {
            windows: 2,
            queries: (0..2 * l).map(|i| (i % 3) as u8).collect(),
            keys: (0..2 * m).map(|i| (i / 20 % 3) as u8).collect(),
        };
        let q = Var::randn(0f32, 1.5, (r, l, d), dev)?;
        let k = Var::randn(0f32, 1.5, (r, m, d), dev)?;
        let v = Var::randn(0f32, 1.0, (r, m, e), dev)?;
        let weights = Tensor::randn(0f32, 1.0, (r, l, e), dev)?;
        for labels in [None, Some(labels)] {
            let extra = match &labels {
                Some(labels) => mask(labels, r, l, m)?,
                None => Tensor::zeros((r, l, m), DType::F32, dev)?,
            };
            let got = attention(&q, &k, &v, 0.35, labels)?;
            let want = oracle(&q, &k, &v, 0.35, &extra)?;
            let far = |a: &Tensor, b: &Tensor| -> Result<f32> {
                (a - b)?.abs()?.flatten_all()?.max(0)?.to_scalar()
            };
            assert!(far(&got, &want)? < 1e-5);
            let got = (got * &weights)?.sum_all()?.backward()?;
            let want = (want * &weights)?.sum_all()?.backward()?;
            for var in [&q, &k, &v] {
                assert!(far(got.get(var).unwrap(), want.get(var).unwrap())? < 5e-5);
            }
        }
        Ok(())
    }

    #[test]
    fn misfits_are_named() -> Result<()> {
        let t = |a, b, c| Tensor::zeros((a, b, c), DType::F32, &Device::Cpu);
        let (q, k) = (t(2, 3, 4)?, t(2, 5, 4)?);
        assert!(attention(&q, &k, &t(2, 6, 4)?, 1.0, None).is_err());
        let labels = Labels { windows: 2, queries: vec![0; 6], keys: vec![0; 9] };
        let e = attention(&q, &k, &k, 1.0, Some(labels)).unwrap_err().to_string();
        assert!(e.contains("labels"), "{e}");
        Ok(())
    }
}
