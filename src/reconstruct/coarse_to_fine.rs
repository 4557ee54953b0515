//! Parents before they are divided: depth matched between the photographs, then an optimisation on the
//! photographs of the network's input size.
//!
//! A network that reads 256 pixels places Gaussians to a pixel or two. At twice its size such an error is two
//! to four pixels, and the steps of a refinement then fix details where they do not belong. Depth is
//! therefore corrected first, at the size where a step of a mean reaches far and costs little, and children
//! inherit it: their heads and their places follow from the corrected parents.
//!
//! 1. [`match_depth`] moves parents along their rays, each with the size that its pixel then has.
//! 2. [`fit`] and [`refine`] on the photographs of the input's size. Without children below a
//!    pixel this is the refinement of the scene itself, so it is left out.
//!
//! `subsplat-lab eval PHOTOS --upscale 2 --methods enlarged,direct,refine` on the 16 pairs of
//! `../shared/photos` (PSNR / SSIM of new views): without both 19.25 / .694, with both 19.90 / .724; a whole
//! run at the input's size, enlarged by Lanczos: 19.44 / .676. What was tried and left out is in
//! `tools/lab/tried.md`.

use super::children::GAIN_WITH_OFFSETS;
use super::{Error, Result, finishing};
use crate::cameras::dense::{DenseMatch, DenseView, match_depth};
use crate::cameras::matches::GrayImage;
use crate::finish::{
    FitOptions, Groups, MaskedView, PhaseRun, RefineOptions, families, fit_masked, refine_groups,
    shown,
};
use crate::reconstruct::inputs::crop::Cropped;
use crate::reconstruct::inputs::pair::choose_sources;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use glam::Vec3;
use std::ops::ControlFlow;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, gain_with_offsets,
};

/// Photographs with which each one is compared. Of five photographs, the scenes that chose the constants of
/// [`crate::cameras::dense`] have 23.65 dB / .796 with two and 23.59 / .796 with four.
const SOURCES: usize = 2;
/// Steps of the optimisation of parents for a step of the refinement of the scene. Twice as many change new
/// views by 0.00 dB and .002 of SSIM, on the pairs that chose the constants of [`crate::cameras::dense`].
const STEPS: usize = 2;
/// Most steps of parents.
const STEPS_MAX: usize = 160;
/// Least share of a parent of three photographs or more that is optimised ([`shown`]). Five photographs of the
/// scenes that chose the constants of [`crate::cameras::dense`] have 23.87 dB / .791 with 0.3, 23.94 / .793 with 0.15,
/// 23.96 / .794 with 0.05; parents of seventeen take 31 s with 0.3 and 47 s with 0.05.
const PARENTS_SHARE: f32 = 0.1;
/// Share of a limit of time that the parents take.
const TIME_SHARE: f32 = 0.25;

