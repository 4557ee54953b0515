//! Gaussians by photograph, and the removal of those that the photographs hardly show.

use super::targets::MaskedView;
use crate::scene::render;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use rayon::prelude::*;
use std::ops::Range;
use subsplat_kernels::layout::{
    Gradients, OPACITY_OFFSET, RasterOptions, SPLAT_STRIDE, SplatSlices, gain_with_offsets,
};

/// Fewest parents of a parallel task.
const TASK: usize = 4096;
/// Least share of a parent that stays ([`RefineOptions::least_share`](super::RefineOptions::least_share)).
pub(crate) const LEAST_SHARE: f32 = 0.3;
/// Fewest photographs of which parents are removed.
const PHOTOGRAPHS_TO_REMOVE: usize = 3;

/// Gaussians of each photograph.
#[derive(Clone, Debug, Default)]
pub struct Groups {
    /// In the order of the photographs; empty where they are not known.
    pub ranges: Vec<Range<usize>>,
    /// Every parent has the same number of children. Parents with different numbers are not
    /// removed here: their Gaussians have an SH set each, which hides the families.
    pub equal_families: bool,
}

impl Groups {
    /// Equal groups of whole families, one for each of `views` photographs. Not known where the
    /// Gaussians are not `grouped`, or where the parents do not divide into equal groups.
    pub(crate) fn equal(splats: &Splats, views: usize, grouped: bool) -> Self {
        let parents = splats.parents();
        if !grouped || views == 0 || !parents.is_multiple_of(views) {
            return Self::default();
        }
        let size = parents / views * splats.children_per_parent();
        let ranges = (0..views).map(|view| view * size..(view + 1) * size).collect();
        Self { ranges, equal_families: true }
    }
}

/// Parents of which the photographs show less than `least_share`, marked by true: they lie behind the
/// surfaces of other photographs, or repeat them. Fewer than [`PHOTOGRAPHS_TO_REMOVE`] photographs show
/// most places twice at most, so none is marked.
pub(crate) fn hidden(shares: &[f32], photographs: usize, least_share: f32) -> Vec<bool> {
    let enough = photographs >= PHOTOGRAPHS_TO_REMOVE;
    shares.iter().map(|share| enough && *share < least_share).collect()
}

/// Parents that are not [`hidden`], marked by true, at most `most`: those with the largest shares, of equal ones the
/// first. `None` where all stay.
pub(crate) fn shown(
    splats: &Splats,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    (least_share, most): (f32, usize),
    renderer: &mut Renderer,
) -> Option<Vec<bool>> {
    if views.len() < PHOTOGRAPHS_TO_REMOVE || !(least_share > 0.0) {
        return None;
    }
    let shares = shares(splats, views, raster, renderer);
    let mut shown: Vec<bool> =
        hidden(&shares, views.len(), least_share).into_iter().map(|hidden| !hidden).collect();
    let mut order: Vec<usize> = (0..shown.len()).filter(|i| shown[*i]).collect();
    if order.len() > most {
        order.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]));
        order.iter().skip(most).for_each(|i| shown[*i] = false);
    }
    shown.contains(&false).then_some(shown)
}

/// The Gaussians without the parents that are [`hidden`]; `None` where all stay.
pub(super) fn pruned(
    splats: &Splats,
    groups: &Groups,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    least_share: f32,
    renderer: &mut Renderer,
) -> Option<(Splats, Groups)> {
    if !groups.equal_families {
        return None;
    }
    let keep = shown(splats, views, raster, (least_share, usize::MAX), renderer)?;
    let children = splats.children_per_parent();
    let mut end = 0;
    let ranges: Vec<Range<usize>> = groups
        .ranges
        .iter()
        .map(|group| {
            let families = &keep[group.start / children..group.end / children];
            let begin = end;
            end += children * families.iter().filter(|keep| **keep).count();
            begin..end
        })
        .collect();
    (end > 0).then(|| (families(splats, &keep), Groups { ranges, equal_families: true }))
}

