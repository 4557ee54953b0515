//! A first look: between which depths a pair of pictures has anything to show.
//!
//! Candidates are uniform in 1/depth between near and far, and how finely they divide
//! what there is to see decides how good the depth is. Poses alone say little of it:
//! RealEstate10K's habit is 1 and 100 whatever the room. So the depth network looks at
//! the pictures at half their size with a wide range, and the range of what it saw is
//! the one that it then works with. On the sixteen photographed pairs of the model card
//! this is worth half a decibel; the cost is a quarter of the depth network's time.

use super::Views;
use super::backbone::SmallBackbone;
use crate::camera::Camera;
use candle_core::Result;

/// The range that is looked through is wider than what was guessed by this factor on
/// both sides: things nearer than RealEstate10K's near of 1 are common.
const WIDER: f32 = 2.0;
/// Share of pixels that may lie nearer than near, and farther than far.
const OUTSIDE: f32 = 0.01;
/// Room for what a half-sized picture does not show, as a share of near and of far.
const MARGIN: f32 = 0.1;
/// A half with fewer pixels a side shows too little: then the whole is looked at.
const LEAST_HALF: usize = 96;

/// near and far of every scene of `views` by what `network` sees at half the size.
pub(super) fn ranges(network: &SmallBackbone, views: &Views, stride: usize) -> Result<Views> {
    let mut found = views.clone();
    for b in 0..views.scenes() {
        let mut wide = smaller(&views.scene(b)?, stride)?;
        for (near, far) in wide.near_far.iter_mut().flatten() {
            (*near, *far) = (*near / WIDER, *far * WIDER);
        }
        let index = network.depth(&wide, false)?.index;
        let top = (network.candidates() - 1) as f32;
        let mut depths = Vec::with_capacity(index.elem_count());
        for (v, (near, far)) in wide.near_far[0].iter().enumerate() {
            let (least, most) = (far.recip(), near.recip());
            let one = index.get(v)?.flatten_all()?.to_vec1::<f32>()?;
            depths.extend(one.iter().map(|i| (least + i / top * (most - least)).recip()));
        }
        if let Some(range) = range(&mut depths) {
            found.near_far[b].fill(range);
        }
    }
    Ok(found)
}

/// The quantiles of depth with their margins; none of depths that are no numbers.
fn range(depths: &mut [f32]) -> Option<(f32, f32)> {
    depths.sort_unstable_by(f32::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let low = (OUTSIDE * last as f32) as usize;
    let (near, far) = (depths[low] * (1.0 - MARGIN), depths[last - low] * (1.0 + MARGIN));
    (near > 0.0 && far > near && far.is_finite()).then_some((near, far))
}

/// Half as large on both sides, with cameras to fit, and cut about the middle to
/// multiples of `stride`; as it is where that would leave too little.
fn smaller(views: &Views, stride: usize) -> Result<Views> {
    let (b, v, c, h, w) = views.images.dims5()?;
    let sides = [w, h].map(|side| side / 2 / stride * stride);
    if sides.iter().any(|side| *side < LEAST_HALF) {
        return Ok(views.clone());
    }
    let [width, height] = sides;
    let (left, top) = ((w / 2 - width) / 2, (h / 2 - height) / 2);
    let images = views.images.reshape((b * v, c, h, w))?.avg_pool2d(2)?;
    let images = images.narrow(2, top, height)?.narrow(3, left, width)?.contiguous()?;
    let camera = |camera: &Camera| {
        let half = camera.resized(w / 2, h / 2);
        let k = half.intrinsics.cropped(left as f32, top as f32, width, height);
        Camera { intrinsics: k, ..half }
    };
    let cameras = views.cameras.iter().map(|all| all.iter().map(camera).collect()).collect();
    Views::new(images.reshape((b, v, c, height, width))?, cameras, views.near_far.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use candle_core::{Device, IndexOp, Tensor};
    use glam::{Mat4, Vec3};

    fn views(w: usize, h: usize) -> Views {
        let k = Intrinsics { fx: 90.0, fy: 80.0, cx: 51.0, cy: 47.0, width: w, height: h };
        let pose = |x: f32| Mat4::from_translation(Vec3::new(x, 0.0, 0.0));
        let cameras = [0.0, 0.3].map(|x| Camera::new(k, pose(x)).unwrap()).to_vec();
        let images = Tensor::rand(0.0f32, 1.0, (1, 2, 3, h, w), &Device::Cpu).unwrap();
        Views::new(images, vec![cameras], vec![vec![(1.0, 100.0); 2]]).unwrap()
    }

    #[test]
    fn a_smaller_picture_shows_the_same_rays() {
        let all = views(224, 288);
        let small = smaller(&all, 32).unwrap();
        assert_eq!(small.size().unwrap(), (128, 96));
        let (a, b) = (all.cameras[0][1].intrinsics, small.cameras[0][1].intrinsics);
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
    fn small_pictures_stay_as_they_are() {
        assert_eq!(smaller(&views(160, 256), 32).unwrap().size().unwrap(), (256, 160));
    }

    #[test]
    fn strays_do_not_count() {
        let mut depths: Vec<f32> = (0..1000).map(|i| 2.0 + i as f32 * 0.006).collect();
        (depths[3], depths[500]) = (0.01, 900.0);
        let (near, far) = range(&mut depths).unwrap();
        assert!((near - 1.8).abs() < 0.1 && (far - 8.8).abs() < 0.2, "{near} {far}");
        assert!(range(&mut []).is_none());
        assert!(range(&mut [f32::NAN; 4]).is_none());
    }
}
