//! SubSplat's part of the network, end to end: embeddings, aggregation, heads and SPGR
//! (SubSplat 3.2, A.2, A.3). It processes chunks of parents, so that no `[N, E]` tensor of
//! all parents exists at inference.
//!
//! Parameters under `subsplat`: `embed`, `agg`, `geo`, `app`; none with SPGR off.

mod initial_values;
mod mixed_counts;
mod on_device;
mod recompute;
mod scene;
mod scene_gaussians;

pub use initial_values::{initial_value, set_initial_values};
pub use mixed_counts::MixedChildren;
pub(super) use on_device::DeviceParents;
pub use recompute::Recomputed;
pub use scene_gaussians::Children;

use scene::{ParentArrays, Records, Scene, Span, check_single, check_views, chunks};

use super::aggregation::Aggregation;
use super::embed::Embeddings;
use super::mlp::Mode;
use super::spgr_heads::{Heads, rules};
use super::trace::Checkpoint;
use super::{BackboneOutput, Primaries, Views};
use crate::network::config::{Config, FeatureLevel, SpgrHead};
use crate::network::ops::Executor;
use crate::network::ops::direct_rendering::{Footprint, rasterize_footprints, spgr_footprints};
use crate::network::ops::spgr::{Rules, spgr_on};
use crate::network::ops::{Array, Backend, rasterize_on};
use candle_core::{DType, Result, Tensor, bail};
use candle_nn::VarBuilder;
use rayon::prelude::*;
use std::sync::Arc;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{
    CHILDREN_MAX, RasterOptions, SPLAT_STRIDE, ShBasis, sh_coefficients,
};

/// Parents per chunk at inference. A `[256, 128]` activation fits into a core's L2 cache.
/// It also stays below 65,536 elements, from which on candle uses a thread pool of its own
/// for elementwise operations; parallel chunks would contend for that pool's lock.
pub const CHUNK: usize = 256;

/// Largest r of [`Trunk::set_upscale`]: 64 children per parent.
pub const UPSCALE_MAX: usize = 8;

/// Parents per chunk if a GPU gathers: every chunk uploads the feature maps again, and the
/// device takes one chunk at a time. 16384·E floats are 8 MiB at E = 128.
const CHUNK_GPU: usize = 1 << 14;

/// Chunk size and random seed of a training pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrainPass {
    /// Parents per chunk.
    pub chunk: usize,
    /// Seed of the attention weights that are dropped.
    pub seed: u64,
}

#[derive(Clone, Debug)]
struct Parts {
    embeddings: Embeddings,
    aggregation: Option<Aggregation>,
    heads: Heads,
}

/// The trunk's parameters.
#[derive(Clone, Debug)]
pub struct Trunk {
    config: Config,
    /// Constants of SPGR for the configured r, or for that of [`Trunk::set_upscale`].
    rules: Rules,
    /// `None` if SPGR is off.
    parts: Option<Parts>,
    backend: Backend,
    /// The GPU of `backend`, if it is one.
    executor: Option<Arc<Executor>>,
}

/// Division of the parents into chunks, and the mode of their layers.
struct Chunking<'a> {
    /// Parents per chunk.
    size: usize,
    mode: Mode,
    /// Runs after each chunk.
    checkpoint: Checkpoint<'a>,
}

/// Output buffers of one chunk.
struct Job<'a> {
    span: Span,
    rows: &'a mut [f32],
    gains: &'a mut [f32],
}

impl Trunk {
    /// Builds the trunk. `channels`: the backbone's feature levels with their channels.
    ///
    /// # Errors
    /// The configuration is invalid, the backbone lacks a level, or a tensor is missing or
    /// has another shape.
    pub fn new(
        config: &Config,
        channels: &[(FeatureLevel, usize)],
        vb: VarBuilder,
    ) -> Result<Self> {
        config.check().map_err(candle_core::Error::wrap)?;
        let vb = vb.pp("subsplat");
        let sh = 3 * sh_coefficients(config.primaries().sh_degree);
        let parts = if config.spgr.enabled {
            let dim = config.embed.dim;
            Some(Parts {
                embeddings: Embeddings::new(&config.embed, sh, vb.pp("embed"))?,
                aggregation: if config.agg.enabled {
                    Some(Aggregation::new(&config.agg, dim, channels, vb.pp("agg"))?)
                } else {
                    None
                },
                heads: Heads::new(config, vb)?,
            })
        } else {
            None
        };
        let rules = rules(config, config.children());
        Ok(Self { config: config.clone(), rules, parts, backend: Backend::Cpu, executor: None })
    }

