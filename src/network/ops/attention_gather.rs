//! Fused attention over bilinear samples of feature maps as one candle op, with
//! gradients for maps, query and points (SubSplat A.2). Formulas and
//! layouts: [`subsplat_kernels::cpu::attention_gather`]. Tests: tests/network/attention_gather.rs.

use super::{Backend, Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp3, DType, Layout, Result, Shape, Storage, Tensor, bail};
use std::sync::{Arc, Mutex, PoisonError};
use subsplat_kernels::cpu::attention_gather as cpu;

pub use cpu::{Drop, Gather, Level};

const NAME: &str = "attention_gather";

/// Attention output `[N, E]`. `maps` `[cells, stride]`, `query` `[N, Q]`, `points`
/// `[N, V, M or L·M, 2]`, all `f32` or all `f64`; layouts at
/// [`subsplat_kernels::cpu::attention_gather`], sizes by `gather`.
///
/// # Errors
/// Shapes that do not fit `gather` or one another, mixed dtypes.
pub fn attention_gather(
    maps: &Tensor,
    query: &Tensor,
    points: &Tensor,
    gather: Gather,
) -> Result<Tensor> {
    attention_gather_on(&Backend::Cpu, maps, query, points, gather)
}

/// [`attention_gather`] and its gradients on `backend`.
///
/// # Errors
/// Those of [`attention_gather`].
pub fn attention_gather_on(
    backend: &Backend,
    maps: &Tensor,
    query: &Tensor,
    points: &Tensor,
    gather: Gather,
) -> Result<Tensor> {
    attention_gather_deferred(backend, maps, query, points, gather, None)
}

/// The maps' gradient of calls of [`attention_gather_deferred`], as the factors that each
/// parent adds to its cells. A chunk of parents samples few of the cells; a dense gradient of
/// every chunk would be mostly zeros.
#[derive(Clone, Debug, Default)]
pub struct Deferred(Arc<Mutex<Vec<Part>>>);

/// Of one call.
#[derive(Debug)]
struct Part {
    gather: Gather,
    scatters: Vec<cpu::Scatter<f32>>,
    query: Vec<f32>,
    grad: Vec<f32>,
}

impl Deferred {
    /// Adds the results of the backward passes since the last call to `maps`
    /// `[cells, stride]`, and clears them.
    ///
    /// # Errors
    /// `maps` of another length than the maps had.
    pub fn add_to(&self, maps: &mut [f32]) -> Result<()> {
        let parts = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        for part in parts {
            let Part { gather, scatters, query, grad } = part;
            let cells = scatters.iter().flat_map(|s| s.cells()).max().map_or(0, |last| last + 1);
            if maps.len() < cells * gather.stride {
                let expected = cells * gather.stride;
                bail!("{NAME} deferred: expected maps of {expected} or more, got {}", maps.len());
            }
            cpu::scatter_into(&gather, &scatters, (&query, &grad), maps);
        }
        Ok(())
    }
}

/// [`attention_gather_on`] whose gradient of the maps goes to `deferred`, where there is
/// one, instead of candle's graph (f32; then computed on the CPU).
///
/// # Errors
/// Those of [`attention_gather`].
pub fn attention_gather_deferred(
    backend: &Backend,
    maps: &Tensor,
    query: &Tensor,
    points: &Tensor,
    gather: Gather,
    deferred: Option<&Deferred>,
) -> Result<Tensor> {
    let g = &gather;
    let rows = query.dim(0)?;
    let level_ends = |l: &Level| l.first_cell + g.views * l.height * l.width;
    if g.groups == 0 || !g.dim.is_multiple_of(g.groups) || g.points == 0 || g.views == 0 {
        bail!("{NAME}: expected groups that divide E, points and views, got {g:?}");
    }
    let channels = g.dim + g.value.max(g.key.unwrap_or(0));
    let expected = g.levels.iter().map(level_ends).max().unwrap_or(0);
    let (cells, stride) = maps.dims2()?;
    if stride != g.stride || stride < channels || !stride.is_multiple_of(g.dim) || cells < expected
    {
        bail!(
            "{NAME} maps: expected [{expected}, {}] with {channels} channels in use, got {:?}",
            g.stride,
            maps.dims()
        );
    }
    let lane_ok = |start: usize| start.is_multiple_of(g.dim);
    if !lane_ok(g.value) || !g.key.is_none_or(lane_ok) {
        bail!("{NAME}: expected keys and values to start at multiples of E = {}", g.dim);
    }
    if query.dims() != [rows, g.query_width()] {
        bail!("{NAME} query: expected [N, {}], got {:?}", g.query_width(), query.dims());
    }
    let expected = [rows, g.views, g.points_width(), 2];
    if points.dims() != expected {
        bail!("{NAME} points: expected {expected:?}, got {:?}", points.dims());
    }
    let op = AttentionGather(gather, backend.clone(), deferred.cloned());
    maps.contiguous()?.apply_op3(&query.contiguous()?, &points.contiguous()?, op)
}

