//! Opacity redistribution as a candle op, with its gradient (SubSplat, "Opacity
//! allocation"; supp. A.3). Formulas: [`subsplat_kernels::cpu::redistribute`].
//! Tests: tests/spgr/redistribute.rs (identities, finite differences in `f64`).

use super::{Backend, Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::redistribute as cpu;

pub use cpu::OpacityRule;

/// Opacities `[P, K]` of the children of P parents. `logits` `[P, K]`; `areas`
/// `[P, K]`, target px², with the rasterizer's low-pass for
/// [`OpacityRule::OpticalDepth`]; `opacities` `[P]` in [0, 1]; `parent_areas` `[P]`, the
/// parents' own footprints in the same unit, for [`OpacityRule::OpticalDepth`] and
/// [`OpacityRule::Area`] only. Differentiable in all four; `f32` or `f64`.
///
/// # Errors
/// Shapes or dtypes that do not fit one another; parent areas missing.
pub fn redistribute(
    rule: OpacityRule,
    logits: &Tensor,
    areas: &Tensor,
    opacities: &Tensor,
    parent_areas: Option<&Tensor>,
) -> Result<Tensor> {
    redistribute_on(&Backend::Cpu, rule, logits, areas, opacities, parent_areas)
}

/// [`redistribute`] and its gradient on `backend`.
///
/// # Errors
/// Those of [`redistribute`].
pub fn redistribute_on(
    backend: &Backend,
    rule: OpacityRule,
    logits: &Tensor,
    areas: &Tensor,
    opacities: &Tensor,
    parent_areas: Option<&Tensor>,
) -> Result<Tensor> {
    let (p, k) = logits.dims2()?;
    if areas.dims() != [p, k] || opacities.dims() != [p] {
        bail!(
            "redistribute: expected areas [{p}, {k}] and opacities [{p}] like logits, got {:?} \
             and {:?}",
            areas.dims(),
            opacities.dims()
        );
    }
    if k == 0 {
        bail!("redistribute: expected at least 1 child per parent, got 0");
    }
    let own = match (rule.areas_are_relative(), parent_areas) {
        (false, _) => None,
        (true, Some(own)) if own.dims() == [p] => Some(own),
        (true, Some(own)) => {
            bail!("redistribute: expected parent areas [{p}], got {:?}", own.dims())
        }
        (true, None) => bail!("redistribute: rule {rule:?} expects the parents' areas, got none"),
    };
    let per_parent = match own {
        Some(own) => Tensor::stack(&[opacities, own], 0)?,
        None => opacities.contiguous()?.unsqueeze(0)?,
    };
    let (logits, areas) = (logits.contiguous()?, areas.contiguous()?);
    logits.apply_op3(&areas, &per_parent, Redistribute(rule, backend.clone()))
}

/// On logits `[P, K]`, areas `[P, K]` and, `[1, P]` or `[2, P]`, the parents'
/// opacities and own areas.
struct Redistribute(OpacityRule, Backend);

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
        #[cfg(feature = "gpu")]
        if let Some(done) = on_gpu(self, args)? {
            return Ok(done);
        }
        by_dtype!(NAME, s1.dtype(), forward(self.0, args))
    }

    fn bwd(
        &self,
        logits: &Tensor,
        areas: &Tensor,
        per_parent: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let args = [logits, areas, per_parent, grad];
        #[cfg(feature = "gpu")]
        if let Some(done) = gradients_on_gpu(self, args)? {
            return Ok(done);
        }
        by_dtype!(NAME, logits.dtype(), backward(self.0, args))
    }
}

fn arguments<'a, T: Number>(
    rule: OpacityRule,
    logits: &Tensor2<'a, T>,
    areas: &'a [T],
    per_parent: &'a [T],
) -> cpu::Args<'a, T> {
    let (alphas, own) = per_parent.split_at(logits.parents);
    cpu::Args { rule, k: logits.k, logits: logits.data, areas, alphas, own }
}

/// Elements of `[parents, k]`.
struct Tensor2<'a, T> {
    data: &'a [T],
    parents: usize,
    k: usize,
}

