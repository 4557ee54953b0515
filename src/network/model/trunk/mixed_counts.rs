//! Children of parents with different numbers of them (ours, not the paper's).
//!
//! In: K of each parent, 0 to 64. At K = 1 a parent is its own child, at K = 0 it has none. Out:
//! packed rows in the order of the parents, each with the index of its parent. Optical depth
//! ([`crate::network::config::OpacityRule`]) makes neighbours of different K agree.

use super::DeviceParents;
use super::{Parts, Records, Scene, Span, Trunk};
use crate::network::model::geometry::ParentChunk;
use crate::network::model::mlp::Mode;
use crate::network::model::spgr_heads::rules;
use crate::network::model::trace::Checkpoint;
use crate::network::model::{BackboneOutput, Primaries, Views};
use crate::network::ops::Array;
use crate::scene::splats::Splats;
use candle_core::Tensor;
use candle_core::{DType, Result, bail};
use rayon::prelude::*;
use subsplat_kernels::layout::SPLAT_STRIDE;

/// Gaussians of one scene with different numbers of children per parent.
#[derive(Clone, Debug)]
pub struct MixedChildren {
    /// The Gaussians. Each has an SH set of its own, a copy of its parent's.
    pub splats: Splats,
    /// `[N]`: index of each Gaussian's parent, in ascending order.
    pub parents: Vec<u32>,
}

/// Parents of one view with the same K.
struct Group {
    children: usize,
    indices: Vec<u32>,
}

/// Children of a group: rows and gains.
type Made = (Vec<f32>, Vec<f32>);

impl Trunk {
    /// Computes the children of the one scene in `views`; parent i has `counts[i]` of them.
    /// `checkpoint` runs after each chunk of parents, on any thread.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`] and of `checkpoint`; another number of `counts` than of parents;
    /// a count above 64, or one that the heads do not serve.
    pub fn forward_mixed(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        counts: &[u8],
        checkpoint: Checkpoint<'_>,
    ) -> Result<MixedChildren> {
        let parents = self.parents(views, primaries)?.to_splats()?;
        self.host_mixed(views, backbone, (primaries, &parents), counts, checkpoint)
    }

    /// [`Trunk::forward_mixed`] of primaries that `parents` has as Gaussians.
    ///
    /// # Errors
    /// Those of [`Trunk::forward_mixed`].
    pub(in crate::network::model) fn host_mixed(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        (primaries, parents): (&Primaries, &Splats),
        counts: &[u8],
        checkpoint: Checkpoint<'_>,
    ) -> Result<MixedChildren> {
        self.mixed(parents, primaries.per_view, counts, |groups| {
            self.made(views, backbone, primaries, groups, checkpoint)
        })
    }

    /// [`Trunk::forward_mixed`] of primaries in device memory; `host` has copies of them.
    ///
    /// # Errors
    /// Those of [`Trunk::forward_mixed`].
    pub(in crate::network::model) fn device_mixed(
        &self,
        views: &Views,
        (parents, host): (&DeviceParents, &Splats),
        counts: &[u8],
        checkpoint: Checkpoint<'_>,
    ) -> Result<MixedChildren> {
        self.mixed(host, parents.per_view, counts, |groups| {
            let parts = self.parts_of_groups()?;
            let scene = self.device_scene(parts, views, parents)?;
            self.made_of(parts, &scene, groups, checkpoint)
        })
    }

    /// Children of `parents`, of which `made` computes those of the groups.
    fn mixed(
        &self,
        parents: &Splats,
        per_view: usize,
        counts: &[u8],
        made: impl FnOnce(&[Group]) -> Result<Vec<Made>>,
    ) -> Result<MixedChildren> {
        if counts.len() != parents.len() {
            let (expected, got) = (parents.len(), counts.len());
            bail!("numbers of children: expected one for each of {expected} parents, got {got}");
        }
        let groups = groups(counts, per_view, self.chunk_size());
        let made = if groups.iter().any(|group| group.children > 1) {
            made(&groups)?
        } else {
            groups.iter().map(|_| Made::default()).collect()
        };
        Ok(assembled(parents, counts, &groups, &made))
    }

    /// The parts, which groups of several children need.
    fn parts_of_groups(&self) -> Result<&Parts> {
        match &self.parts {
            Some(parts) => Ok(parts),
            None => bail!("children per parent: expected 0 or 1 where SPGR is off, got more"),
        }
    }

