//! Rasterization as a candle operation.
//!
//! In: `splats[N, 11]`, `sh[P, D, 3]` (splat i reads set i / (N/P)), `gain[N]` or
//! `[N, 4]`, all f32, contiguous, on the CPU. Out: `[5, H, W]`: RGB over the
//! background, accumulated alpha, Σ w·z. The camera and the options are fields of the op.
//! Gradients reach all three inputs, exact for the piecewise function that the forward
//! is ([`subsplat_kernels::cpu::Gradients`]); the background's goes through [`over_background`].
//! Until its graph is dropped, an op keeps its lists (about 150 bytes a splat), so that
//! the backward pass need not make them again.

use super::SplatTensors;
use crate::network::ops::{Backend, elements, tensor_like};
use candle_core::{CpuStorage, CustomOp3, DType, Layout, Result, Shape, Tensor, bail};
use std::sync::{Mutex, PoisonError};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::{Geometry, Gradients, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{
    Convention, RasterOptions, SH_DEGREE_MAX, SPLAT_STRIDE, sh_coefficients,
};

struct Rasterize {
    camera: Camera,
    options: RasterOptions,
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "the GPU's path reads it"))]
    backend: Backend,
    left: Mutex<Left>,
}

/// Results of the forward pass.
#[derive(Default)]
struct Left {
    rasterizer: Rasterizer,
    /// Of a GPU that drew the picture.
    #[cfg(feature = "gpu")]
    frame: Option<subsplat_kernels::gpu::Frame>,
}

/// Renders packed splats: `[5, H, W]` planes R, G, B, alpha, Σ w·z.
///
/// # Errors
/// A tensor of the wrong shape, dtype, layout or device; an option outside its range.
pub fn rasterize(
    splats: &Tensor,
    sh: &Tensor,
    gain: &Tensor,
    camera: &Camera,
    options: &RasterOptions,
) -> Result<Tensor> {
    rasterize_on(&Backend::Cpu, splats, sh, gain, camera, options)
}

/// [`rasterize`] and its gradients on `backend`; a GPU keeps the frame until the graph is
/// dropped.
///
/// # Errors
/// Those of [`rasterize`].
pub fn rasterize_on(
    backend: &Backend,
    splats: &Tensor,
    sh: &Tensor,
    gain: &Tensor,
    camera: &Camera,
    options: &RasterOptions,
) -> Result<Tensor> {
    check_shapes(splats, sh, gain)?;
    check_options(options)?;
    let backend = backend.clone();
    let left = Mutex::default();
    let op = Rasterize { camera: *camera, options: *options, backend, left };
    splats.apply_op3(sh, gain, op)
}

/// [`rasterize`] of splats with everything that belongs to them: `[5, H, W]` planes R,
/// G, B, alpha, Σ w·z, with gradients to every tensor of `splats`. The SH basis is the
/// splats' own; `options.sh_basis` is not read.
///
/// # Errors
/// As [`rasterize`].
///
/// ```
/// use subsplat::network::candle_core::{Device, Tensor, Var};
/// use subsplat::{Camera, Intrinsics, RasterOptions, ShBasis};
/// use subsplat::SplatTensors;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let d = &Device::Cpu;
/// let means = Var::new(&[[0f32, 0.0, 2.0], [0.3, 0.1, 3.0]], d)?;
/// let quats = Tensor::new(&[[1f32, 0.0, 0.0, 0.0], [0.9, 0.1, 0.0, 0.2]], d)?;
/// let scales = Tensor::full(0.2f32, (2, 3), d)?;
/// let opacities = Tensor::full(0.8f32, 2, d)?;
/// let sh = Var::new(&[[[0.5f32, 0.1, -0.3]], [[-0.2, 0.4, 0.1]]], d)?;
/// let basis = ShBasis::Standard;
/// let splats = SplatTensors::from_parts(&means, &quats, &scales, &opacities, &sh, basis)?;
/// let k = Intrinsics { fx: 30.0, fy: 30.0, cx: 16.0, cy: 12.0, width: 32, height: 24 };
/// let camera = Camera::new(k, subsplat::glam::Mat4::IDENTITY)?;
/// let planes = subsplat::rasterize(&splats, &camera, &RasterOptions::default())?;
/// let rgb = planes.narrow(0, 0, 3)?;
/// let gradients = rgb.sqr()?.sum_all()?.backward()?;
/// assert!(gradients.get(&means).is_some() && gradients.get(&sh).is_some());
/// # Ok(())
/// # }
/// ```
pub fn rasterize_splats(
    splats: &SplatTensors,
    camera: &Camera,
    options: &RasterOptions,
) -> Result<Tensor> {
    let options = RasterOptions { sh_basis: splats.sh_basis, ..*options };
    let contiguous = |t: &Tensor| t.contiguous();
    let (rows, sh) = (contiguous(&splats.rows)?, contiguous(&splats.sh)?);
    let gain = match &splats.gain {
        Some(gain) => contiguous(gain)?,
        None => Tensor::ones(rows.dim(0)?, DType::F32, rows.device())?,
    };
    rasterize(&rows, &sh, &gain, camera, &options)
}

