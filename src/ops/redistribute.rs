//! Opacity redistribution as a candle op, with its gradient (SubSplat, "Opacity
//! allocation"; supp. A.3; spec 2.7 and 2.8). Formulas: [`crate::cpu::redistribute`].
//! Tests: tests/redistribute.rs (identities, finite differences in `f64`).

use super::{Number, by_dtype, elements, slice};
use crate::cpu::redistribute as cpu;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

pub use cpu::Rule;

/// Opacities `[P, K]` of the children of P parents. `logits` `[P, K]`; `areas`
/// `[P, K]`, target px², with the rasterizer's low-pass for
/// [`Rule::OpticalDepth`]; `opacities` `[P]` in [0, 1]; `parent_areas` `[P]`, the
/// parents' own footprints in the same unit, for [`Rule::OpticalDepth`] and
/// [`Rule::Area`] only. Differentiable in all four; `f32` or `f64`.
///
/// # Errors
/// Shapes or dtypes that do not fit one another; parent areas missing.
pub fn redistribute(
    rule: Rule,
    logits: &Tensor,
    areas: &Tensor,
    opacities: &Tensor,
    parent_areas: Option<&Tensor>,
) -> Result<Tensor> {
    let (p, k) = logits.dims2()?;
    if areas.dims() != [p, k] || opacities.dims() != [p] {
        bail!(
            "redistribute: expected areas [{p}, {k}] and opacities [{p}] like logits, got {:?} and {:?}",
            areas.dims(),
            opacities.dims()
        );
    }
    if k == 0 {
        bail!("redistribute: expected at least 1 child per parent, got 0");
    }
    let areas = match (rule.areas_are_relative(), parent_areas) {
        (false, _) => areas.clone(),
        (true, Some(own)) if own.dims() == [p] => areas.broadcast_div(&own.unsqueeze(1)?)?,
        (true, Some(own)) => {
            bail!("redistribute: expected parent areas [{p}], got {:?}", own.dims())
        }
        (true, None) => bail!("redistribute: rule {rule:?} expects the parents' areas, got none"),
    };
    let (logits, areas) = (logits.contiguous()?, areas.contiguous()?);
    logits.apply_op3(&areas, &opacities.contiguous()?, Redistribute(rule))
}

struct Redistribute(Rule);

const NAME: &str = "redistribute";

impl CustomOp3 for Redistribute {
    fn name(&self) -> &'static str {
        NAME
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
        let args = [(s1, l1), (s2, l2), (s3, l3)];
        by_dtype!(NAME, s1.dtype(), forward(self.0, args))
    }

    fn bwd(
        &self,
        logits: &Tensor,
        areas: &Tensor,
        opacities: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        by_dtype!(NAME, logits.dtype(), backward(self.0, [logits, areas, opacities, grad]))
    }
}

fn forward<T: Number>(
    rule: Rule,
    [logits, areas, alphas]: [(&CpuStorage, &Layout); 3],
) -> Result<(CpuStorage, Shape)> {
    let shape = logits.1.shape().clone();
    let (_, k) = shape.dims2()?;
    let logits = slice::<T>(NAME, "logits", logits.0, logits.1)?;
    let areas = slice::<T>(NAME, "areas", areas.0, areas.1)?;
    let alphas = slice::<T>(NAME, "opacities", alphas.0, alphas.1)?;
    let mut out = vec![T::default(); logits.len()];
    cpu::forward(rule, k, logits, areas, alphas, &mut out);
    Ok((T::to_cpu_storage_owned(out), shape))
}

type Triple = (Option<Tensor>, Option<Tensor>, Option<Tensor>);

fn backward<T: Number>(
    rule: Rule,
    [logits, areas, opacities, grad]: [&Tensor; 4],
) -> Result<Triple> {
    let (p, k) = logits.dims2()?;
    let device = logits.device();
    let (l, a) = (elements::<T>(logits)?, elements::<T>(areas)?);
    let (o, g) = (elements::<T>(opacities)?, elements::<T>(grad)?);
    let d = cpu::backward(rule, k, &l, &a, &o, &g);
    Ok((
        Some(Tensor::from_vec(d.logits, (p, k), device)?),
        Some(Tensor::from_vec(d.areas, (p, k), device)?),
        Some(Tensor::from_vec(d.alphas, p, device)?),
    ))
}