    /// Children of every group with more than one.
    fn made(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        groups: &[Group],
        checkpoint: Checkpoint<'_>,
    ) -> Result<Vec<Made>> {
        let parts = self.parts_of_groups()?;
        if primaries.means.dtype() != DType::F32 {
            bail!("primaries: expected f32, got {:?}", primaries.means.dtype());
        }
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
        let mut counts: Vec<usize> = groups.iter().map(|g| g.children).filter(|k| *k > 1).collect();
        counts.sort_unstable();
        counts.dedup();
        for children in counts {
            let mut trunk = self.clone();
            trunk.set_children(children)?;
            let scene = scene.for_rules_of(&trunk, parts)?;
            let run = |(group, made): (&Group, &mut Made)| {
                *made = trunk.children_of(parts, &scene, group)?;
                checkpoint()
            };
            let of_count = |(group, _): &(&Group, &mut Made)| group.children == children;
            if self.backend.is_cpu() {
                groups.par_iter().zip(&mut made).filter(of_count).try_for_each(run)?
            } else {
                groups.iter().zip(&mut made).filter(of_count).try_for_each(run)?
            }
        }
        Ok(made)
    }

    /// Children of one group; the trunk and the scene have its K.
    fn children_of<A: Array>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        group: &Group,
    ) -> Result<Made> {
        let first = group.indices.first().map_or(0, |i| *i as usize);
        let view = first / scene.per_view.max(1);
        let chosen = |t: &A| t.index_select(&group.indices, 0);
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
        let count = group.indices.len() * group.children;
        let mut rows = vec![0f32; count * SPLAT_STRIDE];
        let mut gains = vec![0f32; count * scene.rules.gain_channels()];
        // SPGR reads a parent's view from its index, so any index of the view will do.
        let call = scene.call(Span { first: view * scene.per_view, len: group.indices.len() });
        head.write_children(&parents, &call, &self.backend, &mut rows, &mut gains)?;
        Ok((rows, gains))
    }
}

impl<'a, A: Array> Scene<'a, A> {
    /// The same scene for the K of `trunk`.
    fn for_rules_of(&self, trunk: &Trunk, parts: &Parts) -> Result<Scene<'a, A>> {
        let children = trunk.rules.children();
        Ok(Scene {
            heads: parts.heads.for_children(children)?,
            rules: rules(&trunk.config, children),
            ..self.clone()
        })
    }
}

/// Parents with children in groups of one view and one K, of at most `size` parents.
fn groups(counts: &[u8], per_view: usize, size: usize) -> Vec<Group> {
    let mut groups = Vec::new();
    for (view, counts) in counts.chunks(per_view.max(1)).enumerate() {
        let mut by_count: Vec<Vec<u32>> = Vec::new();
        for (i, children) in counts.iter().enumerate().filter(|(_, children)| **children > 0) {
            let children = usize::from(*children);
            by_count.resize_with(by_count.len().max(children + 1), Vec::new);
            by_count[children].push((view * per_view + i) as u32);
        }
        for (children, indices) in by_count.into_iter().enumerate() {
            let parts = indices.chunks(size.max(1));
            groups.extend(parts.map(|part| Group { children, indices: part.to_vec() }));
        }
    }
    groups
}

/// Rows, SH sets and gains in the order of the parents.
fn assembled(parents: &Splats, counts: &[u8], groups: &[Group], made: &[Made]) -> MixedChildren {
    let count: usize = counts.iter().map(|k| usize::from(*k)).sum();
    let mut starts = Vec::with_capacity(counts.len());
    let mut of_children = Vec::with_capacity(count);
    for (parent, children) in counts.iter().enumerate() {
        starts.push(of_children.len());
        of_children.extend(std::iter::repeat_n(parent as u32, usize::from(*children)));
    }
    let set = 3 * parents.sh_coefficients();
    let mut sh = Vec::with_capacity(count * set);
    for parent in &of_children {
        sh.extend_from_slice(parents.sh_of(*parent as usize));
    }
    let children = |(group, (_, gains)): (&Group, &Made)| {
        gains.len() / (group.indices.len() * group.children).max(1)
    };
    // γ, or γ and δ.
    let channels = groups.iter().zip(made).map(children).max().unwrap_or(0).max(1);
    let mut rows = vec![0f32; count * SPLAT_STRIDE];
    let mut gain = vec![0f32; count * channels];
    gain.iter_mut().step_by(channels).for_each(|gamma| *gamma = 1.0);
    for (group, (made_rows, made_gains)) in groups.iter().zip(made) {
        let k = group.children;
        for (i, parent) in group.indices.iter().map(|p| *p as usize).enumerate() {
            let begin = starts[parent];
            let end = starts[parent] + k;
            let own = &mut rows[begin * SPLAT_STRIDE..end * SPLAT_STRIDE];
            if k == 1 {
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