struct AttentionGather(Gather, Backend, Option<Deferred>);

impl CustomOp3 for AttentionGather {
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
        match s1.dtype() {
            DType::F32 => forward(&self.0, args, cpu::forward_f32),
            dtype => by_dtype!(NAME, dtype, forward(&self.0, args, cpu::forward)),
        }
    }

    fn bwd(
        &self,
        maps: &Tensor,
        query: &Tensor,
        points: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        if let (Some(deferred), DType::F32) = (&self.2, maps.dtype()) {
            return defer(&self.0, deferred, [maps, query, points, grad]);
        }
        #[cfg(feature = "gpu")]
        if let Some(done) = gradients_on_gpu(self, [maps, query, points, grad])? {
            return Ok(done);
        }
        by_dtype!(NAME, maps.dtype(), backward(&self.0, [maps, query, points, grad]))
    }
}

/// Maps, query, points and the result, as [`cpu::forward`].
type Run<T> = fn(&Gather, &[T], &[T], &[T], &mut [T]);

fn forward<T: Number>(
    g: &Gather,
    [maps, query, points]: [(&CpuStorage, &Layout); 3],
    run: Run<T>,
) -> Result<(CpuStorage, Shape)> {
    let rows = query.1.dims()[0];
    let maps = slice::<T>(NAME, "maps", maps.0, maps.1)?;
    let query = slice::<T>(NAME, "query", query.0, query.1)?;
    let points = slice::<T>(NAME, "points", points.0, points.1)?;
    let mut out = vec![T::default(); rows * g.dim];
    run(g, maps, query, points, &mut out);
    Ok((T::to_cpu_storage_owned(out), Shape::from((rows, g.dim))))
}

/// [`forward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn on_gpu(
    AttentionGather(gather, backend, _): &AttentionGather,
    [maps, query, points]: [(&CpuStorage, &Layout); 3],
) -> Result<Option<(CpuStorage, Shape)>> {
    if maps.0.dtype() != DType::F32 {
        return Ok(None);
    }
    let shape = Shape::from((query.1.dims()[0], gather.dim));
    let maps = slice::<f32>(NAME, "maps", maps.0, maps.1)?;
    let query = slice::<f32>(NAME, "query", query.0, query.1)?;
    let points = slice::<f32>(NAME, "points", points.0, points.1)?;
    let args = subsplat_kernels::gpu::AttentionGatherArgs { gather, maps, query, points };
    let done = backend.offload(|gpu| gpu.attention_gather(&args));
    Ok(done.map(|out| (CpuStorage::F32(out), shape)))
}

/// [`backward`] on the GPU; `None` where the CPU is to do it.
#[cfg(feature = "gpu")]
fn gradients_on_gpu(
    AttentionGather(gather, backend, _): &AttentionGather,
    [maps, query, points, grad]: [&Tensor; 4],
) -> Result<Option<Triple>> {
    if maps.dtype() != DType::F32 {
        return Ok(None);
    }
    let grad = grad.contiguous()?;
    let all = [maps, query, points, &grad];
    let done = borrowed::<f32, _, 4>(NAME, all, |[maps, query, points, grad]| {
        let args = subsplat_kernels::gpu::AttentionGatherArgs { gather, maps, query, points };
        backend.offload(|gpu| gpu.attention_gather_backward(&args, grad))
    })?;
    let Some(d) = done else { return Ok(None) };
    let device = maps.device();
    let points = if gather.point_gradient {
        Some(Tensor::from_vec(d.points, points.dims(), device)?)
    } else {
        None
    };
    Ok(Some((
        Some(Tensor::from_vec(d.maps, maps.dims(), device)?),
        Some(Tensor::from_vec(d.query, query.dims(), device)?),
        points,
    )))
}