/// Moves `parents`, one for each pixel of each input, along their rays to the depth at which the photographs
/// agree. Returns the factor of each photograph's depths, `[V][H·W]`; empty where another number of parents
/// leaves them. `progress` receives the share that is done.
///
/// # Errors
/// [`Error::Cancelled`].
pub fn match_parents(
    parents: &mut Splats,
    inputs: &[Cropped],
    near_far: NearFar,
    progress: &mut dyn FnMut(f32) -> ControlFlow<()>,
) -> Result<Vec<Vec<f32>>> {
    let pixels: usize = inputs.iter().map(|c| c.input.width * c.input.height).sum();
    if parents.len() != pixels {
        return Ok(Vec::new());
    }
    let grey = |c: &Cropped| GrayImage::from_picture(&c.input, c.input_mask.as_ref());
    let pictures: Option<Vec<GrayImage>> = inputs.iter().map(grey).collect();
    let Some(pictures) = pictures else { return Ok(Vec::new()) };
    let cameras: Vec<Camera> = inputs.iter().map(|c| c.input_camera).collect();
    let sources = choose_sources(&cameras, near_far, SOURCES);
    let mut rows = parents.rows.chunks_exact_mut(SPLAT_STRIDE);
    let depths: Vec<Vec<f32>> = inputs
        .iter()
        .map(|c| {
            let own = rows.by_ref().take(c.input.width * c.input.height);
            own.map(|row| c.input_camera.to_camera(Vec3::from_slice(&row[MEAN_OFFSET..])).z)
                .collect()
        })
        .collect();
    let view = |i: usize| DenseView {
        picture: &pictures[i],
        camera: &cameras[i],
        depth: &depths[i],
        sources: &sources[i],
    };
    let views: Vec<DenseView<'_>> = (0..inputs.len()).map(view).collect();
    let Some(found) = match_depth(&views, near_far, progress) else {
        return Err(Error::Cancelled);
    };
    let mut rows = parents.rows.chunks_exact_mut(SPLAT_STRIDE);
    for (DenseMatch { factor, .. }, camera) in found.iter().zip(&cameras) {
        for (factor, row) in factor.iter().zip(rows.by_ref()) {
            let origin = camera.position();
            let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
            row[MEAN_OFFSET..MEAN_OFFSET + 3]
                .copy_from_slice(&(origin + (mean - origin) * *factor).to_array());
            row[SCALE_OFFSET..OPACITY_OFFSET].iter_mut().for_each(|s| *s *= factor);
        }
    }
    Ok(found.into_iter().map(|one| one.factor).collect())
}

/// Options of the optimisation of parents.
#[derive(Clone, Copy, Debug)]
pub struct ParentsOptions {
    /// Steps and rates.
    pub refine: RefineOptions,
    /// Most parents that are optimised, those with the largest shares of the photographs.
    pub most: usize,
}

/// Options of the optimisation of parents in a scene that is refined by `scene` and has at most `most`
/// Gaussians; `None` where the scene is not refined, or where the pictures have the input's size.
pub fn options_of_parents(
    scene: &RefineOptions,
    inputs: &[Cropped],
    most: usize,
) -> Option<ParentsOptions> {
    let larger = inputs.iter().any(|c| c.target.width > c.input.width);
    let time = scene.time.map(|time| time.mul_f32(TIME_SHARE));
    // Parents are the children's anchors: none is removed before there are children. Children have the SH sets of
    // the network.
    let steps = scene.steps.saturating_mul(STEPS).min(STEPS_MAX);
    let refine = RefineOptions { steps, time, least_share: 0.0, sh_rate: 0.0, ..*scene };
    (scene.steps > 0 && larger).then_some(ParentsOptions { refine, most })
}

