//! Rasterization as a candle operation.
//!
//! In: `splats[N, 11]`, `sh[P, D, 3]` (splat i reads set i / (N/P)), `gain[N]` or
//! `[N, 4]`, all f32, contiguous, on the CPU. Out: `[5, H, W]`: RGB over the
//! background, accumulated alpha, Σ w·z. The camera and the options ride in the op.
//! No gradient: `backward` through the result is an error.

use crate::abi::{Convention, RasterOptions, SH_DEGREE_MAX, SPLAT_LANES, sh_coefficients};
use crate::camera::Camera;
use crate::cpu::{Geometry, Rasterizer, SplatSlices};
use candle_core::{CpuStorage, CustomOp3, DType, Layout, Result, Shape, Tensor, bail};

struct Rasterize {
    camera: Camera,
    options: RasterOptions,
}

/// Renders packed splats: `[5, H, W]` planes R, G, B, alpha, Σ w·z.
///
/// # Errors
/// A tensor of the wrong shape, dtype, layout or device, a camera or an option
/// outside its range: named, with what was expected and what came.
pub fn rasterize(
    splats: &Tensor,
    sh: &Tensor,
    gain: &Tensor,
    camera: &Camera,
    options: &RasterOptions,
) -> Result<Tensor> {
    check_shapes(splats, sh, gain)?;
    check_options(camera, options)?;
    splats.apply_op3(sh, gain, Rasterize { camera: *camera, options: *options })
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
    let &[n, SPLAT_LANES] = splats.dims() else {
        bail!("rasterize: expected splats [N, {SPLAT_LANES}], got {:?}", splats.dims())
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

fn check_options(camera: &Camera, options: &RasterOptions) -> Result<()> {
    camera.intrinsics.check().map_err(candle_core::Error::wrap)?;
    if !camera.world_from_camera.is_finite() {
        bail!("rasterize: expected a finite camera pose, got {:?}", camera.world_from_camera);
    }
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
fn degree_of(d: usize) -> Option<usize> {
    (0..=SH_DEGREE_MAX).find(|&l| sh_coefficients(l) == d)
}

fn floats<'a>(name: &str, storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(&storage.as_slice::<f32>()?[from..to]),
        None => bail!("rasterize: expected {name} contiguous, got strides {:?}", layout.stride()),
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
        let mut out = Vec::new();
        Rasterizer::new().render_planes(&slices, &self.camera, &self.options, &mut out);
        let k = self.camera.intrinsics;
        Ok((CpuStorage::F32(out), (5, k.height, k.width).into()))
    }
}
