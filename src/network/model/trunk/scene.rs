//! What all chunks of a scene share, and the head records of one chunk.

use super::{Parts, Trunk};
use crate::network::config::{FeatureLevel, ShInput};
use crate::network::model::aggregation::Prepared;
use crate::network::model::embed::Descriptors;
use crate::network::model::geometry::{Frames, ParentChunk};
use crate::network::model::mlp::Mode;
use crate::network::model::spgr_heads::Heads;
use crate::network::model::{BackboneOutput, Primaries, Views};
use crate::network::ops::Array;
use crate::network::ops::spgr::{Rules, Spgr};
use candle_core::{DType, Device, Result, Tensor, bail};
use subsplat_kernels::layout::sh_coefficients;

/// Arrays that all chunks of one scene share.
#[derive(Clone)]
pub(super) struct Scene<'a, A = Tensor> {
    pub(super) views: &'a Views,
    pub(super) frames: Frames,
    pub(super) means: A,
    pub(super) quats_wxyz: A,
    pub(super) scales: A,
    pub(super) opacities: A,
    pub(super) sh_input: A,
    pub(super) per_view: usize,
    pub(super) prepared: Option<Prepared<A>>,
    /// The heads for the r of `rules`.
    pub(super) heads: Heads,
    pub(super) rules: Rules,
}

/// Arrays of one scene's N parents on one executor.
pub(super) struct ParentArrays<A> {
    /// `[N, 3]`.
    pub(super) means: A,
    /// `[N, 4]`.
    pub(super) quats_wxyz: A,
    /// `[N, 3]`.
    pub(super) scales: A,
    /// `[N, 1]`.
    pub(super) opacities: A,
    /// `[N, 3·D]`.
    pub(super) sh_input: A,
    pub(super) per_view: usize,
}

/// Consecutive parents of one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Span {
    pub(super) first: usize,
    pub(super) len: usize,
}

/// Input of SPGR for one chunk.
pub(super) struct Records<A = Tensor> {
    /// `[n, K, 11]`: head records.
    pub(super) head: A,
    /// `[n, 11]`: packed parents.
    pub(super) parents: A,
}

impl Trunk {
    pub(super) fn scene<'a>(
        &self,
        parts: &Parts,
        views: &'a Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Scene<'a>> {
        self.scene_on(parts, views, backbone, primaries, |t| Ok(t.clone()))
    }

    /// [`Trunk::scene`] on the executor to which `like` copies tensors.
    pub(super) fn scene_on<'a, A: Array>(
        &self,
        parts: &Parts,
        views: &'a Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        like: impl Fn(&Tensor) -> Result<A>,
    ) -> Result<Scene<'a, A>> {
        check_single(views, primaries)?;
        // Contiguous once, so that no chunk copies its rows out of wider ones.
        let own = |t: &Tensor| like(&t.squeeze(0)?.contiguous()?);
        let (_, n, _) = primaries.means.dims3()?;
        let sh = match self.config.embed.sh {
            ShInput::World => &primaries.sh,
            ShInput::Camera => &primaries.sh_camera,
        };
        let (_, _, channels, d) = sh.dims4()?;
        let expected = sh_coefficients(self.config.primaries().sh_degree);
        if (channels, d) != (3, expected) {
            bail!("primaries SH: expected [1, {n}, 3, {expected}], got {:?}", sh.dims());
        }
        let arrays = ParentArrays {
            means: own(&primaries.means)?,
            quats_wxyz: own(&primaries.quats_wxyz)?,
            scales: own(&primaries.scales)?,
            opacities: own(&primaries.opacities)?.reshape((n, 1))?,
            sh_input: like(&sh.reshape((n, 3 * d))?)?,
            per_view: primaries.per_view,
        };
        let kind = (primaries.means.dtype(), primaries.means.device());
        let feature = |level| like(backbone.feature(level)?);
        self.scene_from(parts, views, arrays, kind, feature)
    }

    /// The scene of `parents`; `feature` returns a level of the backbone's feature maps, and the cameras
    /// become tensors of `dtype` on `device`.
    pub(super) fn scene_from<'a, A: Array>(
        &self,
        parts: &Parts,
        views: &'a Views,
        parents: ParentArrays<A>,
        (dtype, device): (DType, &Device),
        feature: impl Fn(FeatureLevel) -> Result<A>,
    ) -> Result<Scene<'a, A>> {
        let frames = Frames::new(&views.cameras[0], dtype, device)?;
        let ParentArrays { means, quats_wxyz, scales, opacities, sh_input, per_view } = parents;
        let prepared = match &parts.aggregation {
            Some(agg) => Some(agg.prepare(views, &frames, feature, &means)?),
            None => None,
        };
        Ok(Scene {
            views,
            frames,
            means,
            quats_wxyz,
            scales,
            opacities,
            sh_input,
            per_view,
            prepared,
            heads: parts.heads.for_children(self.rules.children())?,
            rules: self.rules,
        })
    }

    /// Records of the parents in `span`.
    pub(super) fn records<A: Array>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        span: Span,
        mode: Mode,
    ) -> Result<Records<A>> {
        self.records_of(parts, scene, scene.chunk(span)?, mode)
    }

    pub(super) fn records_of<A: Array>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        parents: ParentChunk<A>,
        mode: Mode,
    ) -> Result<Records<A>> {
        let z: Descriptors<A> = parts.embeddings.forward(&parents, &scene.frames)?;
        let inputs = match (&parts.aggregation, &scene.prepared) {
            (Some(agg), Some(prepared)) => {
                let f = agg.forward(prepared, &parents, &scene.frames, &z, mode)?;
                agg.head_inputs(f, &z)?
            }
            // f = 0 without aggregation, so that the heads read z.
            _ => z,
        };
        let head = scene.heads.forward(&inputs, scene.rules.children())?;
        Ok(Records { head, parents: parents.rows()? })
    }
}