/// Fits and refines `parents` on the photographs of the input's size, which `raster` renders, by
/// [`options_of_parents`]. Those that the photographs hardly show, those above [`ParentsOptions::most`] and those of
/// masked pixels become transparent instead, and get no children. `progress` receives the refinement after each step,
/// and `None` after each step of the fit.
///
/// # Errors
/// [`Error::Cancelled`].
pub fn refine_parents(
    parents: &mut Splats,
    inputs: &[Cropped],
    raster: &RasterOptions,
    options: &ParentsOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(Option<&PhaseRun<'_>>) -> ControlFlow<()>,
) -> Result<()> {
    let views = finishing::input_views(inputs);
    let per_view = parents.len() / inputs.len().max(1);
    let Some(unmasked) = finishing::kept_parents(inputs, per_view) else {
        let groups = Groups::equal(parents, views.len(), options.refine.grouped);
        return refine_shown(parents, groups, &views, raster, options, renderer, progress);
    };
    let mut own = families(parents, &unmasked);
    let groups = match options.refine.grouped {
        true => finishing::groups_of(&unmasked, per_view, 1),
        false => Groups::default(),
    };
    refine_shown(&mut own, groups, &views, raster, options, renderer, progress)?;
    restore(parents, &unmasked, &own);
    Ok(())
}

/// Fits and refines those of `parents` that the photographs show; the others become transparent. `groups` are the
/// parents of each photograph.
fn refine_shown(
    parents: &mut Splats,
    mut groups: Groups,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    options: &ParentsOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(Option<&PhaseRun<'_>>) -> ControlFlow<()>,
) -> Result<()> {
    let keep = shown(parents, views, raster, (PARENTS_SHARE, options.most), renderer);
    let mut kept = keep.as_ref().map(|keep| families(parents, keep));
    if let Some(kept) = &kept {
        groups = Groups::equal(kept, views.len(), options.refine.grouped);
    }
    let moved = kept.as_mut().unwrap_or(parents);
    // Without this fit, three photographs of `../shared/photos` have 18.93 dB / .683 instead of 18.92 / .685 (128 → 256),
    // five 23.99 / .823 instead of 24.09 / .825.
    let mut step = |_: usize| progress(None);
    let sizes = FitOptions::default();
    fit_masked(moved, views, raster, &sizes, renderer, &mut step).map_err(finishing::error)?;
    let mut step = |phase: &PhaseRun<'_>| progress(Some(phase));
    refine_groups(moved, &mut groups, views, raster, &options.refine, renderer, &mut step)
        .map_err(finishing::error)?;
    if let (Some(keep), Some(kept)) = (keep, kept) {
        restore(parents, &keep, &kept);
    }
    Ok(())
}

/// Writes `kept`, the families of `splats` that `keep` marks, back to them, with their gains and colour offsets.
/// The others become transparent. `kept` has the SH sets of `splats`.
fn restore(splats: &mut Splats, keep: &[bool], kept: &Splats) {
    let children = splats.children_per_parent();
    splats.gain = gain_with_offsets(&splats.gain, splats.len());
    let gain = gain_with_offsets(&kept.gain, kept.len());
    let (rows_size, gain_size) = (children * SPLAT_STRIDE, children * GAIN_WITH_OFFSETS);
    let mut kept = kept.rows.chunks_exact(rows_size).zip(gain.chunks_exact(gain_size));
    let rows = splats.rows.chunks_exact_mut(rows_size);
    for ((rows, gain), keep) in rows.zip(splats.gain.chunks_exact_mut(gain_size)).zip(keep) {
        if !keep {
            rows.chunks_exact_mut(SPLAT_STRIDE).for_each(|row| row[OPACITY_OFFSET] = 0.0);
        } else if let Some((kept_rows, kept_gain)) = kept.next() {
            rows.copy_from_slice(kept_rows);
            gain.copy_from_slice(kept_gain);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat_kernels::layout::ShBasis;

    #[test]
    fn what_the_photographs_hide_becomes_transparent() {
        let row = |i: usize| vec![0.1 * (1 + i) as f32; SPLAT_STRIDE];
        let mut splats = Splats {
            rows: (0..6).flat_map(row).collect(),
            sh: (0..9).map(|i| i as f32).collect(),
            gain: Vec::new(),
            sh_degree: 0,
            sh_basis: ShBasis::default(),
        };
        assert_eq!((splats.parents(), splats.children_per_parent()), (3, 2));
        let keep = [true, false, true];
        let mut kept = families(&splats, &keep);
        assert_eq!(kept.sh, [0.0, 1.0, 2.0, 6.0, 7.0, 8.0]);
        kept.rows.iter_mut().for_each(|v| *v += 1.0);
        kept.gain = (0..16).map(|i| i as f32).collect();
        restore(&mut splats, &keep, &kept);
        let of = |i: usize| splats.rows[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE].to_vec();
        let moved = |i: usize| row(i).iter().map(|v| v + 1.0).collect::<Vec<_>>();
        assert_eq!([0, 1, 4, 5].map(of), [0, 1, 4, 5].map(moved));
        assert_eq!([2, 3].map(|i| splats.opacity(i)), [0.0, 0.0]);
        assert_eq!(of(2)[..OPACITY_OFFSET], row(2)[..OPACITY_OFFSET]);
        assert_eq!(splats.gain[..12], [0., 1., 2., 3., 4., 5., 6., 7., 1., 0., 0., 0.]);
        assert_eq!(splats.gain[16..], [8., 9., 10., 11., 12., 13., 14., 15.]);
    }
}