/// Puts planes `[5, H, W]` that were rendered over black before a `background` `[3]`:
/// RGB + (1 − alpha)·background, with gradients to both. For a background that is
/// learnt or sampled anew; a fixed one is a field of [`RasterOptions`].
///
/// # Errors
/// Tensors of other shapes.
pub fn over_background(planes: &Tensor, background: &Tensor) -> Result<Tensor> {
    let (&[5, _, _], &[3]) = (planes.dims(), background.dims()) else {
        bail!(
            "over_background: expected planes [5, H, W] and a background [3], got {:?} and {:?}",
            planes.dims(),
            background.dims()
        )
    };
    let alpha = planes.narrow(0, 3, 1)?;
    let behind = alpha.affine(-1.0, 1.0)?.broadcast_mul(&background.reshape((3, 1, 1))?)?;
    Tensor::cat(&[(planes.narrow(0, 0, 3)? + behind)?, planes.narrow(0, 3, 2)?], 0)
}

fn check_shapes(splats: &Tensor, sh: &Tensor, gain: &Tensor) -> Result<()> {
    for (name, t) in [("splats", splats), ("sh", sh), ("gain", gain)] {
        if t.dtype() != DType::F32 {
            bail!("rasterize: expected {name} of dtype F32, got {:?}", t.dtype());
        }
        if !t.device().is_cpu() {
            bail!("rasterize: expected {name} on the CPU, got {:?}", t.device().location());
        }
    }
    let &[n, SPLAT_STRIDE] = splats.dims() else {
        bail!("rasterize: expected splats [N, {SPLAT_STRIDE}], got {:?}", splats.dims())
    };
    let &[p, d, 3] = sh.dims() else {
        bail!("rasterize: expected sh [P, D, 3], got {:?}", sh.dims())
    };
    if degree_of(d).is_none() {
        bail!("rasterize: expected sh [P, D, 3] with D = 1, 4, 9, 16 or 25, got {:?}", sh.dims());
    }
    if (n == 0) != (p == 0) || (p > 0 && !n.is_multiple_of(p)) {
        bail!("rasterize: expected sh [P, D, 3] with P dividing N = {n}, got {:?}", sh.dims());
    }
    if gain.dims() != [n] && gain.dims() != [n, 4] {
        bail!("rasterize: expected gain [{n}] or [{n}, 4], got {:?}", gain.dims());
    }
    Ok(())
}

pub(crate) fn check_options(options: &RasterOptions) -> Result<()> {
    if options.sh_degree > SH_DEGREE_MAX {
        bail!("rasterize: expected sh_degree 0 to {SH_DEGREE_MAX}, got {}", options.sh_degree);
    }
    if !(options.lowpass >= 0.0 && options.lowpass.is_finite()) {
        bail!("rasterize: expected a low-pass of at least 0 px², got {}", options.lowpass);
    }
    if !(options.near > 0.0 && options.near.is_finite()) {
        bail!("rasterize: expected near > 0, got {}", options.near);
    }
    if options.antialiased && options.convention != Convention::Standard {
        bail!("rasterize: expected antialiased with the standard convention only, got mvsplat");
    }
    if options.background.iter().any(|v| !v.is_finite()) {
        bail!("rasterize: expected a finite background, got {:?}", options.background);
    }
    Ok(())
}

