//! Plane sweep (fused warp and correlation) as a candle op. Kernel:
//! [`subsplat_kernels::cpu::plane_sweep`]. Gradients reach both feature maps; the sampling grid
//! carries none, as in MVSplat.

use super::{Backend, borrowed, elements, output, slice};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use glam::{Mat3, Mat4};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::plane_sweep as cpu;
pub use subsplat_kernels::cpu::plane_sweep::{Pair, Sweep};
use subsplat_kernels::cpu::zeros;

/// The map from pixels and depths of a reference view to pixels of a source view,
/// whose features are row `row` of the op's second tensor. `relative` maps reference
/// camera coordinates to source camera coordinates; `projection` are the intrinsics
/// of the source (MVSplat takes the reference's). Intrinsics are those of the feature
/// maps ([`Intrinsics::resized`]).
///
/// # Errors
/// Intrinsics or a pose with numbers that are not finite, or without inverse.
pub fn pair(
    reference: &Intrinsics,
    projection: &Intrinsics,
    relative: Mat4,
    row: usize,
) -> Result<Pair> {
    let (r, k) = (reference, projection);
    let inverse = [1.0 / r.fx, 1.0 / r.fy, -r.cx / r.fx, -r.cy / r.fy];
    let k = [k.fx, k.fy, k.cx, k.cy];
    if !relative.is_finite() || inverse.iter().chain(&k).any(|v| !v.is_finite()) {
        bail!(
            "plane sweep cameras: expected finite, invertible intrinsics and pose, got \
             {reference:?}, {projection:?}, {relative:?}"
        );
    }
    let t = relative.w_axis.truncate().to_array();
    let rotation = Mat3::from_mat4(relative).transpose().to_cols_array();
    Ok(Pair { source: row, inverse, rotation, t, k })
}

/// source_camera_from_reference_camera: inv(E_s)·E_r, in f64.
pub fn relative_pose(reference: &Camera, source: &Camera) -> Mat4 {
    let inverse = source.world_from_camera().as_dmat4().inverse();
    (inverse * reference.world_from_camera().as_dmat4()).as_mat4()
}

/// Correlation `[R, D, h, w]` of `reference` `[R, C, h, w]` with `source`
/// `[S, C, h, w]`.
///
/// # Errors
/// Shapes, pairs or depths that do not fit one another; a dtype other than f32.
pub fn plane_sweep(reference: &Tensor, source: &Tensor, sweep: Sweep) -> Result<Tensor> {
    plane_sweep_on(&Backend::Cpu, reference, source, sweep)
}

/// [`plane_sweep`] and its gradients on `backend`.
///
/// # Errors
/// Those of [`plane_sweep`].
pub fn plane_sweep_on(
    backend: &Backend,
    reference: &Tensor,
    source: &Tensor,
    sweep: Sweep,
) -> Result<Tensor> {
    let (r, c, h, w) = reference.dims4()?;
    let (s, ..) = source.dims4()?;
    if source.dims()[1..] != [c, h, w] || sweep.channels != c || sweep.size != [h, w] {
        bail!(
            "plane sweep: expected reference and source [.., {}, {}, {}], got {:?} and {:?}",
            sweep.channels,
            sweep.size[0],
            sweep.size[1],
            reference.dims(),
            source.dims()
        );
    }
    let d = sweep.candidates();
    if sweep.depths.len() != r
        || sweep.pairs.len() != r
        || sweep.depths.iter().any(|x| x.len() != d)
    {
        bail!(
            "plane sweep: expected pairs and {d} depths for each of {r} rows, got {} and {}",
            sweep.pairs.len(),
            sweep.depths.len()
        );
    }
    if let Some(p) = sweep.pairs.iter().flatten().find(|p| p.source >= s) {
        bail!("plane sweep pair: expected a source row below {s}, got {}", p.source);
    }
    reference.contiguous()?.apply_op2(&source.contiguous()?, Op(sweep, backend.clone()))
}

/// Share of the pairs of each reference pixel and candidate that fall inside their
/// source picture, `[R, D, h, w]`. Constant: no gradient flows to cameras.
///
/// # Errors
/// candle's error of the allocation.
pub fn validity(sweep: &Sweep) -> Result<Tensor> {
    let [h, w] = sweep.size;
    let r = sweep.pairs.len();
    let d = sweep.candidates();
    let mut out = zeros(r * d * h * w);
    cpu::validity(sweep, &mut out);
    Tensor::from_vec(out, (r, d, h, w), &candle_core::Device::Cpu)
}

/// The warped source features of some candidates, `[R, C, candidates, h, w]`: for
/// inspection; the sweep itself never makes them.
///
/// # Errors
/// A candidate or pair out of range.
pub fn warped(source: &Tensor, sweep: &Sweep, pair: usize, candidates: &[usize]) -> Result<Tensor> {
    let [h, w] = sweep.size;
    let c = sweep.channels;
    let r = sweep.pairs.len();
    if candidates.iter().any(|&k| k >= sweep.candidates()) {
        bail!("plane sweep: expected candidates below {}, got {candidates:?}", sweep.candidates());
    }
    let source = elements::<f32>(source)?;
    let mut planes = Vec::new();
    for row in 0..r {
        for &k in candidates {
            let plane = cpu::warp(sweep, row, pair, k, &source);
            planes.push(Tensor::from_vec(plane, (c, h, w), &candle_core::Device::Cpu)?);
        }
    }
    Tensor::stack(&planes, 0)?.reshape((r, candidates.len(), c, h, w))?.transpose(1, 2)
}

struct Op(Sweep, Backend);

impl Op {
    fn gradients(&self, reference: &[f32], source: &[f32], grad: &[f32]) -> (Vec<f32>, Vec<f32>) {
        #[cfg(feature = "gpu")]
        {
            let args = subsplat_kernels::gpu::PlaneSweepArgs { sweep: &self.0, reference, source };
            if let Some(done) = self.1.offload(|gpu| gpu.plane_sweep_backward(&args, grad)) {
                return done;
            }
        }
        cpu::backward(&self.0, reference, source, grad)
    }
}

impl CustomOp2 for Op {
    fn name(&self) -> &'static str {
        "plane-sweep"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let reference = slice::<f32>("plane-sweep", "reference", s1, l1)?;
        let source = slice::<f32>("plane-sweep", "source", s2, l2)?;
        let [h, w] = self.0.size;
        let r = l1.dims()[0];
        let d = self.0.candidates();
        #[cfg(feature = "gpu")]
        {
            let args = subsplat_kernels::gpu::PlaneSweepArgs { sweep: &self.0, reference, source };
            if let Some(out) = self.1.offload(|gpu| gpu.plane_sweep(&args)) {
                return output(out, (r, d, h, w));
            }
        }
        let mut out = zeros(r * d * h * w);
        cpu::correlation(&self.0, reference, source, &mut out);
        output(out, (r, d, h, w))
    }

    fn bwd(
        &self,
        reference: &Tensor,
        source: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grad = grad.contiguous()?;
        let run = |[f, g, grad]: [&[f32]; 3]| self.gradients(f, g, grad);
        let (d_f, d_g) = borrowed("plane sweep", [reference, source, &grad], run)?;
        let device = reference.device();
        Ok((
            Some(Tensor::from_vec(d_f, reference.dims(), device)?),
            Some(Tensor::from_vec(d_g, source.dims(), device)?),
        ))
    }
}
