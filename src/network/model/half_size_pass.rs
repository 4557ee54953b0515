//! First pass of the depth network, at half size, which narrows near and far.
//!
//! The module narrows a range that is given. `src/reconstruct/depth_range.rs` decides that range from
//! files, cameras and matched points, without the network.
//!
//! Depth candidates are uniform in 1/depth between near and far, so a range wider than the
//! scene costs accuracy. The depth network runs once on images of half the size, with a
//! wide range. Quantiles of the depths that it finds, with a margin, become the range of
//! the full-size run. On the sixteen photographed pairs of the model card
//! (`src/network/shipped/README.md`) this gains 0.5 dB for a quarter of the depth network's
//! time.

use super::Views;
use candle_core::{Result, Tensor};
use subsplat_kernels::camera::{Camera, NearFar};

/// Factor by which the searched range extends the given one on both sides: content nearer
/// than RealEstate10K's near of 1 is common.
const SEARCH_FACTOR: f32 = 2.0;
/// Share of pixels that may lie nearer than near, and farther than far.
const OUTLIER_SHARE: f32 = 0.01;
/// Margin for details that half-size images lack, as a share of near and of far.
const MARGIN: f32 = 0.1;
/// Smallest side, px, of a half-size image. Smaller images stay at full size.
const MIN_HALF_SIDE: usize = 96;

/// Returns `views` with near and far of every scene as a network estimates them. `indices`:
/// the network's candidate indices `[V, 1, H, W]` of a scene, of `candidates`; `stride`: the
/// number, px, of which the network's input sides are multiples.
///
/// # Errors
/// Those of `indices`.
pub(super) fn estimate_depth_range(
    views: &Views,
    candidates: usize,
    stride: usize,
    indices: impl Fn(&Views) -> Result<Tensor>,
) -> Result<Views> {
    let mut estimated = views.clone();
    for b in 0..views.scenes() {
        let mut wide = half_size(&views.scene(b)?, stride)?;
        for range in wide.near_far.iter_mut().flatten() {
            *range = NearFar::new(range.near / SEARCH_FACTOR, range.far * SEARCH_FACTOR);
        }
        let index = indices(&wide)?;
        let top = (candidates - 1) as f32;
        let mut depths = Vec::with_capacity(index.elem_count());
        for (v, NearFar { near, far }) in wide.near_far[0].iter().enumerate() {
            let (low, high) = (far.recip(), near.recip());
            let one = index.get(v)?.flatten_all()?.to_vec1::<f32>()?;
            depths.extend(one.iter().map(|i| (low + i / top * (high - low)).recip()));
        }
        if let Some(range) = quantile_range(&mut depths) {
            estimated.near_far[b].fill(range);
        }
    }
    Ok(estimated)
}

/// Near and far from quantiles of `depths` with their margins; `None` if `depths` is empty
/// or the quantiles are not finite.
fn quantile_range(depths: &mut [f32]) -> Option<NearFar> {
    depths.sort_unstable_by(f32::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let low = (OUTLIER_SHARE * last as f32) as usize;
    let near = depths[low] * (1.0 - MARGIN);
    let far = depths[last - low] * (1.0 + MARGIN);
    Some(NearFar { near, far }).filter(|range| range.is_valid())
}

/// Halves the images and their cameras and crops them centrally to multiples of `stride`.
/// Returns `views` unchanged if a side would be below [`MIN_HALF_SIDE`].
fn half_size(views: &Views, stride: usize) -> Result<Views> {
    let (b, v, c, h, w) = views.images.dims5()?;
    let sides = [w, h].map(|side| side / 2 / stride * stride);
    if sides.iter().any(|side| *side < MIN_HALF_SIDE) {
        return Ok(views.clone());
    }
    let [width, height] = sides;
    let (left, top) = ((w / 2 - width) / 2, (h / 2 - height) / 2);
    let images = views.images.reshape((b * v, c, h, w))?.avg_pool2d(2)?;
    let images = images.narrow(2, top, height)?.narrow(3, left, width)?.contiguous()?;
    let camera = |camera: &Camera| {
        let half = camera.resized_unchecked(w / 2, h / 2);
        let k = half.intrinsics().cropped(left as f32, top as f32, width, height);
        Camera::new_unchecked(k, half.world_from_camera())
    };
    let cameras = views.cameras.iter().map(|all| all.iter().map(camera).collect()).collect();
    let images = images.reshape((b, v, c, height, width))?;
    Views::new(images, cameras, views.near_far.clone())?.with_sources(views.sources().to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, IndexOp, Tensor};
    use glam::{Mat4, Vec3};
    use subsplat_kernels::camera::Intrinsics;

    fn views(w: usize, h: usize) -> Views {
        let k = Intrinsics { fx: 90.0, fy: 80.0, cx: 51.0, cy: 47.0, width: w, height: h };
        let pose = |x: f32| Mat4::from_translation(Vec3::new(x, 0.0, 0.0));
        let cameras = [0.0, 0.3].map(|x| Camera::new(k, pose(x)).unwrap()).to_vec();
        let images = Tensor::rand(0.0f32, 1.0, (1, 2, 3, h, w), &Device::Cpu).unwrap();
        Views::new(images, vec![cameras], vec![vec![NearFar::RE10K; 2]]).unwrap()
    }

    #[test]
    fn a_half_size_image_has_the_same_rays() {
        let all = views(224, 288);
        let small = half_size(&all, 32).unwrap();
        assert_eq!(small.size().unwrap(), (128, 96));
        let (a, b) = (all.cameras[0][1].intrinsics(), small.cameras[0][1].intrinsics());
        // Pixel (10, 20) of the small one covers 2×2 pixels of the large one about
        // (2·(10 + 8 + ½), 2·(20 + 8 + ½)): half sizes 112×144, cut by 8 on every side.
        let ray = b.unproject(glam::Vec2::new(10.5, 20.5));
        let px = a.project(ray);
        assert!((px - glam::Vec2::new(37.0, 57.0)).length() < 1e-4, "{px}");
        let at = |v: &Views, x: usize, y: usize| -> f32 {
            v.images.i((0, 1, 2, y, x)).unwrap().to_scalar().unwrap()
        };
        let mean =
            (at(&all, 36, 56) + at(&all, 37, 56) + at(&all, 36, 57) + at(&all, 37, 57)) / 4.0;
        assert!((at(&small, 10, 20) - mean).abs() < 1e-6);
    }

    #[test]
    fn small_images_stay_as_they_are() {
        assert_eq!(half_size(&views(160, 256), 32).unwrap().size().unwrap(), (256, 160));
    }

    #[test]
    fn outliers_do_not_count() {
        let mut depths: Vec<f32> = (0..1000).map(|i| 2.0 + i as f32 * 0.006).collect();
        (depths[3], depths[500]) = (0.01, 900.0);
        let NearFar { near, far } = quantile_range(&mut depths).unwrap();
        assert!((near - 1.8).abs() < 0.1 && (far - 8.8).abs() < 0.2, "{near} {far}");
        assert!(quantile_range(&mut []).is_none());
        assert!(quantile_range(&mut [f32::NAN; 4]).is_none());
    }
}