/// Share of each parent in the photographs: those of [`shares_of_visible`], without the transparent parents, which
/// have none.
pub(crate) fn shares(
    splats: &Splats,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Vec<f32> {
    let families_of = splats.rows.chunks_exact(splats.children_per_parent() * SPLAT_STRIDE);
    let seen =
        |family: &[f32]| family.chunks_exact(SPLAT_STRIDE).any(|row| row[OPACITY_OFFSET] > 0.0);
    let visible: Vec<bool> = families_of.map(seen).collect();
    let number = visible.iter().filter(|visible| **visible).count();
    if number == visible.len() {
        return shares_of_visible(splats, views, raster, renderer);
    }
    // An average parent is one of all.
    let factor = visible.len() as f32 / number.max(1) as f32;
    let shares = shares_of_marked(splats, &visible, views, raster, renderer);
    shares.into_iter().map(|share| factor * share).collect()
}

/// [`shares`] of the parents that `marked` names, drawn without the others; 0 for these.
pub(crate) fn shares_of_marked(
    splats: &Splats,
    marked: &[bool],
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Vec<f32> {
    let mut of_marked = shares(&families(splats, marked), views, raster, renderer).into_iter();
    let share = |marked: &bool| if *marked { of_marked.next().unwrap_or(0.0) } else { 0.0 };
    marked.iter().map(share).collect()
}

/// Share of each parent in the photographs: the weights T·α of its children, summed over all
/// pixels that are not masked, over those of an average parent. The sums are gradients by the colour offsets of a
/// loss that adds all pixels.
fn shares_of_visible(
    splats: &Splats,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Vec<f32> {
    let (parents, children) = (splats.parents(), splats.children_per_parent());
    let raster = RasterOptions { sh_basis: splats.sh_basis, ..*raster };
    let gain = gain_with_offsets(&splats.gain, splats.len());
    let slices = SplatSlices { gain: &gain, ..render::slices(splats) };
    let mut shares = vec![0.0f32; parents];
    let mut pixels = 0;
    let mut gradients = Gradients { sh_limit: Some(0), ..Gradients::default() };
    for view in views {
        let count = view.image.width * view.image.height;
        pixels += view.pixels();
        renderer.gradients_of(&slices, view.camera, &raster, &mut gradients, &mut |planes| {
            let mut by_pixel = vec![0.0; planes.len()];
            by_pixel[..3 * count].fill(1.0 / 3.0);
            if let Some(mask) = view.mask {
                let kept = mask.kept().iter().cycle();
                let masked = by_pixel[..3 * count].iter_mut().zip(kept).filter(|(_, kept)| !**kept);
                masked.for_each(|(weight, _)| *weight = 0.0);
            }
            by_pixel
        });
        let families = gradients.gain.par_chunks_exact(4 * children);
        shares.par_iter_mut().zip(families).with_min_len(TASK).for_each(|(share, family)| {
            *share += family.chunks_exact(4).map(|g| g[1] + g[2] + g[3]).sum::<f32>();
        });
    }
    let average = pixels as f32 / parents.max(1) as f32;
    shares.iter().map(|weight| weight / average).collect()
}

/// The families of `splats` that `keep` marks.
pub(crate) fn families(splats: &Splats, keep: &[bool]) -> Splats {
    let part = |values: &[f32]| -> Vec<f32> {
        let size = values.len() / keep.len().max(1);
        let kept = values.chunks_exact(size.max(1)).zip(keep).filter(|(_, keep)| **keep);
        kept.flat_map(|(family, _)| family).copied().collect()
    };
    let (rows, sh, gain) = (part(&splats.rows), part(&splats.sh), part(&splats.gain));
    Splats { rows, sh, gain, sh_degree: splats.sh_degree, sh_basis: splats.sh_basis }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finish::RefineOptions;
    use crate::scene::pictures::Rgb;
    use glam::Mat4;
    use subsplat_kernels::camera::{Camera, Intrinsics};
    use subsplat_kernels::layout::ShBasis;

    /// One Gaussian a parent in front of a camera at the origin, at these x and with these σ.
    fn splats(at: &[[f32; 2]]) -> Splats {
        let row = |&[x, s]: &[f32; 2]| [x, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, s, s, s, 0.9];
        let (rows, sh) = (at.iter().flat_map(row).collect(), vec![0.5; 3 * at.len()]);
        Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
    }

    fn camera() -> Camera {
        Camera::new(Intrinsics::from_fov_x(1.0, 32, 32), Mat4::IDENTITY).unwrap()
    }

    /// The threshold as a number, by cases 2 % below and above it.
    #[test]
    fn parents_below_the_least_share_are_hidden_from_three_photographs_on() {
        assert_eq!(RefineOptions::default().least_share, 0.3);
        assert_eq!(hidden(&[0.98 * 0.3, 0.3, 1.02 * 0.3], 3, LEAST_SHARE), [true, false, false]);
        assert_eq!(hidden(&[0.0, 1.0], 2, LEAST_SHARE), [false, false]);
    }

    /// Shares add up to the mean alpha: one parent of two covers the picture, the other one lies beside it.
    #[test]
    fn shares_are_weights_over_those_of_an_average_parent() {
        let (camera, image) = (camera(), Rgb { width: 32, height: 32, data: vec![0; 3 * 32 * 32] });
        let view = MaskedView { camera: &camera, image: &image, mask: None };
        let (mut renderer, raster) = (Renderer::default(), RasterOptions::default());
        let both = splats(&[[0.0, 4.0], [90.0, 0.1]]);
        let [seen, beside] = shares(&both, &[view; 3], &raster, &mut renderer)[..] else {
            panic!("two parents")
        };
        let alpha = renderer.render(&both, &camera, &raster).alpha;
        let mean = alpha.iter().sum::<f32>() / alpha.len() as f32;
        assert!(mean > 0.7 && (seen - 2.0 * mean).abs() < 1e-3, "{seen} {mean}");
        assert_eq!(beside, 0.0);
        let keep = |views: usize, least: f32, renderer: &mut Renderer| {
            shown(&both, &vec![view; views], &raster, (least, usize::MAX), renderer)
        };
        assert_eq!(keep(3, 0.3, &mut renderer), Some(vec![true, false]));
        assert_eq!(keep(2, 0.3, &mut renderer), None);
        assert_eq!(keep(3, 0.0, &mut renderer), None);
        // Half of the pixels are masked, and half of the weight is left: the share stays.
        let mask: Vec<bool> = (0..32 * 32).map(|i| i % 32 < 16).collect();
        let mask = crate::scene::mask::Mask::new(32, 32, mask).unwrap();
        let half = MaskedView { mask: Some(&mask), ..view };
        let masked = shares(&both, &[half], &raster, &mut renderer)[0];
        assert!((masked - seen).abs() < 0.01 * seen, "{masked} {seen}");
    }

    /// Transparent parents have no share and change none; of more parents than may stay, those with the largest
    /// shares do.
    #[test]
    fn transparent_parents_have_no_share_and_the_largest_stay() {
        let (camera, image) = (camera(), Rgb { width: 32, height: 32, data: vec![0; 3 * 32 * 32] });
        let view = MaskedView { camera: &camera, image: &image, mask: None };
        let (mut renderer, raster) = (Renderer::default(), RasterOptions::default());
        let mut all = splats(&[[0.5, 0.2], [0.0, 4.0], [-0.5, 0.4], [0.2, 0.3]]);
        all.rows[SPLAT_STRIDE + OPACITY_OFFSET] = 0.0;
        let drawn = shares_of_visible(&all, &[view; 3], &raster, &mut renderer);
        let found = shares(&all, &[view; 3], &raster, &mut renderer);
        assert_eq!((found[1], drawn[1]), (0.0, 0.0));
        let near = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-5 * b.max(1e-3);
        assert!(found.iter().zip(&drawn).all(near), "{found:?} {drawn:?}");
        assert!(found[2] > found[3] && found[3] > found[0] && found[0] > 0.02, "{found:?}");
        let mut keep = |most| shown(&all, &[view; 3], &raster, (0.02, most), &mut renderer);
        assert_eq!(keep(3), Some(vec![true, false, true, true]));
        assert_eq!(keep(2), Some(vec![false, false, true, true]));
        assert_eq!(keep(1), Some(vec![false, false, true, false]));
    }

    #[test]
    fn groups_and_families_are_whole() {
        let four = splats(&[[0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [3.0, 1.0]]);
        assert_eq!(Groups::equal(&four, 2, true).ranges, [0..2, 2..4]);
        assert!(Groups::equal(&four, 2, true).equal_families);
        for (views, grouped) in [(3, true), (0, true), (2, false)] {
            let none = Groups::equal(&four, views, grouped);
            assert!(none.ranges.is_empty() && !none.equal_families);
        }
        let kept = families(&four, &[true, false, false, true]);
        assert_eq!(kept.means().map(|m| m[0]).collect::<Vec<_>>(), [0.0, 3.0]);
        assert_eq!((kept.sh().len(), kept.parents()), (6, 2));
    }

    /// Of each group the hidden parents go, and the ranges follow.
    #[test]
    fn ranges_follow_what_is_removed() {
        let (camera, image) = (camera(), Rgb { width: 32, height: 32, data: vec![0; 3 * 32 * 32] });
        let view = MaskedView { camera: &camera, image: &image, mask: None };
        let all =
            splats(&[[90.0, 0.1], [0.0, 0.5], [0.3, 0.5], [90.0, 0.1], [-0.3, 0.5], [0.1, 0.5]]);
        let groups = Groups::equal(&all, 3, true);
        let (mut renderer, raster) = (Renderer::default(), RasterOptions::default());
        let mut go =
            |groups: &Groups| pruned(&all, groups, &[view; 3], &raster, 0.05, &mut renderer);
        let (kept, kept_groups) = go(&groups).unwrap();
        assert_eq!((kept.len(), kept_groups.equal_families), (4, true));
        assert_eq!(kept_groups.ranges, [0..1, 1..2, 2..4]);
        assert!(go(&Groups { equal_families: false, ..groups }).is_none());
    }
}
