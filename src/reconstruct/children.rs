//! The Gaussians of a scene: the same number of children for each parent, or more where the
//! photographs have detail.

use super::density::{Density, counts, grids};
use super::detail::{self, add_detail};
use super::finishing::{groups_of, input_views, kept_parents};
use super::{Error, Result};
use crate::finish::{Groups, LEAST_SHARE, families, hidden, shares, shares_of_marked};
use crate::network::model::scene_encoding::SceneEncoding;
use crate::network::model::subsplat::{SceneOutput, SubSplat};
use crate::network::model::trace::Checkpoint;
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use subsplat_kernels::cpu::detail::with_residuals;
use subsplat_kernels::layout::{CHILDREN_MAX, RasterOptions};

/// Numbers of a gain with colour offsets: γ, then δ.
pub(super) const GAIN_WITH_OFFSETS: usize = 4;

/// Gaussians of a scene.
pub struct SceneChildren {
    /// The Gaussians.
    pub splats: Splats,
    /// Gaussians of each photograph.
    pub groups: Groups,
    /// `[V][H·W]`: distance of each input pixel's first Gaussian along the unit ray, world units; empty
    /// where it is not known.
    pub distances: Vec<Vec<f32>>,
    origins: Origins,
}

/// Numbers of children that parents have.
pub enum Counts {
    /// K of each parent.
    Mixed {
        /// K of each parent.
        counts: Vec<u8>,
        /// The parents.
        parents: Splats,
    },
    /// r² children of each parent that is marked, none of the others.
    Kept(Vec<bool>),
}

/// Parents of the Gaussians.
enum Origins {
    /// r² consecutive Gaussians have one parent.
    Regular,
    /// Parent of each Gaussian, and K of each parent.
    Mixed { parents: Vec<u32>, counts: Vec<u8> },
}

/// Sides of the grids that the network's children can have: r alone beside 1 for heads of one K, and
/// 1 alone where the children are the primaries.
fn grids_of(network: &SubSplat) -> Vec<usize> {
    let config = network.config();
    if network.trunk().is_off() || config.upscale == 1 {
        vec![1]
    } else if config.spgr.head.serves_any_k() {
        grids(config.upscale)
    } else {
        vec![1, config.upscale]
    }
}

