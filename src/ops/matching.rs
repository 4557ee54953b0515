//! Raw matching channels as a tensor. They are fixed functions of the photographs:
//! no learned parameter precedes them, so they have no gradient.

use crate::camera::Camera;
use crate::cpu::matching::{self, Pyramid};
use candle_core::{DType, Result, Tensor, bail};
use rayon::prelude::*;

pub use crate::cpu::matching::CHANNELS;

/// `[B·V, 4, D, h, w]` at quarter resolution: the channels of
/// [`crate::cpu::matching`] of each view against the others, averaged over them.
///
/// `images` `[B, V, 3, H, W]` f32 in [0, 1], H and W multiples of 4; `cameras` and
/// `disparities` (1 / camera z, one list per reference view) `[B][V]`.
///
/// # Errors
/// Another dtype, sides that are no multiples of 4, lists that do not fit.
pub fn raw_matching(
    images: &Tensor,
    cameras: &[Vec<Camera>],
    disparities: &[Vec<Vec<f32>>],
) -> Result<Tensor> {
    let (b, v, c, h, w) = images.dims5()?;
    if c != 3 || h % 4 != 0 || w % 4 != 0 {
        bail!("raw matching: expected images [B, V, 3, 4h, 4w], got {:?}", images.dims());
    }
    if images.dtype() != DType::F32 {
        bail!("raw matching: expected f32 images, got {:?}", images.dtype());
    }
    let whole = cameras.len() == b
        && disparities.len() == b
        && cameras.iter().all(|scene| scene.len() == v)
        && disparities.iter().all(|scene| scene.len() == v);
    if !whole {
        bail!("raw matching: expected {v} cameras and candidate lists for each of {b} scenes");
    }
    let d = disparities[0][0].len();
    if disparities.iter().flatten().any(|list| list.len() != d) {
        bail!("raw matching: expected {d} candidates for every view");
    }
    let pixels = images.flatten_all()?.to_vec1::<f32>()?;
    let picture = 3 * h * w;
    let pyramids: Vec<Pyramid> =
        pixels.par_chunks_exact(picture).map(|p| Pyramid::new(p, h, w)).collect();
    let share = 1.0 / (v - 1) as f32;
    let size = CHANNELS * d * (h / 4) * (w / 4);
    let mut out = vec![0f32; b * v * size];
    out.par_chunks_exact_mut(size.max(1)).enumerate().for_each(|(row, out)| {
        let (scene, i) = (row / v, row % v);
        for j in (0..v).filter(|&j| j != i) {
            let reference = (&pyramids[row], &cameras[scene][i]);
            let source = (&pyramids[scene * v + j], &cameras[scene][j]);
            matching::add_raw_matching(reference, source, &disparities[scene][i], share, out);
        }
    });
    Tensor::from_vec(out, &[b * v, CHANNELS, d, h / 4, w / 4][..], images.device())
}
