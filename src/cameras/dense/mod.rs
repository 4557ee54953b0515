//! Depth of every pixel, matched between photographs with known cameras, from a first depth that is
//! nearly right.
//!
//! The method is PatchMatch stereo (Bleyer, Rhemann and Rother 2011) in the parallel form of Galliani,
//! Lasinger and Schindler 2015. Each pixel has a plane, and the planes of neighbours and small changes at
//! random replace it where the patch around the pixel then agrees better with the other photographs
//! (`patch`, `planes`). A pixel's depth is certain where the patch agrees and the other photograph's plane
//! leads back to the pixel (`consistency`). The other pixels follow certain ones nearby of a similar
//! brightness.
//!
//! A plane is the inverse depth of a pixel and its two slopes: the inverse depth of a plane in space is
//! affine in the pixel, and so is the projection into another photograph in homogeneous coordinates.
//!
//! Constants were chosen on the pairs of `../shared/photos` of the scenes hololens_foosball, re10k_0c9b and
//! re10k_0f68 (plain and anamorphic) at 128 → 256, by PSNR and SSIM of new views after the refinement; those
//! for several sources on five photographs of these scenes (`subsplat-lab eval PHOTOS --contexts 5 --input-size 128
//! --upscale 2 --methods refine`, 22.94 dB / .778): the mean of the best two sources, hidden or not, was the
//! cause of most wrong depths.
//!
//! Pixels of one colour of a chessboard change together and read the planes of the other colour, and the
//! random numbers depend on the pixel alone: the same input gives the same result on any number of threads.

mod consistency;
mod patch;
mod planes;

use crate::cameras::matches::GrayImage;
use consistency::{certain, spread};
use patch::Warp;
use planes::{Field, matched};
use std::ops::ControlFlow;
use subsplat_kernels::camera::{Camera, NearFar};

/// A photograph with a first depth.
#[derive(Clone, Copy, Debug)]
pub struct DenseView<'a> {
    /// Luma of the photograph. Depth is not matched at masked pixels, nor with those of other photographs.
    pub picture: &'a GrayImage,
    /// Its camera, of the picture's size.
    pub camera: &'a Camera,
    /// `[H·W]`: camera z of each pixel, world units. A pixel whose depth is not positive has none.
    pub depth: &'a [f32],
    /// Indices of the photographs with which it is compared.
    pub sources: &'a [usize],
}

/// Change of the depth of a photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseMatch {
    /// `[H·W]`: new depth over the first one; 1 where nothing is known.
    pub factor: Vec<f32>,
    /// `[H·W]`: the depth is matched, not taken from pixels nearby.
    pub certain: Vec<bool>,
}

/// Matches the depth of all `views`, within `near_far` widened by a factor of three. `progress` receives
/// the share that is done. Returns `None` where it breaks. A view whose depth has another length than its picture, or
/// that has no sources, stays as it is.
pub fn match_depth(
    views: &[DenseView<'_>],
    near_far: NearFar,
    progress: &mut dyn FnMut(f32) -> ControlFlow<()>,
) -> Option<Vec<DenseMatch>> {
    let range = [1.0 / (near_far.far * RANGE_MARGIN), RANGE_MARGIN / near_far.near];
    let mut fields = Vec::with_capacity(views.len());
    for (i, view) in views.iter().enumerate() {
        let fits = view.depth.len() == view.picture.pixels().len();
        fields.push(if fits { matched(i, views, range) } else { Field::default() });
        if progress((i + 1) as f32 / views.len() as f32).is_break() {
            return None;
        }
    }
    let of_view = |(i, view): (usize, &DenseView<'_>)| {
        if fields[i].is_empty() {
            let pixels = view.depth.len();
            return DenseMatch { factor: vec![1.0; pixels], certain: vec![false; pixels] };
        }
        let certain = certain(i, views, &fields);
        let factor = |(plane, depth): (&planes::Plane, &f32)| 1.0 / (plane.inverse * depth);
        let factors: Vec<f32> = fields[i].iter().zip(view.depth).map(factor).collect();
        let factor = spread(view.picture, &factors, &certain);
        DenseMatch { factor, certain }
    };
    Some(views.iter().enumerate().map(of_view).collect())
}

/// Depths may lie beyond near and far by this factor: the network's range is an estimate as well.
const RANGE_MARGIN: f32 = 3.0;

/// Projections of photograph `view` into its sources, with the indices of these.
fn warps(view: usize, views: &[DenseView<'_>]) -> Vec<(usize, Warp)> {
    let sources = views[view].sources.iter().filter(|source| **source < views.len());
    sources.map(|source| (*source, Warp::new(views[view].camera, views[*source].camera))).collect()
}

#[cfg(test)]
mod tests;
