//! From head records to one camera's picture without children in memory: no child
//! mean, quaternion, covariance or SH exists, only 2-D footprints. For inference; no gradient.
//! Kernels: [`subsplat_kernels::cpu::spgr::project`] and [`subsplat_kernels::cpu::Rasterizer::render_footprints`].

use super::rasterize::{check_options, degree_of};
use super::slice;
use super::spgr::{Spgr, spgr_into};
use candle_core::{Device, Result, Storage, Tensor, bail};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::Rasterizer;
use subsplat_kernels::cpu::spgr as cpu;
use subsplat_kernels::layout::{RasterOptions, SPLAT_STRIDE};

pub use subsplat_kernels::cpu::raster::ewa::Footprint;

const NAME: &str = "direct rendering";

/// Picture `[5, H, W]` (R, G, B, alpha, Σ w·z) of `count` splats whose footprints for
/// this camera and these options `fill` writes.
///
/// # Errors
/// An option outside its range; the error of `fill`.
pub fn rasterize_footprints(
    count: usize,
    camera: &Camera,
    options: &RasterOptions,
    fill: impl FnOnce(&mut [Footprint]) -> Result<()>,
) -> Result<Tensor> {
    check_options(options)?;
    let mut out = Vec::new();
    Rasterizer::new().render_footprints(count, camera, options, fill, &mut out)?;
    let k = camera.intrinsics();
    Tensor::from_vec(out, (5, k.height, k.width), &Device::Cpu)
}

/// Footprints of the N·K children of `parents` `[N, 11]` with head records `head`
/// `[N, K, 11]` and the parents' `sh` `[N, D, 3]`, all f32, seen by `camera`.
///
/// # Errors
/// Those of [`crate::network::ops::spgr::spgr`], another length of `out`, D that is no SH count.
pub fn spgr_footprints(
    (head, parents, sh): (&Tensor, &Tensor, &Tensor),
    call: &Spgr,
    camera: &Camera,
    options: &RasterOptions,
    out: &mut [Footprint],
) -> Result<()> {
    let n = call.check(head, parents)?;
    let count = n * call.rules.children();
    let (rows, d, rgb) = sh.dims3()?;
    let Some(sh_degree) = degree_of(d).filter(|_| rows == n && rgb == 3 && out.len() == count)
    else {
        bail!(
            "{NAME}: expected sh [{n}, 1, 4, 9, 16 or 25, 3] and {count} footprints, got {:?} \
             and {}",
            sh.dims(),
            out.len()
        );
    };
    let (head, parents, sh) = (head.contiguous()?, parents.contiguous()?, sh.contiguous()?);
    let finite = {
        let all = [&head, &parents, &sh].map(|t| t.storage_and_layout());
        let [(hs, hl), (ps, pl), (ss, sl)] = &all;
        let (Storage::Cpu(hs), Storage::Cpu(ps), Storage::Cpu(ss)) = (&**hs, &**ps, &**ss) else {
            bail!("{NAME}: expected tensors on the CPU")
        };
        let args = cpu::Args {
            rules: &call.rules,
            source: call.source(),
            head: slice::<f32>(NAME, "head records", hs, hl)?,
            parents: slice::<f32>(NAME, "parents", ps, pl)?,
        };
        let sh = slice::<f32>(NAME, "sh", ss, sl)?;
        cpu::project(args, cpu::Target { camera, options, sh, sh_degree }, out)
    };
    if finite {
        return Ok(());
    }
    // The rows of the children identify the faulty one.
    let mut rows = vec![0.0; count * SPLAT_STRIDE];
    let mut gains = vec![0.0; count * call.rules.gain_channels()];
    spgr_into(&head, &parents, call, &mut rows, &mut gains)?;
    bail!("{NAME}: expected finite footprints of children of finite parents and head records")
}
