//! Sub-pixel Gaussian reparameterization as a candle op with its gradient, and into
//! buffers of the caller's. Formulas and layouts: [`subsplat_kernels::cpu::spgr`]; the same
//! unfused: `tests/support/src/spgr_reference.rs`. Tests: tests/spgr/spgr.rs,
//! tests/spgr/spgr_backward.rs.

use super::{Backend, Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Storage, Tensor, bail};
use std::sync::{Arc, Mutex};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::spgr as cpu;
use subsplat_kernels::layout::{HEAD_STRIDE, SPLAT_STRIDE};

pub use cpu::{CHILDREN_MAX, Rules};

const NAME: &str = "spgr";

/// One call's constants.
#[derive(Clone, Debug)]
pub struct Spgr {
    /// Rules in numbers.
    pub rules: Rules,
    /// V context cameras, pixels of the input pictures.
    pub cameras: Vec<Camera>,
    /// Near plane of each view, world units.
    pub near: Vec<f32>,
    /// Parents per view.
    pub per_view: usize,
    /// Index of parent 0 of this call in the scene.
    pub first: usize,
}

impl Spgr {
    pub(super) fn check(&self, head: &Tensor, parents: &Tensor) -> Result<usize> {
        let n = parents.dim(0)?;
        let k = self.rules.children();
        if k == 0 || k > CHILDREN_MAX {
            bail!("{NAME}: expected 1 to {CHILDREN_MAX} children per parent, got {k}");
        }
        if parents.dims() != [n, SPLAT_STRIDE] || head.dims() != [n, k, HEAD_STRIDE] {
            bail!(
                "{NAME}: expected parents [N, {SPLAT_STRIDE}] and head records \
                 [N, {k}, {HEAD_STRIDE}], got {:?} and {:?}",
                parents.dims(),
                head.dims()
            );
        }
        if self.cameras.is_empty() || self.near.len() != self.cameras.len() || self.per_view == 0 {
            bail!(
                "{NAME}: expected one near plane per camera and parents in every view, got {} \
                 cameras, {} near planes, {} parents per view",
                self.cameras.len(),
                self.near.len(),
                self.per_view
            );
        }
        Ok(n)
    }

    pub(super) fn source(&self) -> cpu::Source<'_> {
        let Self { cameras, near, per_view, first, .. } = self;
        cpu::Source { cameras, near, per_view: *per_view, first: *first }
    }
}

/// Children `[N·K, 11]` and gains `[N·K]` or `[N·K, 4]` of `parents` `[N, 11]` with
/// head records `head` `[N, K, 11]`; `f32` or `f64`. Differentiable in both; no
/// gradient passes the choice of the primary view, the growth of footprints that are
/// too small, and the share of a disc step.
///
/// # Errors
/// Shapes that do not fit one another, or an input that gives a number that is not
/// finite (named by parent and child).
pub fn spgr(head: &Tensor, parents: &Tensor, call: &Spgr) -> Result<(Tensor, Tensor)> {
    spgr_on(&Backend::Cpu, head, parents, call)
}

/// [`spgr`] and its gradients on `backend`.
///
/// # Errors
/// Those of [`spgr`].
pub fn spgr_on(
    backend: &Backend,
    head: &Tensor,
    parents: &Tensor,
    call: &Spgr,
) -> Result<(Tensor, Tensor)> {
    let n = call.check(head, parents)?;
    let (head, parents) = (head.contiguous()?, parents.contiguous()?);
    let made = Made::default();
    let children = Children(call.clone(), made.clone(), backend.clone());
    let rows = head.apply_op2(&parents, children)?;
    let count = n * call.rules.children();
    let backend = backend.clone();
    let gains = head.apply_op1(Gains { rules: call.rules, count, made, backend })?;
    Ok((rows, gains))
}

/// Gains that [`Children`], whose forward pass computes both results, stores for [`Gains`]. They are
/// two ops because the gradient of a part of one packed result is a padded copy of the whole.
type Made = Arc<Mutex<Option<CpuStorage>>>;

/// [`spgr`] of `f32` tensors into `rows` (N·K·11 floats) and `gains` (N·K or N·K·4).
///
/// # Errors
/// Those of [`spgr`], and buffers of another length.
pub fn spgr_into(
    head: &Tensor,
    parents: &Tensor,
    call: &Spgr,
    rows: &mut [f32],
    gains: &mut [f32],
) -> Result<()> {
    spgr_into_on(&Backend::Cpu, head, parents, call, (rows, gains))
}

