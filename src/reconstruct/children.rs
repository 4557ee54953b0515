//! The Gaussians of a scene: the same number of children for each parent, or more where the
//! photographs have detail.

use super::density::{Density, counts, grids};
use super::detail::{self, add_detail};
use super::finishing::input_views;
use super::{Error, Result};
use crate::finish::{Groups, LEAST_SHARE, hidden, shares};
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
pub struct Counts {
    /// K of each parent.
    counts: Vec<u8>,
    /// The parents.
    parents: Splats,
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
/// pictures of the input's size, from which the parents' shares come.
///
/// # Errors
/// Those of the network; a number of [`Density::Each`] that is not in 1 to 64.
pub fn counts_of(
    network: &SubSplat,
    encoding: &SceneEncoding,
    inputs: &[Cropped],
    density: Density,
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Result<Option<Counts>> {
    let grids = grids_of(network);
    let upscale = grids.last().copied().unwrap_or(1);
    if density.is_full(encoding.per_view() * inputs.len(), inputs.len(), upscale) {
        return Ok(None);
    }
    let parents = encoding.parents(network)?;
    let photographs = input_views(inputs);
    let mut shares = shares(&parents, &photographs, raster, renderer);
    let mut limit = density.limit(parents.len(), inputs.len(), upscale);
    let hidden = hidden(&shares, inputs.len(), LEAST_SHARE);
    for (share, _) in shares.iter_mut().zip(&hidden).filter(|(_, hidden)| **hidden) {
        *share = 0.0;
        limit = limit.saturating_add(1);
    }
    let mut counts = match density {
        Density::Each(children) => vec![each(children)?; shares.len()],
        _ => counts(inputs, &shares, &grids, limit),
    };
    for (count, _) in counts.iter_mut().zip(&hidden).filter(|(_, hidden)| **hidden) {
        *count = 0;
    }
    Ok(Some(Counts { counts, parents }))
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
        let Some(Counts { counts, parents }) = counts else {
            let SceneOutput { children, depths } = encoding.children(network, checkpoint)?;
            let size = per_view * children.k;
            let ranges = (0..photographs).map(|view| view * size..(view + 1) * size).collect();
            let groups = Groups { ranges, equal_families: true };
            let splats = children.to_splats()?;
            let origins = Origins::Regular;
            return Ok(Self { splats, groups, distances: depths, origins });
        };
        let (mixed, distances) = encoding.mixed(network, &parents, &counts, checkpoint)?;
        let end = |view: usize| mixed.parents.partition_point(|p| (*p as usize) < view * per_view);
        let ranges = (0..photographs).map(|view| end(view)..end(view + 1)).collect();
        let groups = Groups { ranges, equal_families: false };
        let origins = Origins::Mixed { parents: mixed.parents, counts };
        Ok(Self { splats: mixed.splats, groups, distances, origins })
    }

    /// Adds the colour offsets of `parents` to those of their children. Parents without offsets change
    /// nothing.
    pub fn add_offsets(&mut self, parents: &Splats) {
        let (offsets, rest) = parents.gain.as_chunks::<GAIN_WITH_OFFSETS>();
        if offsets.len() != parents.len() || !rest.is_empty() || self.splats.is_empty() {
            return;
        }
        let children = (self.splats.len() / parents.len().max(1)).max(1);
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