fn forward<T: Number>(
    rule: OpacityRule,
    [logits, areas, per_parent]: [(&CpuStorage, &Layout); 3],
) -> Result<(CpuStorage, Shape)> {
    let shape = logits.1.shape().clone();
    let (parents, k) = shape.dims2()?;
    let data = slice::<T>(NAME, "logits", logits.0, logits.1)?;
    let areas = slice::<T>(NAME, "areas", areas.0, areas.1)?;
    let per_parent = slice::<T>(NAME, "opacities", per_parent.0, per_parent.1)?;
    let out = cpu::forward(arguments(rule, &Tensor2 { data, parents, k }, areas, per_parent));
    Ok((T::to_cpu_storage_owned(out), shape))
}

/// [`forward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn on_gpu(
    Redistribute(rule, backend): &Redistribute,
    [logits, areas, per_parent]: [(&CpuStorage, &Layout); 3],
) -> Result<Option<(CpuStorage, Shape)>> {
    if logits.0.dtype() != candle_core::DType::F32 {
        return Ok(None);
    }
    let shape = logits.1.shape().clone();
    let (parents, k) = shape.dims2()?;
    let logits = slice::<f32>(NAME, "logits", logits.0, logits.1)?;
    let areas = slice::<f32>(NAME, "areas", areas.0, areas.1)?;
    let per_parent = slice::<f32>(NAME, "opacities", per_parent.0, per_parent.1)?;
    let (alphas, own) = per_parent.split_at(parents);
    let args =
        subsplat_kernels::gpu::RedistributeArgs { rule: *rule, k, logits, areas, alphas, own };
    let done = backend.offload(|gpu| gpu.redistribute(&args));
    Ok(done.map(|out| (CpuStorage::F32(out), shape)))
}

type Triple = (Option<Tensor>, Option<Tensor>, Option<Tensor>);

fn backward<T: Number>(
    rule: OpacityRule,
    [logits, areas, per_parent, grad]: [&Tensor; 4],
) -> Result<Triple> {
    let (parents, k) = logits.dims2()?;
    let grad = grad.contiguous()?;
    let d = borrowed::<T, _, 4>(NAME, [logits, areas, per_parent, &grad], |[l, a, p, g]| {
        let l = Tensor2 { data: l, parents, k };
        cpu::backward(arguments(rule, &l, a, p), g)
    })?;
    let parts = [d.logits, d.areas, d.alphas, d.own];
    gradients(parts, [logits, per_parent])
}

/// Gradients as tensors like `logits` and `per_parent`.
fn gradients<T: Number>(
    [logits_grad, areas_grad, mut alphas, own]: [Vec<T>; 4],
    [logits, per_parent]: [&Tensor; 2],
) -> Result<Triple> {
    let device = logits.device();
    if per_parent.dim(0)? == 2 {
        alphas.extend(own);
    }
    Ok((
        Some(Tensor::from_vec(logits_grad, logits.dims(), device)?),
        Some(Tensor::from_vec(areas_grad, logits.dims(), device)?),
        Some(Tensor::from_vec(alphas, per_parent.dims(), device)?),
    ))
}

/// [`backward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn gradients_on_gpu(
    Redistribute(rule, backend): &Redistribute,
    [logits, areas, per_parent, grad]: [&Tensor; 4],
) -> Result<Option<Triple>> {
    if logits.dtype() != candle_core::DType::F32 {
        return Ok(None);
    }
    let (parents, k) = logits.dims2()?;
    let grad = grad.contiguous()?;
    let done = borrowed::<f32, _, 4>(NAME, [logits, areas, per_parent, &grad], |[l, a, p, g]| {
        let (alphas, own) = p.split_at(parents);
        let rule = *rule;
        let logits = l;
        let areas = a;
        let args = subsplat_kernels::gpu::RedistributeArgs { rule, k, logits, areas, alphas, own };
        backend.offload(|gpu| gpu.redistribute_backward(&args, g))
    })?;
    let parts = done.map(|d| [d.logits, d.areas, d.alphas, d.own]);
    parts.map(|parts| gradients(parts, [logits, per_parent])).transpose()
}