/// [`spgr_into`] on `backend`.
///
/// # Errors
/// Those of [`spgr_into`].
pub fn spgr_into_on(
    backend: &Backend,
    head: &Tensor,
    parents: &Tensor,
    call: &Spgr,
    (rows, gains): (&mut [f32], &mut [f32]),
) -> Result<()> {
    let n = call.check(head, parents)?;
    let count = n * call.rules.children();
    let expected = (count * SPLAT_STRIDE, count * call.rules.gain_channels());
    if (rows.len(), gains.len()) != expected {
        let got = (rows.len(), gains.len());
        bail!("{NAME}: expected buffers of {expected:?} floats, got {got:?}");
    }
    let (head, parents) = (head.contiguous()?, parents.contiguous()?);
    let (hs, hl) = head.storage_and_layout();
    let (ps, pl) = parents.storage_and_layout();
    let (Storage::Cpu(hs), Storage::Cpu(ps)) = (&*hs, &*ps) else {
        bail!("{NAME}: expected tensors on the CPU")
    };
    let head = slice::<f32>(NAME, "head records", hs, hl)?;
    let parents = slice::<f32>(NAME, "parents", ps, pl)?;
    #[cfg(feature = "gpu")]
    if let Some((made, gained)) = backend.offload(|gpu| gpu.spgr(&call.on_gpu(head, parents))) {
        finite(call, head, parents, &made, &gained)?;
        rows.copy_from_slice(&made);
        gains.copy_from_slice(&gained);
        return Ok(());
    }
    #[cfg(not(feature = "gpu"))]
    let Backend::Cpu = backend;
    run(call, head, parents, rows, gains)
}

/// The kernel, and a refusal of numbers that are not finite.
fn run<T: Number>(
    call: &Spgr,
    head: &[T],
    parents: &[T],
    rows: &mut [T],
    gains: &mut [T],
) -> Result<()> {
    let args = cpu::Args { rules: &call.rules, source: call.source(), head, parents };
    if cpu::forward(args, rows, gains) { Ok(()) } else { finite(call, head, parents, rows, gains) }
}

/// Refuses numbers that are not finite, on the way in (an infinite opacity would be
/// capped, an infinite gain squashed: wrong results without an error) and on the way out.
pub(super) fn finite<T: Number>(
    call: &Spgr,
    head: &[T],
    parents: &[T],
    rows: &[T],
    gains: &[T],
) -> Result<()> {
    let bad =
        |data: &[T], width: usize| data.iter().position(|v| !finite_number(*v)).map(|i| i / width);
    let k = call.rules.children();
    if let Some(n) = bad(parents, SPLAT_STRIDE) {
        let row = &parents[n * SPLAT_STRIDE..(n + 1) * SPLAT_STRIDE];
        bail!("{NAME}: expected finite parents, got parent {} = {row:?}", call.first + n);
    }
    let (record, child) = (bad(head, HEAD_STRIDE), bad(rows, SPLAT_STRIDE));
    let child = child.or(bad(gains, call.rules.gain_channels()));
    let (what, at) = match (record, child) {
        (Some(i), _) => ("head records", i),
        (None, Some(i)) => ("children", i),
        (None, None) => return Ok(()),
    };
    let n = at / k;
    bail!(
        "{NAME}: expected finite {what}, got child {} of parent {} = {:?} from parent {:?} and \
         head record {:?}",
        at % k,
        call.first + n,
        &rows[at * SPLAT_STRIDE..(at + 1) * SPLAT_STRIDE],
        &parents[n * SPLAT_STRIDE..(n + 1) * SPLAT_STRIDE],
        &head[at * HEAD_STRIDE..(at + 1) * HEAD_STRIDE]
    )
}

fn finite_number<T: Number>(v: T) -> bool {
    subsplat_kernels::cpu::simd::Real::is_finite(v)
}

/// Children `[N·K, 11]` of head records and parents.
struct Children(Spgr, Made, Backend);

impl CustomOp2 for Children {
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
        #[cfg(feature = "gpu")]
        if let Some(done) = on_gpu(self, (s1, l1), (s2, l2))? {
            return Ok(done);
        }
        by_dtype!(NAME, s1.dtype(), forward(self, (s1, l1), (s2, l2)))
    }

    fn bwd(
        &self,
        head: &Tensor,
        parents: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        #[cfg(feature = "gpu")]
        if let Some(done) = gradients_on_gpu(self, head, parents, grad)? {
            return Ok(done);
        }
        by_dtype!(NAME, head.dtype(), backward(&self.0, head, parents, grad))
    }
}

fn forward<T: Number>(
    Children(call, made, _): &Children,
    (s1, l1): (&CpuStorage, &Layout),
    (s2, l2): (&CpuStorage, &Layout),
) -> Result<(CpuStorage, Shape)> {
    let head = slice::<T>(NAME, "head records", s1, l1)?;
    let parents = slice::<T>(NAME, "parents", s2, l2)?;
    let count = l2.dims()[0] * call.rules.children();
    let mut rows = vec![T::default(); count * SPLAT_STRIDE];
    let mut gains = vec![T::default(); count * call.rules.gain_channels()];
    run(call, head, parents, &mut rows, &mut gains)?;
    if let Ok(mut made) = made.lock() {
        *made = Some(T::to_cpu_storage_owned(gains));
    }
    Ok((T::to_cpu_storage_owned(rows), Shape::from((count, SPLAT_STRIDE))))
}