impl<A: Array> Scene<'_, A> {
    pub(super) fn chunk(&self, Span { first, len }: Span) -> Result<ParentChunk<A>> {
        Ok(ParentChunk {
            first,
            source: first / self.per_view,
            means: self.means.narrow(0, first, len)?,
            quats_wxyz: self.quats_wxyz.narrow(0, first, len)?,
            scales: self.scales.narrow(0, first, len)?,
            opacities: self.opacities.narrow(0, first, len)?,
            sh: self.sh_input.narrow(0, first, len)?,
        })
    }

    pub(super) fn call(&self, span: Span) -> Spgr {
        Spgr {
            rules: self.rules,
            cameras: self.views.cameras[0].clone(),
            near: self.views.near_far[0].iter().map(|range| range.near).collect(),
            per_view: self.per_view,
            first: span.first,
        }
    }
}

/// Splits `n` parents into spans of at most `size` parents, each within one view.
pub(super) fn chunks(n: usize, per_view: usize, size: usize) -> impl Iterator<Item = Span> {
    let views = n / per_view.max(1);
    (0..views).flat_map(move |v| {
        (0..per_view.div_ceil(size)).map(move |i| {
            let first = v * per_view + i * size;
            Span { first, len: size.min((v + 1) * per_view - first) }
        })
    })
}

pub(super) fn check_single(views: &Views, primaries: &Primaries) -> Result<()> {
    let (b, n, _) = primaries.means.dims3()?;
    if views.scenes() != 1 || b != 1 {
        bail!("trunk: expected one scene, got {} of views and {b} of primaries", views.scenes());
    }
    check_views(views, n, primaries.per_view)?;
    let fits = primaries.quats_wxyz.dims() == [1, n, 4]
        && primaries.scales.dims() == [1, n, 3]
        && primaries.opacities.dims() == [1, n];
    if !fits {
        bail!(
            "primaries: expected quaternions [1, {n}, 4], scales [1, {n}, 3], opacities [1, {n}], got {:?}, {:?}, {:?}",
            primaries.quats_wxyz.dims(),
            primaries.scales.dims(),
            primaries.opacities.dims()
        );
    }
    Ok(())
}

/// Refuses `n` parents that are not `per_view` of each view.
pub(super) fn check_views(views: &Views, n: usize, per_view: usize) -> Result<()> {
    if per_view == 0 || n != per_view * views.views() {
        bail!("primaries: expected {} views of {per_view} parents, got {n} parents", views.views());
    }
    Ok(())
}