/// [`backward`] but for the maps' part, which `deferred` keeps.
fn defer(
    g: &Gather,
    deferred: &Deferred,
    [maps, query, points, grad]: [&Tensor; 4],
) -> Result<Triple> {
    let device = maps.device();
    let grad = grad.contiguous()?;
    let all = [maps, query, points, &grad];
    let (part, d_query, d_points) = borrowed::<f32, _, 4>(NAME, all, |[m, q, p, o]| {
        let (scatters, d_query, d_points) = cpu::factors(g, m, q, p, o);
        let part = Part { gather: g.clone(), scatters, query: q.to_vec(), grad: o.to_vec() };
        (part, d_query, d_points)
    })?;
    deferred.0.lock().unwrap_or_else(PoisonError::into_inner).push(part);
    let points = if g.point_gradient {
        Some(Tensor::from_vec(d_points, points.dims(), device)?)
    } else {
        None
    };
    Ok((None, Some(Tensor::from_vec(d_query, query.dims(), device)?), points))
}

type Triple = (Option<Tensor>, Option<Tensor>, Option<Tensor>);

fn backward<T: Number>(g: &Gather, [maps, query, points, grad]: [&Tensor; 4]) -> Result<Triple> {
    let device = maps.device();
    let grad = grad.contiguous()?;
    let d = borrowed::<T, _, 4>(NAME, [maps, query, points, &grad], |[m, q, p, o]| {
        cpu::backward(g, m, q, p, o)
    })?;
    let points = if g.point_gradient {
        Some(Tensor::from_vec(d.points, points.dims(), device)?)
    } else {
        None
    };
    Ok((
        Some(Tensor::from_vec(d.maps, maps.dims(), device)?),
        Some(Tensor::from_vec(d.query, query.dims(), device)?),
        points,
    ))
}

/// Visibility `[N, V]` in [0, 1] of N points in V views by the views' own depth
/// maps: `points` `[N, V, 2]` in [0, 1]², their camera z `[N, V]`,
/// `depths` `[V, H, W]` camera z. A constant of the graph: no gradient passes.
///
/// # Errors
/// Shapes that do not fit one another, a dtype other than `f32`.
pub fn occlusion_gate(points: &Tensor, z: &Tensor, depths: &Tensor) -> Result<Tensor> {
    let (n, v, two) = points.dims3()?;
    let (views, height, width) = depths.dims3()?;
    if two != 2 || z.dims() != [n, v] || views != v {
        bail!(
            "occlusion gate: expected points [N, V, 2], z [N, V] and depths [V, H, W], got {:?}, \
             {:?} and {:?}",
            points.dims(),
            z.dims(),
            depths.dims()
        );
    }
    let dtype = points.dtype();
    let host = |t: &Tensor| t.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>();
    let (at, z) = (host(points)?, host(z)?);
    // Borrowed: every chunk of parents reads the same maps.
    let depths = depths.to_dtype(DType::F32)?.contiguous()?;
    let (storage, layout) = depths.storage_and_layout();
    let Storage::Cpu(storage) = &*storage else {
        bail!("occlusion gate depths: expected a tensor on the CPU")
    };
    let maps = slice::<f32>("occlusion gate", "depths", storage, layout)?;
    let area = height * width;
    let gate = |i: usize| {
        let map = cpu::DepthMap { z: &maps[i % v * area..(i % v + 1) * area], height, width };
        cpu::occlusion(map, [at[2 * i], at[2 * i + 1]], z[i])
    };
    let gates: Vec<f32> = (0..n * v).map(gate).collect();
    Tensor::from_vec(gates, (n, v), points.device())?.to_dtype(dtype)
}