    /// Sets the backend of the following calls: of all operations, in training only where
    /// [`Trunk::trains_on_device`], else of gathers and SPGR.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
        self.executor = Executor::new(backend);
        if let Some(agg) = self.parts.as_mut().and_then(|p| p.aggregation.as_mut()) {
            agg.set_backend(backend);
        }
    }

    /// Returns true if the children are the primaries ([`Children::whole`]): SPGR is off, or
    /// r = 1 with heads whose only child is its parent.
    pub fn is_off(&self) -> bool {
        self.parts().is_none()
    }

    /// Returns whether the trunk reads the backbone's feature maps.
    pub fn reads_features(&self) -> bool {
        self.parts().is_some_and(|parts| parts.aggregation.is_some())
    }

    /// Returns whether the trunk reads the backbone's feature map of `level`.
    pub(super) fn reads(&self, level: FeatureLevel) -> bool {
        // Mixed numbers of children need the parts even where r is 1.
        let aggregation = self.parts.as_ref().and_then(|parts| parts.aggregation.as_ref());
        aggregation.is_some_and(|aggregation| aggregation.levels().contains(&level))
    }

    /// The parts, unless [`Trunk::is_off`].
    fn parts(&self) -> Option<&Parts> {
        let one = self.rules.children() == 1 && self.config.spgr.head == SpgrHead::Polynomial;
        self.parts.as_ref().filter(|_| !one)
    }

    /// Sets r of the following calls. Heads that serve any K ([`SpgrHead::serves_any_k`]) accept
    /// r up to [`UPSCALE_MAX`], the others only the configured one.
    ///
    /// # Errors
    /// `side` differs from the configured r and the head has a fixed K; `side` is not in
    /// 1 to 8.
    pub fn set_upscale(&mut self, side: usize) -> Result<()> {
        self.check_served("upscale", side, self.config.upscale, UPSCALE_MAX)?;
        self.rules = rules(&self.config, side * side);
        Ok(())
    }

    /// Sets K of the following calls, which need not be a square ([`Positions`](subsplat_kernels::layout::Positions)).
    ///
    /// # Errors
    /// K differs from the configured one and the head has a fixed K; K is not in 1 to 64.
    pub fn set_children(&mut self, children: usize) -> Result<()> {
        let own = self.config.children();
        self.check_served("children per parent", children, own, CHILDREN_MAX)?;
        self.rules = rules(&self.config, children);
        Ok(())
    }

    /// Refuses a number that the heads do not serve: above `most`, or, if they are for one K, another than
    /// the `configured` one.
    fn check_served(&self, what: &str, got: usize, configured: usize, most: usize) -> Result<()> {
        let head = self.config.spgr.head;
        let served = if self.parts.is_some() && !head.serves_any_k() {
            configured..=configured
        } else {
            1..=most
        };
        if served.contains(&got) {
            return Ok(());
        }
        let (least, most) = served.into_inner();
        let expected = if least == most { least.to_string() } else { format!("{least} to {most}") };
        bail!("{what}: expected {expected} (head {head:?}), got {got}")
    }

    /// Computes the children of the one scene in `views`, without gradient. Chunks run in
    /// parallel, or on a GPU one after the other.
    ///
    /// # Errors
    /// Inputs do not fit one another or the configuration; a result is not finite.
    pub fn forward(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Children> {
        self.forward_with(views, backbone, primaries, &|| Ok(()))
    }

    /// [`Trunk::forward`] with `checkpoint` after each of [`Trunk::steps`], on any thread.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`] and of `checkpoint`.
    pub fn forward_with(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        checkpoint: Checkpoint<'_>,
    ) -> Result<Children> {
        let Some(parts) = self.parts() else { return self.parents(views, primaries) };
        let how = Chunking { size: self.chunk_size(), mode: Mode::Infer, checkpoint };
        let sh = || -> Result<_> { Ok((interleaved(&primaries.sh)?, primaries.sh_basis)) };
        if let Some(result) = self.on_device(|executor| {
            let like = |t: &Tensor| executor.upload(t);
            let scene = self.scene_on(parts, views, backbone, primaries, like)?;
            checkpoint()?;
            self.children(parts, &scene, sh()?, &how)
        }) {
            return result;
        }
        let scene = self.scene(parts, views, backbone, primaries)?;
        checkpoint()?;
        self.children(parts, &scene, sh()?, &how)
    }

    /// Returns the GPU of the trunk's backend, if it is one.
    pub fn executor(&self) -> Option<&Arc<Executor>> {
        self.executor.as_ref()
    }

    /// Runs `f` on the GPU; `None` where there is none or it failed, and the CPU takes over.
    pub(super) fn on_device<R>(
        &self,
        f: impl FnOnce(&Arc<Executor>) -> Result<R>,
    ) -> Option<Result<R>> {
        let executor = self.executor.as_ref()?;
        executor.attempt(&self.backend, || f(executor))
    }

    /// Returns the number of steps of [`Trunk::forward_with`].
    pub fn steps(&self, primaries: &Primaries) -> usize {
        self.steps_of(primaries.opacities.elem_count(), primaries.per_view)
    }

    /// [`Trunk::steps`] of `parents` parents, `per_view` of each view.
    pub(super) fn steps_of(&self, parents: usize, per_view: usize) -> usize {
        match self.parts() {
            Some(_) => 1 + chunks(parents, per_view, self.chunk_size()).count(),
            None => 0,
        }
    }

    /// Parents per chunk at inference.
    fn chunk_size(&self) -> usize {
        if self.backend.is_cpu() { CHUNK } else { CHUNK_GPU }
    }

    /// Children with coefficients `sh`, outside any graph.
    fn children<A: Array + Sync>(
        &self,
        parts: &Parts,
        scene: &Scene<'_, A>,
        (sh, sh_basis): (Tensor, ShBasis),
        how: &Chunking<'_>,
    ) -> Result<Children> {
        let (k, lanes) = (scene.rules.children(), scene.rules.gain_channels());
        let [n, _] = scene.means.sizes()?;
        if sh.dtype() != DType::F32 {
            bail!("primaries: expected f32, got {:?}", sh.dtype());
        }
        let mut rows = vec![0f32; n * k * SPLAT_STRIDE];
        let mut gains = vec![0f32; n * k * lanes];
        let mut jobs = Vec::new();
        let (mut rows_left, mut gains_left) = (&mut rows[..], &mut gains[..]);
        for span in chunks(n, scene.per_view, how.size) {
            let (rows, rest) = rows_left.split_at_mut(span.len * k * SPLAT_STRIDE);
            rows_left = rest;
            let (gains, rest) = gains_left.split_at_mut(span.len * k * lanes);
            gains_left = rest;
            jobs.push(Job { span, rows, gains });
        }
        let run = |Job { span, rows, gains }: Job| {
            let Records { head, parents } = self.records(parts, scene, span, how.mode)?;
            head.write_children(&parents, &scene.call(span), &self.backend, rows, gains)?;
            (how.checkpoint)()
        };
        if self.backend.is_cpu() {
            jobs.into_par_iter().try_for_each(run)?
        } else {
            jobs.into_iter().try_for_each(run)?
        }
        let device = sh.device();
        let gain = Tensor::from_vec(gains, n * k * lanes, device)?;
        Ok(Children {
            rows: Tensor::from_vec(rows, (n * k, SPLAT_STRIDE), device)?,
            gain: if lanes == 1 { gain } else { gain.reshape((n * k, lanes))? },
            sh,
            sh_basis,
            k,
        })
    }

    /// Renders the one scene in `views` from `camera`: `[5, H, W]` (R, G, B, alpha,
    /// Σ w·z). On the CPU no children exist in memory, because head records become
    /// footprints chunk by chunk; a GPU makes the children and rasterizes them. The SH basis
    /// is that of `primaries`, not that of `options`.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`] and of the rasterizer.
    pub fn render(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Tensor> {
        let options = &RasterOptions { sh_basis: primaries.sh_basis, ..*options };
        let parts = match self.parts() {
            Some(parts) if self.backend.is_cpu() => parts,
            _ => {
                let all = self.forward(views, backbone, primaries)?;
                let (rows, sh, gain) = (&all.rows, &all.sh, &all.gain);
                return rasterize_on(&self.backend, rows, sh, gain, camera, options);
            }
        };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let k = scene.rules.children();
        let n = scene.means.dim(0)?;
        let sh = primaries.sh.squeeze(0)?;
        let fill = |mut left: &mut [Footprint]| {
            let mut jobs = Vec::new();
            for span in chunks(n, scene.per_view, CHUNK) {
                let (own, rest) = left.split_at_mut(span.len * k);
                left = rest;
                jobs.push((span, own));
            }
            jobs.into_par_iter().try_for_each(|(span, own)| {
                let Records { head, parents } = self.records(parts, &scene, span, Mode::Infer)?;
                let sh = sh.narrow(0, span.first, span.len)?.transpose(1, 2)?;
                spgr_footprints((&head, &parents, &sh), &scene.call(span), camera, options, own)
            })
        };
        rasterize_footprints(n * k, camera, options, fill)
    }

    /// Computes [`Trunk::forward`] for every scene of a batch.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`].
    pub fn forward_scenes(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Vec<Children>> {
        let scene = |b: usize| {
            self.forward(&views.scene(b)?, &backbone.scene(b)?, &primaries_of(primaries, b)?)
        };
        (0..views.scenes()).map(scene).collect()
    }

    /// Computes the children of the one scene in `views`, differentiable in every parameter
    /// and in the backbone's outputs.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`].
    pub fn forward_train(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        TrainPass { chunk, seed }: TrainPass,
    ) -> Result<Children> {
        let Some(parts) = self.parts() else { return self.parents(views, primaries) };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let (mut rows, mut gains) = (Vec::new(), Vec::new());
        for span in chunks(scene.means.dim(0)?, scene.per_view, chunk.max(1)) {
            let Records { head, parents } =
                self.records(parts, &scene, span, Mode::Train { seed })?;
            let (own_rows, own_gains) = spgr_on(&self.backend, &head, &parents, &scene.call(span))?;
            rows.push(own_rows);
            gains.push(own_gains);
        }
        Ok(Children {
            rows: Tensor::cat(&rows, 0)?,
            gain: Tensor::cat(&gains, 0)?,
            sh: interleaved(&primaries.sh)?,
            sh_basis: primaries.sh_basis,
            k: scene.rules.children(),
        })
    }

    /// Returns the primaries of the one scene in `views` as their own children, K = 1.
    ///
    /// # Errors
    /// More than one scene; shapes that do not fit.
    pub fn parents(&self, views: &Views, primaries: &Primaries) -> Result<Children> {
        check_single(views, primaries)?;
        let opacities = primaries.opacities.unsqueeze(2)?;
        let rows = [&primaries.means, &primaries.quats_wxyz, &primaries.scales, &opacities];
        let rows = Tensor::cat(&rows, 2)?.squeeze(0)?;
        Ok(Children {
            gain: Tensor::ones(rows.dim(0)?, rows.dtype(), rows.device())?,
            rows,
            sh: interleaved(&primaries.sh)?,
            sh_basis: primaries.sh_basis,
            k: 1,
        })
    }
}

/// `[1, N, 3, D]` to `[N, D, 3]`.
fn interleaved(sh: &Tensor) -> Result<Tensor> {
    sh.squeeze(0)?.transpose(1, 2)?.contiguous()
}

fn primaries_of(p: &Primaries, b: usize) -> Result<Primaries> {
    let one = |t: &Tensor| t.narrow(0, b, 1);
    Ok(Primaries {
        means: one(&p.means)?,
        quats_wxyz: one(&p.quats_wxyz)?,
        scales: one(&p.scales)?,
        opacities: one(&p.opacities)?,
        sh: one(&p.sh)?,
        sh_camera: one(&p.sh_camera)?,
        ..p.clone()
    })
}