/// l with (l + 1)² = `d`.
pub(super) fn degree_of(d: usize) -> Option<usize> {
    (0..=SH_DEGREE_MAX).find(|&l| sh_coefficients(l) == d)
}

fn floats<'a>(name: &str, storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(&storage.as_slice::<f32>()?[from..to]),
        None => bail!("rasterize: expected {name} contiguous, got strides {:?}", layout.stride()),
    }
}

impl Rasterize {
    /// Draws on the GPU; `None` where the CPU is to do it.
    #[cfg(feature = "gpu")]
    fn frame(&self, splats: &SplatSlices) -> Option<(Vec<f32>, subsplat_kernels::gpu::Frame)> {
        self.backend.offload(|gpu| {
            let mut rasterizer = subsplat_kernels::gpu::Rasterizer::new(gpu.clone());
            rasterizer.frame(splats, &self.camera, &self.options)
        })
    }

    fn gradients(&self, splats: &SplatSlices, gradient: &[f32]) -> Gradients {
        let mut left = self.left.lock().unwrap_or_else(PoisonError::into_inner);
        let mut out = Gradients::default();
        let camera = &self.camera;
        let options = &self.options;
        #[cfg(feature = "gpu")]
        if let Some(frame) = &mut left.frame {
            return self.backend.offload(|_| frame.backward(gradient)).unwrap_or_else(|| {
                // The CPU has not drawn this frame.
                left.rasterizer.backward(splats, camera, options, gradient, &mut out);
                out
            });
        }
        left.rasterizer.backward_of_last(splats, camera, options, gradient, &mut out);
        out
    }
}

impl CustomOp3 for Rasterize {
    fn name(&self) -> &'static str {
        "rasterize"
    }

    fn cpu_fwd(
        &self,
        splats: &CpuStorage,
        splats_layout: &Layout,
        sh: &CpuStorage,
        sh_layout: &Layout,
        gain: &CpuStorage,
        gain_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (_, d, _) = sh_layout.shape().dims3()?;
        let Some(sh_degree) = degree_of(d) else {
            bail!("rasterize: expected sh with D = 1, 4, 9, 16 or 25 coefficients, got {d}")
        };
        let slices = SplatSlices {
            geometry: Geometry::Packed(floats("splats", splats, splats_layout)?),
            sh: floats("sh", sh, sh_layout)?,
            gain: floats("gain", gain, gain_layout)?,
            sh_degree,
        };
        let k = self.camera.intrinsics();
        let shape = Shape::from((5, k.height, k.width));
        let mut left = self.left.lock().unwrap_or_else(PoisonError::into_inner);
        #[cfg(feature = "gpu")]
        if let Some((planes, frame)) = self.frame(&slices) {
            left.frame = Some(frame);
            return Ok((CpuStorage::F32(planes), shape));
        }
        let mut out = Vec::new();
        left.rasterizer.render_planes(&slices, &self.camera, &self.options, &mut out);
        Ok((CpuStorage::F32(out), shape))
    }

    fn bwd(
        &self,
        splats: &Tensor,
        sh: &Tensor,
        gain: &Tensor,
        _planes: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(sh_degree) = degree_of(sh.dim(1)?) else {
            bail!("rasterize: expected sh with D = 1, 4, 9, 16 or 25, got {:?}", sh.dims())
        };
        let [rows, set, gains] =
            [elements::<f32>(splats)?, elements::<f32>(sh)?, elements::<f32>(gain)?];
        let slices =
            SplatSlices { geometry: Geometry::Packed(&rows), sh: &set, gain: &gains, sh_degree };
        let gradient = elements::<f32>(gradient)?;
        let out = self.gradients(&slices, &gradient);
        Ok((
            Some(tensor_like(out.rows, splats)?),
            Some(tensor_like(out.sh, sh)?),
            Some(tensor_like(out.gain, gain)?),
        ))
    }
}
