//! Consensus of views about depth, as a tensor. Kernel: cpu/small/depth_consensus.rs.

use super::rgbd::Scenes;
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::cpu::small::depth_consensus::{
    DepthView, TOLERANCE, depth_consensus as kernel,
};

/// Returns distances `[B, V, H·W, 1]` along the unit ray that most views support, without a
/// gradient.
///
/// `images` `[B, V, 3, H, W]`, `cameras` and `ranges` `[B][V]`, `distances` and `confidences`
/// `[B, V, H·W, 1]`, all f32.
///
/// # Errors
/// Shapes that do not fit one another; another dtype.
pub fn depth_consensus(
    images: &Tensor,
    cameras: &[Vec<Camera>],
    ranges: &[Vec<NearFar>],
    [distances, confidences]: [&Tensor; 2],
) -> Result<Tensor> {
    let scenes = Scenes::new("depth consensus", images, cameras, distances)?;
    if confidences.dims() != distances.dims() {
        let (got, expected) = (confidences.dims(), distances.dims());
        bail!("depth consensus: expected confidences {expected:?}, got {got:?}");
    }
    let tolerances = tolerances(cameras, ranges)?;
    let confidences = confidences.detach().flatten_all()?.to_vec1::<f32>()?;
    let mut parts = confidences.chunks(scenes.pixels.max(1)).zip(tolerances);
    let mut out = Vec::with_capacity(confidences.len());
    for views in scenes.iter() {
        let of_view = |(seen, (confidences, tolerance))| DepthView { seen, confidences, tolerance };
        out.extend(kernel(&views.into_iter().zip(&mut parts).map(of_view).collect::<Vec<_>>()));
    }
    Tensor::from_vec(out, distances.dims(), images.device())
}

/// Returns the tolerance of each view, 1 / world units.
///
/// # Errors
/// Another number of ranges than of cameras.
pub(in crate::network::ops) fn tolerances(
    cameras: &[Vec<Camera>],
    ranges: &[Vec<NearFar>],
) -> Result<Vec<f32>> {
    let count = cameras.iter().map(Vec::len).sum::<usize>();
    let tolerance = |&NearFar { near, far }: &NearFar| TOLERANCE * (1.0 / near - 1.0 / far);
    let all: Vec<f32> = ranges.iter().flatten().map(tolerance).collect();
    if all.len() != count {
        bail!("depth consensus: expected ranges of {count} views, got {}", all.len());
    }
    Ok(all)
}
