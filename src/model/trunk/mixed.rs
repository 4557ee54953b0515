//! Children of parents with different numbers of them (ours, not the paper's).
//!
//! In: r of each parent, 0 to [`UPSCALE_MAX`](super::UPSCALE_MAX). A parent has r² children; at r = 1 it is its own child,
//! at r = 0 it has none. Out: packed rows in the order of the parents, each with the index of its
//! parent. Optical depth ([`crate::config::OpacityRule`]) makes neighbours of different r agree.

use super::{Parts, Records, Scene, Span, Trunk};
use crate::abi::SPLAT_STRIDE;
use crate::model::geometry::ParentChunk;
use crate::model::mlp::Mode;
use crate::model::spgr::rules;
use crate::model::trace::Checkpoint;
use crate::model::{BackboneOutput, Primaries, Views};
use crate::ops::Array;
use crate::splats::Splats;
#[cfg(feature = "gpu")]
use candle_core::Tensor;
use candle_core::{DType, Result, bail};
use rayon::prelude::*;

/// Gaussians of one scene with different numbers of children per parent.
#[derive(Clone, Debug)]
pub struct MixedChildren {
    /// The Gaussians. Each has an SH set of its own, a copy of its parent's.
    pub splats: Splats,
    /// `[N]`: index of each Gaussian's parent, in ascending order.
    pub parents: Vec<u32>,
}

/// Parents of one view with the same r.
struct Group {
    side: usize,
    indices: Vec<u32>,
}

/// Children of a group: rows and gains.
type Made = (Vec<f32>, Vec<f32>);

impl Trunk {
    /// Computes the children of the one scene in `views`; parent i has `sides[i]`² of them.
    /// `checkpoint` runs after each chunk of parents, on any thread.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`] and of `checkpoint`; another number of `sides` than of parents;
    /// a side above [`UPSCALE_MAX`](super::UPSCALE_MAX), or one that the heads do not serve.
    pub fn forward_mixed(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        sides: &[u8],
        checkpoint: Checkpoint<'_>,
    ) -> Result<MixedChildren> {
        let parents = self.parents(views, primaries)?.to_splats()?;
        if sides.len() != parents.len() {
            bail!("sides: expected one for each of {} parents, got {}", parents.len(), sides.len());
        }
        let groups = groups(sides, primaries.per_view, self.chunk_size());
        let made = match groups.iter().any(|group| group.side > 1) {
            true => self.made(views, backbone, primaries, &groups, checkpoint)?,
            false => groups.iter().map(|_| Made::default()).collect(),
        };
        Ok(assembled(&parents, sides, &groups, &made))
    }

    /// Children of every group with a side above 1.
    fn made(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        groups: &[Group],
        checkpoint: Checkpoint<'_>,
    ) -> Result<Vec<Made>> {
        let Some(parts) = &self.parts else {
            bail!("sides: expected 0 or 1 where SPGR is off, got more")
        };
        if primaries.means.dtype() != DType::F32 {
            bail!("primaries: expected f32, got {:?}", primaries.means.dtype());
        }
        #[cfg(feature = "gpu")]
        if let Some(result) = self.on_device(|executor| {
            let like = |t: &Tensor| executor.upload(t);
            let scene = self.scene_on(parts, views, backbone, primaries, like)?;
            self.made_of(parts, &scene, groups, checkpoint)
        }) {
            return result;
        }
        let scene = self.scene(parts, views, backbone, primaries)?;
        self.made_of(parts, &scene, groups, checkpoint)
    }