fn backward<T: Number>(
    call: &Spgr,
    head: &Tensor,
    parents: &Tensor,
    grad: &Tensor,
) -> Result<(Option<Tensor>, Option<Tensor>)> {
    let grad = grad.contiguous()?;
    let mut d_head = vec![T::default(); head.elem_count()];
    let mut d_parents = vec![T::default(); parents.elem_count()];
    borrowed::<T, (), 3>(NAME, [head, parents, &grad], |[head, parents, grad]| {
        let args = cpu::Args { rules: &call.rules, source: call.source(), head, parents };
        cpu::backward(args, grad, &mut d_head, &mut d_parents);
    })?;
    let device = head.device();
    Ok((
        Some(Tensor::from_vec(d_head, head.dims(), device)?),
        Some(Tensor::from_vec(d_parents, parents.dims(), device)?),
    ))
}

#[cfg(feature = "gpu")]
impl Spgr {
    pub(super) fn on_gpu<'a>(
        &'a self,
        head: &'a [f32],
        parents: &'a [f32],
    ) -> subsplat_kernels::gpu::SpgrArgs<'a> {
        let Self { rules, cameras, near, per_view, first } = self;
        let (per_view, first) = (*per_view, *first);
        subsplat_kernels::gpu::SpgrArgs { rules, cameras, near, per_view, first, head, parents }
    }
}

/// [`forward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn on_gpu(
    Children(call, made, backend): &Children,
    (s1, l1): (&CpuStorage, &Layout),
    (s2, l2): (&CpuStorage, &Layout),
) -> Result<Option<(CpuStorage, Shape)>> {
    if s1.dtype() != candle_core::DType::F32 {
        return Ok(None);
    }
    let head = slice::<f32>(NAME, "head records", s1, l1)?;
    let parents = slice::<f32>(NAME, "parents", s2, l2)?;
    let done = backend.offload(|gpu| gpu.spgr(&call.on_gpu(head, parents)));
    let Some((rows, gains)) = done else { return Ok(None) };
    finite(call, head, parents, &rows, &gains)?;
    if let Ok(mut made) = made.lock() {
        *made = Some(CpuStorage::F32(gains));
    }
    let count = l2.dims()[0] * call.rules.children();
    Ok(Some((CpuStorage::F32(rows), Shape::from((count, SPLAT_STRIDE)))))
}

/// [`backward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn gradients_on_gpu(
    Children(call, _, backend): &Children,
    head: &Tensor,
    parents: &Tensor,
    grad: &Tensor,
) -> Result<Option<(Option<Tensor>, Option<Tensor>)>> {
    if head.dtype() != candle_core::DType::F32 {
        return Ok(None);
    }
    let grad = grad.contiguous()?;
    let done = borrowed::<f32, _, 3>(NAME, [head, parents, &grad], |[head, parents, grad]| {
        backend.offload(|gpu| gpu.spgr_backward(&call.on_gpu(head, parents), grad))
    })?;
    let Some((d_head, d_parents)) = done else { return Ok(None) };
    let device = head.device();
    Ok(Some((
        Some(Tensor::from_vec(d_head, head.dims(), device)?),
        Some(Tensor::from_vec(d_parents, parents.dims(), device)?),
    )))
}

/// [`gains_backward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn gains_gradients_on_gpu(gains: &Gains, head: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
    if head.dtype() != candle_core::DType::F32 {
        return Ok(None);
    }
    let grad = grad.contiguous()?;
    let done = borrowed::<f32, _, 2>(NAME, [head, &grad], |[head, grad]| {
        gains.backend.offload(|gpu| gpu.spgr_gains_backward(&gains.rules, head, grad))
    })?;
    done.map(|d| Tensor::from_vec(d, head.dims(), head.device())).transpose()
}

/// Gains `[N·K]` or `[N·K, 4]` of head records.
struct Gains {
    rules: Rules,
    /// N·K.
    count: usize,
    made: Made,
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "the GPU's path reads it"))]
    backend: Backend,
}

impl CustomOp1 for Gains {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        let made = self.made.lock().ok().and_then(|mut made| made.take());
        let Some(gains) = made else { bail!("{NAME}: expected the gains of this call, got none") };
        let shape = match self.rules.gain_channels() {
            1 => Shape::from(self.count),
            lanes => Shape::from((self.count, lanes)),
        };
        Ok((gains, shape))
    }

    fn bwd(&self, head: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        #[cfg(feature = "gpu")]
        if let Some(done) = gains_gradients_on_gpu(self, head, grad)? {
            return Ok(Some(done));
        }
        by_dtype!(NAME, head.dtype(), gains_backward(&self.rules, head, grad))
    }
}

fn gains_backward<T: Number>(
    rules: &Rules,
    head: &Tensor,
    grad: &Tensor,
) -> Result<Option<Tensor>> {
    let grad = grad.contiguous()?;
    let mut d_head = vec![T::default(); head.elem_count()];
    borrowed::<T, (), 2>(NAME, [head, &grad], |[head, grad]| {
        cpu::gains_backward(rules, head, grad, &mut d_head);
    })?;
    Ok(Some(Tensor::from_vec(d_head, head.dims(), head.device())?))
}
