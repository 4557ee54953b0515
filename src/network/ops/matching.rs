//! Raw matching channels as a tensor. They are fixed functions of the photographs:
//! no learned parameter precedes them, so they have no gradient.

use candle_core::{DType, Result, Tensor, bail};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::matching;
#[cfg(feature = "gpu")]
use subsplat_kernels::cpu::matching::PlaneWarp;
use subsplat_kernels::cpu::matching::Pyramid;

pub use subsplat_kernels::cpu::matching::{CHANNELS, VARIANCE_FLOOR, Z_MIN};

/// `[R, 4, D, h, w]` at quarter resolution: the channels of [`subsplat_kernels::cpu::matching`], one row
/// for each element of `rows`: a reference view and a source view of the same scene, as rows
/// of `[B·V]`.
///
/// `images` `[B, V, 3, H, W]` f32 in [0, 1], H and W multiples of 4; `cameras` and
/// `disparities` (1 / camera z, one list per reference view) `[B][V]`.
///
/// # Errors
/// Another dtype, sides that are no multiples of 4, lists or rows that do not fit.
pub fn raw_matching(
    images: &Tensor,
    cameras: &[Vec<Camera>],
    disparities: &[Vec<Vec<f32>>],
    rows: &[[usize; 2]],
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
    if let Some(row) = rows.iter().find(|r| r.iter().any(|&i| i >= b * v) || r[0] / v != r[1] / v) {
        bail!("raw matching: expected two views of one scene below {}, got {row:?}", b * v);
    }
    let pixels = images.flatten_all()?.to_vec1::<f32>()?;
    let picture = 3 * h * w;
    let used: Vec<bool> = (0..b * v).map(|i| rows.iter().any(|r| r.contains(&i))).collect();
    let pyramids: Vec<Option<Pyramid>> = (pixels.par_chunks_exact(picture).zip(used))
        .map(|(p, used)| used.then(|| Pyramid::new(p, h, w)))
        .collect();
    let size = CHANNELS * d * (h / 4) * (w / 4);
    let mut out = vec![0f32; rows.len() * size];
    out.par_chunks_exact_mut(size.max(1)).zip(rows).for_each(|(out, &[i, j])| {
        if let (Some(reference), Some(source)) = (&pyramids[i], &pyramids[j]) {
            let reference = (reference, &cameras[i / v][i % v]);
            let source = (source, &cameras[j / v][j % v]);
            matching::write_raw_matching(reference, source, &disparities[i / v][i % v], out);
        }
    });
    Tensor::from_vec(out, &[rows.len(), CHANNELS, d, h / 4, w / 4][..], images.device())
}

/// Returns the warps of `rows` at half and at quarter resolution h × w as the GPU kernel reads
/// them: 32 floats a row, four columns of four for each resolution.
#[cfg(feature = "gpu")]
pub(super) fn warp_floats(
    cameras: &[Vec<Camera>],
    rows: &[[usize; 2]],
    [h, w]: [usize; 2],
    v: usize,
) -> Vec<f32> {
    let of_row = |row: &[usize; 2]| {
        let [reference, source] = row.map(|i| cameras[i / v][i % v]);
        [2, 1].map(|scale| PlaneWarp::new(&reference, &source, scale * w, scale * h).columns())
    };
    rows.iter().flat_map(of_row).flatten().flat_map(|c| [c.x, c.y, c.z, 0.0]).collect()
}