    /// [`Trunk::made`] of one scene.
    fn made_of<A: Array + Sync>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        groups: &[Group],
        checkpoint: Checkpoint<'_>,
    ) -> Result<Vec<Made>> {
        checkpoint()?;
        let mut made: Vec<Made> = groups.iter().map(|_| Made::default()).collect();
        let mut sides: Vec<usize> = groups.iter().map(|g| g.side).filter(|s| *s > 1).collect();
        sides.sort_unstable();
        sides.dedup();
        for side in sides {
            let mut trunk = self.clone();
            trunk.set_upscale(side)?;
            let scene = scene.for_side(&trunk, parts)?;
            let run = |(group, made): (&Group, &mut Made)| {
                *made = trunk.children_of(parts, &scene, group)?;
                checkpoint()
            };
            let of_side = |(group, _): &(&Group, &mut Made)| group.side == side;
            match self.backend.is_cpu() {
                true => groups.par_iter().zip(&mut made).filter(of_side).try_for_each(run)?,
                false => groups.iter().zip(&mut made).filter(of_side).try_for_each(run)?,
            }
        }
        Ok(made)
    }

    /// Children of one group; the trunk and the scene have its side.
    fn children_of<A: Array>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        group: &Group,
    ) -> Result<Made> {
        let first = group.indices.first().map_or(0, |i| *i as usize);
        let view = first / scene.per_view.max(1);
        let chosen = |t: &A| t.selected(0, &group.indices);
        let own = ParentChunk {
            first,
            source: view,
            means: chosen(&scene.means)?,
            quats_wxyz: chosen(&scene.quats_wxyz)?,
            scales: chosen(&scene.scales)?,
            opacities: chosen(&scene.opacities)?,
            sh: chosen(&scene.sh_input)?,
        };
        let Records { head, parents } = self.records_of(parts, scene, own, Mode::Infer)?;
        let count = group.indices.len() * group.side * group.side;
        let mut rows = vec![0f32; count * SPLAT_STRIDE];
        let mut gains = vec![0f32; count * scene.rules.gain_channels()];
        // SPGR reads a parent's view from its index, so any index of the view will do.
        let call = scene.call(Span { first: view * scene.per_view, len: group.indices.len() });
        head.write_children(&parents, &call, &self.backend, &mut rows, &mut gains)?;
        Ok((rows, gains))
    }
}

impl<'a, A: Array> Scene<'a, A> {
    /// The same scene for the r of `trunk`.
    fn for_side(&self, trunk: &Trunk, parts: &Parts) -> Result<Scene<'a, A>> {
        let side = trunk.rules.side;
        Ok(Scene {
            heads: parts.heads.for_side(side)?,
            rules: rules(&trunk.config, side),
            ..self.clone()
        })
    }
}

/// Parents with children in groups of one view and one side, of at most `size` parents.
fn groups(sides: &[u8], per_view: usize, size: usize) -> Vec<Group> {
    let mut groups = Vec::new();
    for (view, sides) in sides.chunks(per_view.max(1)).enumerate() {
        let mut by_side: Vec<Vec<u32>> = Vec::new();
        for (i, side) in sides.iter().enumerate().filter(|(_, side)| **side > 0) {
            let side = usize::from(*side);
            by_side.resize_with(by_side.len().max(side + 1), Vec::new);
            by_side[side].push((view * per_view + i) as u32);
        }
        for (side, indices) in by_side.into_iter().enumerate() {
            let parts = indices.chunks(size.max(1));
            groups.extend(parts.map(|part| Group { side, indices: part.to_vec() }));
        }
    }
    groups
}

/// Rows, SH sets and gains in the order of the parents.
fn assembled(parents: &Splats, sides: &[u8], groups: &[Group], made: &[Made]) -> MixedChildren {
    let square = |side: &u8| usize::from(*side).pow(2);
    let count: usize = sides.iter().map(square).sum();
    let mut starts = Vec::with_capacity(sides.len());
    let mut of_children = Vec::with_capacity(count);
    for (parent, side) in sides.iter().enumerate() {
        starts.push(of_children.len());
        of_children.extend(std::iter::repeat_n(parent as u32, square(side)));
    }
    let set = 3 * parents.sh_coefficients();
    let mut sh = Vec::with_capacity(count * set);
    for parent in &of_children {
        sh.extend_from_slice(parents.sh_of(*parent as usize));
    }
    let children = |(group, (_, gains)): (&Group, &Made)| {
        gains.len() / (group.indices.len() * group.side * group.side).max(1)
    };
    // γ, or γ and δ.
    let channels = groups.iter().zip(made).map(children).max().unwrap_or(0).max(1);
    let mut rows = vec![0f32; count * SPLAT_STRIDE];
    let mut gain = vec![0f32; count * channels];
    gain.iter_mut().step_by(channels).for_each(|gamma| *gamma = 1.0);
    for (group, (made_rows, made_gains)) in groups.iter().zip(made) {
        let k = group.side * group.side;
        for (i, parent) in group.indices.iter().map(|p| *p as usize).enumerate() {
            let (begin, end) = (starts[parent], starts[parent] + k);
            let own = &mut rows[begin * SPLAT_STRIDE..end * SPLAT_STRIDE];
            if group.side == 1 {
                own.copy_from_slice(parents.row(parent));
                continue;
            }
            own.copy_from_slice(&made_rows[i * k * SPLAT_STRIDE..][..k * SPLAT_STRIDE]);
            let own = &mut gain[begin * channels..end * channels];
            own.copy_from_slice(&made_gains[i * k * channels..][..k * channels]);
        }
    }
    let (sh_degree, sh_basis) = (parents.sh_degree, parents.sh_basis);
    MixedChildren { splats: Splats { rows, sh, gain, sh_degree, sh_basis }, parents: of_children }
}