/// Numbers of children of the parents for `density`; `None` where all have r² children. `raster` renders
/// pictures of the input's size, from which the parents' shares come. Parents of masked pixels have no children, and
/// `density` counts the others alone. `parents` are those of `encoding` where the caller has them.
///
/// # Errors
/// Those of the network; a number of [`Density::Each`] that is not in 1 to 64.
pub fn counts_of(
    network: &SubSplat,
    encoding: &SceneEncoding,
    parents: Option<Splats>,
    inputs: &[Cropped],
    density: Density,
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Result<Option<Counts>> {
    let grids = grids_of(network);
    let upscale = grids.last().copied().unwrap_or(1);
    let kept = kept_parents(inputs, encoding.per_view());
    let number = match &kept {
        Some(kept) => kept.iter().filter(|kept| **kept).count(),
        None => encoding.per_view() * inputs.len(),
    };
    if density.is_full(number, inputs.len(), upscale) {
        return Ok(kept.map(Counts::Kept));
    }
    let parents = match parents {
        Some(parents) => parents,
        None => encoding.parents(network)?,
    };
    let photographs = input_views(inputs);
    let mut shares = match &kept {
        Some(kept) => shares_of_marked(&parents, kept, &photographs, raster, renderer),
        None => shares(&parents, &photographs, raster, renderer),
    };
    let mut limit = density.limit(number, inputs.len(), upscale);
    let mut hidden = hidden(&shares, inputs.len(), LEAST_SHARE);
    // Of fewer Gaussians than kept parents, those with the largest shares have one.
    let each_has_one = kept.is_none() || limit >= number;
    for (hidden, kept) in hidden.iter_mut().zip(kept.iter().flatten()) {
        *hidden |= !kept;
    }
    for (share, _) in shares.iter_mut().zip(&hidden).filter(|(_, hidden)| **hidden) {
        *share = 0.0;
        limit = if each_has_one { limit.saturating_add(1) } else { limit };
    }
    let mut counts = match density {
        Density::Each(children) => vec![each(children)?; shares.len()],
        _ => counts(inputs, &shares, &grids, limit),
    };
    for (count, _) in counts.iter_mut().zip(&hidden).filter(|(_, hidden)| **hidden) {
        *count = 0;
    }
    Ok(Some(Counts::Mixed { counts, parents }))
}

/// K of [`Density::Each`].
fn each(children: usize) -> Result<u8> {
    match u8::try_from(children) {
        Ok(k) if (1..=CHILDREN_MAX).contains(&children) => Ok(k),
        _ => {
            let expected = format!("1 to {CHILDREN_MAX} for each pixel");
            Err(Error::argument("density", expected, children.to_string()))
        }
    }
}

impl SceneChildren {
    /// Children of the one scene that `encoding` holds, of `photographs` photographs, without detail;
    /// `counts` are those of [`counts_of`].
    ///
    /// # Errors
    /// Those of the network and of `checkpoint`.
    pub fn new(
        network: &SubSplat,
        encoding: &SceneEncoding,
        photographs: usize,
        counts: Option<Counts>,
        checkpoint: Checkpoint<'_>,
    ) -> candle_core::Result<Self> {
        let per_view = encoding.per_view();
        let (counts, parents) = match counts {
            Some(Counts::Mixed { counts, parents }) => (counts, parents),
            None => return Ok(Self::regular(network, encoding, photographs, checkpoint)?.0),
            Some(Counts::Kept(kept)) => {
                let (all, k) = Self::regular(network, encoding, photographs, checkpoint)?;
                return Ok(all.of_kept(&kept, per_view, k));
            }
        };
        let (mixed, distances) = encoding.mixed(network, &parents, &counts, checkpoint)?;
        let end = |view: usize| mixed.parents.partition_point(|p| (*p as usize) < view * per_view);
        let ranges = (0..photographs).map(|view| end(view)..end(view + 1)).collect();
        let groups = Groups { ranges, equal_families: false };
        let origins = Origins::Mixed { parents: mixed.parents, counts };
        Ok(Self { splats: mixed.splats, groups, distances, origins })
    }

    /// The same number of children of each parent, and this number.
    fn regular(
        network: &SubSplat,
        encoding: &SceneEncoding,
        photographs: usize,
        checkpoint: Checkpoint<'_>,
    ) -> candle_core::Result<(Self, usize)> {
        let SceneOutput { children, depths } = encoding.children(network, checkpoint)?;
        let size = encoding.per_view() * children.k;
        let ranges = (0..photographs).map(|view| view * size..(view + 1) * size).collect();
        let groups = Groups { ranges, equal_families: true };
        let splats = children.to_splats()?;
        let origins = Origins::Regular;
        Ok((Self { splats, groups, distances: depths, origins }, children.k))
    }

    /// The children of the parents that `kept` marks, `k` each. Whole families: siblings share their SH set.
    fn of_kept(self, kept: &[bool], per_view: usize, k: usize) -> Self {
        let splats = families(&self.splats, kept);
        let counts = kept.iter().map(|kept| if *kept { k as u8 } else { 0 }).collect();
        let numbers = kept.iter().zip(0u32..).filter(|(kept, _)| **kept);
        let parents = numbers.flat_map(|(_, parent)| std::iter::repeat_n(parent, k)).collect();
        let groups = groups_of(kept, per_view, k);
        Self { splats, groups, origins: Origins::Mixed { parents, counts }, ..self }
    }

    /// Adds the colour offsets of the parents to those of their children. `gains` are those of `parents` parents;
    /// gains without offsets change nothing.
    pub fn add_offsets(&mut self, gains: &[f32], parents: usize) {
        let (offsets, rest) = gains.as_chunks::<GAIN_WITH_OFFSETS>();
        if offsets.len() != parents || !rest.is_empty() || self.splats.is_empty() {
            return;
        }
        let children = (self.splats.len() / parents.max(1)).max(1);
        let of_child = |i: usize| {
            let parent = match &self.origins {
                Origins::Regular => i / children,
                Origins::Mixed { parents, .. } => parents[i] as usize,
            };
            let [_, r, g, b] = offsets[parent];
            [r, g, b]
        };
        let offsets: Vec<f32> = (0..self.splats.len()).flat_map(of_child).collect();
        self.splats.gain = with_residuals(&self.splats.gain, &offsets);
    }

    /// Adds the photographs' detail to the colours. Returns whether any photograph has detail.
    ///
    /// # Errors
    /// A photograph without pixels.
    pub fn add_detail(&mut self, inputs: &[Cropped], upscale: usize) -> Result<bool> {
        match &self.origins {
            Origins::Regular => add_detail(&mut self.splats, inputs, upscale),
            Origins::Mixed { parents, counts } => {
                detail::add_mixed(&mut self.splats, inputs, parents, counts)
            }
        }
    }

    /// Gaussians of which the photographs are not known.
    pub fn of_splats(splats: Splats) -> Self {
        let (groups, distances) = Default::default();
        Self { splats, groups, distances, origins: Origins::Regular }
    }

    /// Returns K of each parent; empty where all have the same.
    pub(crate) fn counts(&self) -> &[u8] {
        match &self.origins {
            Origins::Regular => &[],
            Origins::Mixed { counts, .. } => counts,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::finish::FitOptions;
    use crate::network::config::{Config, Preset};
    use crate::reconstruct::{
        Check, DepthRange, Options, Photo, Reconstruction, Reconstructor, Refine, Surroundings,
    };
    use crate::scene::mask::Mask;
    use crate::scene::pictures::Rgb;
    use glam::{Mat4, Vec2, Vec3};
    use subsplat_kernels::camera::{Camera, Intrinsics};

    /// Side of the photographs, and of the network's input, px.
    const SIDES: [usize; 2] = [128, 64];

    /// Photographs of a textured wall from cameras side by side.
    fn photos(count: usize) -> Vec<Photo> {
        let side = SIDES[0];
        let photo = |i: usize| {
            let place = Vec3::new(0.12 * i as f32, 0.0, 0.0);
            let k = Intrinsics::from_fov_x(1.0, side, side);
            let camera = Camera::new(k, Mat4::from_translation(place)).unwrap();
            let mut image = Rgb::black(side, side);
            for (i, pixel) in image.data.chunks_exact_mut(3).enumerate() {
                let px = Vec2::new((i % side) as f32 + 0.5, (i / side) as f32 + 0.5);
                let p = place + 2.5 * k.unproject(px);
                let wave = |a: f32, b: f32| 60.0 * (a * p.x + b * p.y).sin() + 120.0;
                pixel.copy_from_slice(
                    &[(9.0, 4.0), (-3.0, 14.0), (21.0, -8.0)].map(|(a, b)| wave(a, b) as u8),
                );
            }
            Photo::new(image, camera).unwrap()
        };
        (0..count).map(photo).collect()
    }

    /// Masks the left and an upper part of a photograph of this index, in whole pixels of the input.
    fn is_kept(photo: usize, x: usize, y: usize) -> bool {
        x >= 20 + 4 * photo && y >= 8
    }

    fn masked(photos: Vec<Photo>) -> Vec<Photo> {
        let side = SIDES[0];
        let with = |(i, photo): (usize, Photo)| {
            // Masked pixels would make white Gaussians.
            let mut image = photo.image().clone();
            let kept: Vec<bool> =
                (0..side * side).map(|p| is_kept(i, p % side / 2, p / side / 2)).collect();
            for (pixel, _) in image.data.chunks_exact_mut(3).zip(&kept).filter(|(_, kept)| !**kept)
            {
                pixel.fill(255);
            }
            let mask = Mask::new(side, side, kept).unwrap();
            Photo::new(image, *photo.camera()).unwrap().with_mask(mask).unwrap()
        };
        photos.into_iter().enumerate().map(with).collect()
    }

    fn run(photos: &[Photo], density: Density, steps: usize) -> Reconstruction {
        let model = Reconstructor::untrained(&Config::small(Preset::Tuned, 2), 7).unwrap();
        let options = Options::default()
            .with_input_size(SIDES[1], SIDES[1])
            .with_check(Check::Off)
            .with_depth_range(DepthRange::Fixed { near: 1.0, far: 6.0 })
            .with_density(density)
            .with_surroundings(Surroundings::Off)
            .with_fit(FitOptions::default().with_steps(steps))
            .with_refine(Refine::Steps(steps));
        model.run(photos, &options).unwrap()
    }

    #[test]
    fn masked_pixels_have_no_gaussians() {
        let (side, area) = (SIDES[1], SIDES[1] * SIDES[1]);
        for (count, steps) in [(2, 0), (2, 2), (3, 1)] {
            let all: Vec<bool> = (0..count * area)
                .map(|i| is_kept(i / area, i % area % side, i % area / side))
                .collect();
            let number = all.iter().filter(|kept| **kept).count();
            let photos = masked(photos(count));
            for (density, most) in [
                (Density::Full, 4 * number),
                (Density::Share(0.5), 2 * number),
                (Density::Count(900), 900),
                (Density::Each(4), 4 * number),
            ] {
                let result = run(&photos, density, steps);
                let counts = result.children_counts();
                assert_eq!(counts.len(), all.len(), "{density:?}");
                for (i, (k, kept)) in counts.iter().zip(&all).enumerate() {
                    assert!(*kept || *k == 0, "{density:?} {i}");
                    assert!(!kept || density != Density::Full || *k == 4, "{density:?} {i}");
                }
                let splats = result.splats();
                let made: usize = counts.iter().map(|k| usize::from(*k)).sum();
                assert!(made <= most && made > 0, "{density:?}: {made} of {most}");
                // Of three, those that the photographs hardly show are removed.
                assert!(count > 2 || 10 * made > 7 * most, "{density:?}: {made} of {most}");
                assert!(splats.len() == made || (count > 2 && splats.len() < made));
                assert_eq!(result.groups.ranges.last().unwrap().end, splats.len());
                for (view, range) in result.groups.ranges.iter().enumerate() {
                    let input = &result.inputs()[view];
                    assert_eq!(
                        input.input_mask.as_ref().unwrap().kept(),
                        &all[view * area..][..area]
                    );
                    // Each Gaussian lies in its pixel before it is moved.
                    for i in range.clone().filter(|_| steps == 0) {
                        let p = input.input_camera.project(splats.mean(i).into()).unwrap();
                        let (x, y) = (p.x as usize, p.y as usize);
                        assert!(is_kept(view, x, y) && x < side && y < side, "{density:?} {p}");
                    }
                }
                for (depth, kept) in result.depths().iter().zip(all.chunks(area)) {
                    let pairs = depth.data.iter().zip(kept);
                    assert!(pairs.clone().all(|(z, kept)| (*z > 0.0) == *kept));
                }
                // The background is the mean of what counts.
                let background = result.raster_options().background;
                assert!(background.iter().all(|v| *v < 0.6), "{background:?}");
            }
        }
    }

    /// The optimisation does not see what is masked, and a mask that keeps all is none.
    #[test]
    fn masked_content_does_not_matter() {
        let first = masked(photos(2));
        let other: Vec<Photo> = first
            .iter()
            .map(|photo| {
                let mut image = photo.image().clone();
                let mask = photo.mask().unwrap().clone();
                for (pixel, kept) in image.data.chunks_exact_mut(3).zip(mask.kept()) {
                    if !kept {
                        pixel.copy_from_slice(&[10, 200, 30]);
                    }
                }
                Photo::new(image, *photo.camera()).unwrap().with_mask(mask).unwrap()
            })
            .collect();
        let [a, b] = [&first, &other].map(|photos| run(photos, Density::Full, 2));
        assert_eq!(a.splats(), b.splats());
        let refinement = a.refinement().unwrap();
        assert!(refinement.after <= refinement.before);
        let whole = photos(2);
        let all = Mask::new(128, 128, vec![true; 128 * 128]).unwrap();
        let kept: Vec<Photo> =
            whole.iter().map(|photo| photo.clone().with_mask(all.clone()).unwrap()).collect();
        let [a, b] = [&whole, &kept].map(|photos| run(photos, Density::Full, 1));
        assert!(a.splats() == b.splats() && b.children_counts().is_empty());
    }

    #[test]
    fn masks_are_checked() {
        let photo = || photos(1).remove(0);
        for (mask, words) in [
            (Mask::new(2, 2, vec![true; 4]).unwrap(), "got one of 2x2"),
            (Mask::new(128, 128, vec![false; 128 * 128]).unwrap(), "keeps none"),
        ] {
            let error = photo().with_mask(mask).unwrap_err().to_string();
            assert!(error.contains("mask") && error.contains(words), "{error}");
        }
    }
}
