//! Feature aggregation: attention of every parent over the views' feature maps
//! (SubSplat A.2).
//!
//! Stage t, with query embedding z and input f (0 before the first stage):
//! ```text
//! q = norm(f + z)      K, U = W_k Φ, W_v Φ on the map, once per scene
//! o = Σ_{v,ℓ} g_v · softmax(q·K/√E + b_ℓ) · U        (ops::attention_gather)
//! f ← f + o
//! ```
//! Three geometry stages give f^g from z^g; one appearance stage gives f^a from f^g and
//! z^a. Parameters: `g0`, `g1`, …, `a0`, each `{norm, wk.L, wv.L, level_bias, gate}`.
//!
//! `preset` is this form, which both presets use. `ablated` is the general form behind
//! [`crate::network::config::AggregationAblations`]; [`Aggregation::new`] chooses between them.
//! Differs from the paper, which leaves them open: factor 1/√E, projections of keys and
//! values, residual, LayerNorm and occlusion gate (`tuned`).
//!
//! The occlusion gate weighs views after the softmax and is constant to gradients.

mod ablated;
mod points;
mod preset;

use super::Views;
use super::embed::Descriptors;
use super::geometry::{Frames, ParentChunk};
use super::mlp::Mode;
use crate::network::config::{
    Aggregation as Keys, AggregationAblations, FeatureLevel, HeadInput, MaskMode,
};
use crate::network::ops::TapeArray;
use crate::network::ops::attention_gather::{Deferred, Level};
use crate::network::ops::{Array, Backend};
use ablated::Ablated;
use candle_core::{Result, Tensor, bail};
use candle_nn::VarBuilder;
pub use points::ring;

/// The attention's parameters, in the form that the configuration resolves to.
#[derive(Clone, Debug)]
pub struct Aggregation {
    levels: Vec<FeatureLevel>,
    plan: Plan,
    occlusion_gate: bool,
    /// Largest number of views that learned per-view parameters serve, if there are any.
    view_limit: Option<usize>,
    backend: Backend,
}

/// The form of the attention, resolved when the model is built.
#[derive(Clone, Debug)]
enum Plan {
    /// The form of both presets.
    Preset(Stages<preset::Stage>),
    /// The general form.
    Ablated(Box<Ablated>),
}

/// Attention stages of both branches.
#[derive(Clone, Debug)]
struct Stages<S> {
    geometry: Vec<S>,
    appearance: Vec<S>,
}

/// Input of one attention stage.
#[derive(Clone, Copy)]
struct StageInput<'a, A = Tensor> {
    /// Index over all stages, geometry first.
    index: usize,
    /// Projected maps, `[cells, stride]`.
    maps: &'a A,
    /// Receiver of the maps' gradient; `None` leaves it to candle's graph.
    deferred: Option<&'a Deferred>,
    /// `[n, E]`: output of the stage before.
    f: &'a A,
    /// `[n, E]`: embedding.
    z: &'a A,
}

impl<S> Stages<S> {
    /// Builds the stages that `keys` asks for; `stage` builds the one of a name.
    fn new(keys: &Keys, stage: impl Fn(String) -> Result<S>) -> Result<Self> {
        Ok(Self {
            geometry: (0..keys.stages_geo)
                .map(|t| stage(format!("g{t}")))
                .collect::<Result<_>>()?,
            appearance: (0..keys.stages_app)
                .map(|t| stage(format!("a{t}")))
                .collect::<Result<_>>()?,
        })
    }

    /// Runs all stages: f^g and f^a, `[n, E]`.
    fn run<A: Array>(
        &self,
        prepared: &Prepared<A>,
        z: &Descriptors<A>,
        step: impl Fn(&S, StageInput<'_, A>) -> Result<A>,
    ) -> Result<Descriptors<A>> {
        let deferred = |index: usize| prepared.deferred.get(index);
        let mut geometry = z.geometry.detach().affine(0.0, 0.0)?;
        for (index, (stage, maps)) in self.geometry.iter().zip(&prepared.geometry).enumerate() {
            let f = &geometry;
            let z = &z.geometry;
            let deferred = deferred(index);
            geometry = step(stage, StageInput { index, maps, deferred, f, z })?;
        }
        let mut appearance = geometry.clone();
        for (t, (stage, maps)) in self.appearance.iter().zip(&prepared.appearance).enumerate() {
            let index = self.geometry.len() + t;
            let f = &appearance;
            let z = &z.appearance;
            let deferred = deferred(index);
            appearance = step(stage, StageInput { index, maps, deferred, f, z })?;
        }
        Ok(Descriptors { geometry, appearance })
    }
}

/// Projected feature maps and depth maps of one scene, computed once per scene.
#[derive(Clone, Debug)]
pub struct Prepared<A = Tensor> {
    /// Projected maps of each geometry stage, `[cells, stride]`.
    geometry: Vec<A>,
    /// Projected maps of each appearance stage, `[cells, stride]`.
    appearance: Vec<A>,
    levels: Vec<Level>,
    /// `[V, H, W]`: camera z, if the occlusion gate is on.
    depths: Option<A>,
    /// Receivers of the maps' gradients, one a stage; empty: candle's graph has them.
    deferred: Vec<Deferred>,
}

impl<A: Array> Prepared<A> {
    /// Returns the projected maps `[cells, stride]` of every stage, geometry first.
    pub fn maps(&self) -> impl Iterator<Item = &A> {
        self.geometry.iter().chain(&self.appearance)
    }

    /// Returns the same maps in host memory, in their graph.
    fn to_host(&self) -> Result<Prepared> {
        let all = |maps: &[A]| maps.iter().map(A::to_host).collect::<Result<Vec<_>>>();
        Ok(Prepared {
            geometry: all(&self.geometry)?,
            appearance: all(&self.appearance)?,
            levels: self.levels.clone(),
            depths: self.depths.as_ref().map(A::to_host).transpose()?,
            deferred: self.deferred.clone(),
        })
    }
}

impl Prepared<TapeArray> {
    /// Returns the same maps as leaves of tapes.
    pub fn leaves(&self) -> Self {
        let leaves = |maps: &[TapeArray]| maps.iter().map(TapeArray::leaf).collect();
        let (geometry, appearance) = (leaves(&self.geometry), leaves(&self.appearance));
        Self { geometry, appearance, ..self.clone() }
    }
}

impl Prepared {
    /// Returns the same maps outside any graph. Their gradients go to
    /// [`Prepared::deferred`], in the order of [`Prepared::maps`].
    pub fn deferring(&self) -> Self {
        let detached = |maps: &[Tensor]| maps.iter().map(Tensor::detach).collect();
        Self {
            geometry: detached(&self.geometry),
            appearance: detached(&self.appearance),
            levels: self.levels.clone(),
            depths: self.depths.clone(),
            deferred: self.maps().map(|_| Deferred::default()).collect(),
        }
    }

    /// Returns the deferred gradients of every stage; empty unless made by
    /// [`Prepared::deferring`].
    pub fn deferred(&self) -> &[Deferred] {
        &self.deferred
    }
}

/// Values that all stages share for one chunk of parents.
struct Call<'a, A = Tensor> {
    parents: &'a ParentChunk<A>,
    frames: &'a Frames,
    /// `[n, V, 1, 2]`: projected centres, in units of each image's size.
    centres: A,
    /// `[n, V]` in [0, 1], if the occlusion gate is on.
    visibility: Option<A>,
    levels: &'a [Level],
    mode: Mode,
    backend: &'a Backend,
}

impl Aggregation {
    /// Builds the form that `keys` resolves to. `dim`: E; `channels`: the backbone's
    /// levels with their channels.
    ///
    /// # Errors
    /// The backbone lacks a level; a tensor is missing or has another shape.
    pub fn new(
        keys: &Keys,
        dim: usize,
        channels: &[(FeatureLevel, usize)],
        vb: VarBuilder,
    ) -> Result<Self> {
        let keys = keys.resolved();
        let widths = widths(&keys.levels, channels)?;
        let preset = keys.ablations == AggregationAblations::default();
        let (plan, view_limit) = if preset {
            let stage = |name| preset::Stage::new(&keys, dim, &widths, vb.pp(name));
            (Plan::Preset(Stages::new(&keys, stage)?), Some(keys.gate_views))
        } else {
            let ablated = Ablated::new(&keys, dim, &widths, &vb)?;
            let view_limit = ablated.has_per_view_parameters().then_some(keys.gate_views);
            (Plan::Ablated(Box::new(ablated)), view_limit)
        };
        Ok(Self {
            levels: keys.levels,
            plan,
            occlusion_gate: keys.occlusion_gate,
            view_limit,
            backend: Backend::Cpu,
        })
    }

    /// Returns the feature maps that the aggregation reads.
    pub fn levels(&self) -> &[FeatureLevel] {
        &self.levels
    }

    /// Returns whether a GPU computes the gradients too: the form of the presets.
    pub(super) fn trains_on_device(&self) -> bool {
        matches!(self.plan, Plan::Preset(_))
    }

    /// Sets the backend of the following gathers.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
    }

    /// Projects the feature maps `[1, V, C, h, w]` of one scene, and makes its depth maps from
    /// the parents' `means` `[N, 3]` if the occlusion gate is on.
    ///
    /// # Errors
    /// Levels, views or sizes do not fit; the scene has more views than the learned
    /// per-view parameters serve.
    pub fn prepare<A: Array>(
        &self,
        views: &Views,
        frames: &Frames,
        feature: impl Fn(FeatureLevel) -> Result<A>,
        means: &A,
    ) -> Result<Prepared<A>> {
        let v = frames.0.len();
        if let Some(limit) = self.view_limit.filter(|limit| v > *limit) {
            bail!(
                "agg.gate_views: the model has learned per-view parameters for {limit} views, \
                 got {v} views; gate `query` or `off` with op `dot` takes any number"
            );
        }
        let (levels, maps) = self.map_rows(feature, v)?;
        let (geometry, appearance) = match &self.plan {
            Plan::Preset(stages) => {
                let project = |all: &[preset::Stage]| -> Result<Vec<A>> {
                    all.iter().map(|stage| stage.project(&maps)).collect()
                };
                (project(&stages.geometry)?, project(&stages.appearance)?)
            }
            Plan::Ablated(ablated) => {
                let maps = maps.iter().map(A::to_host).collect::<Result<_>>()?;
                let (geometry, appearance) = ablated.project(maps)?;
                let back = |all: Vec<Tensor>| -> Result<Vec<A>> {
                    all.iter().map(|map| means.upload(map)).collect()
                };
                (back(geometry)?, back(appearance)?)
            }
        };
        let depths = if self.occlusion_gate {
            Some(frames.depth_maps(&means.detach(), views.size()?)?)
        } else {
            None
        };
        Ok(Prepared { geometry, appearance, levels, depths, deferred: Vec::new() })
    }

    /// Returns the place of each level in the joined maps, and each level's map as rows
    /// `[V·h·w, C]`.
    fn map_rows<A: Array>(
        &self,
        feature: impl Fn(FeatureLevel) -> Result<A>,
        v: usize,
    ) -> Result<(Vec<Level>, Vec<A>)> {
        let mut levels = Vec::with_capacity(self.levels.len());
        let mut maps = Vec::with_capacity(self.levels.len());
        let mut first_cell = 0;
        for level in &self.levels {
            let map = feature(*level)?;
            let [b, got, c, height, width] = map.sizes()?;
            if b != 1 || got != v {
                bail!("feature map {level:?}: expected 1 scene of {v} views, got {b} of {got}");
            }
            let map = map.reshape((v, c, height, width))?.channels_last()?;
            maps.push(map.reshape((v * height * width, c))?);
            levels.push(Level { height, width, first_cell });
            first_cell += v * height * width;
        }
        Ok((levels, maps))
    }

    /// Returns f^g and f^a, `[n, E]`, of one chunk of parents with embeddings `z`.
    ///
    /// # Errors
    /// Shapes do not fit.
    pub fn forward<A: Array>(
        &self,
        prepared: &Prepared<A>,
        parents: &ParentChunk<A>,
        frames: &Frames,
        z: &Descriptors<A>,
        mode: Mode,
    ) -> Result<Descriptors<A>> {
        let backend = &self.backend;
        match &self.plan {
            Plan::Preset(stages) => {
                let means = parents.means.reshape(((), 1, 3))?;
                let (centres, depth) = frames.project(&means, MaskMode::Renorm)?;
                let visibility = visibility(prepared, &centres, &depth)?;
                let levels = &prepared.levels;
                let call = Call { parents, frames, centres, visibility, levels, mode, backend };
                stages.run(prepared, z, |stage, input| stage.forward(&call, input))
            }
            Plan::Ablated(ablated) => {
                // The general form has host tensors alone.
                let own = ParentChunk {
                    first: parents.first,
                    source: parents.source,
                    means: parents.means.to_host()?,
                    quats_wxyz: parents.quats_wxyz.to_host()?,
                    scales: parents.scales.to_host()?,
                    opacities: parents.opacities.to_host()?,
                    sh: parents.sh.to_host()?,
                };
                let host = Descriptors {
                    geometry: z.geometry.to_host()?,
                    appearance: z.appearance.to_host()?,
                };
                let prepared = prepared.to_host()?;
                let f = ablated.forward(&prepared, &own, frames, &host, mode, backend)?;
                Ok(Descriptors {
                    geometry: z.geometry.upload(&f.geometry)?,
                    appearance: z.geometry.upload(&f.appearance)?,
                })
            }
        }
    }

    /// Returns the heads' inputs, `[n, E]`: f + z, or f in one ablation.
    ///
    /// # Errors
    /// Shapes differ.
    pub fn head_inputs<A: Array>(
        &self,
        f: Descriptors<A>,
        z: &Descriptors<A>,
    ) -> Result<Descriptors<A>> {
        match &self.plan {
            Plan::Ablated(ablated) if ablated.head_input() == HeadInput::F => Ok(f),
            _ => Ok(Descriptors {
                geometry: f.geometry.add(&z.geometry)?,
                appearance: f.appearance.add(&z.appearance)?,
            }),
        }
    }
}

/// Channels of each of `levels`.
fn widths(levels: &[FeatureLevel], channels: &[(FeatureLevel, usize)]) -> Result<Vec<usize>> {
    let width = |level: &FeatureLevel| match channels.iter().find(|(l, _)| l == level) {
        Some(&(_, c)) => Ok(c),
        None => bail!("agg.levels: expected levels of {channels:?}, got {level:?}"),
    };
    levels.iter().map(width).collect()
}

/// Visibility `[n, V]` of parents at `centres` `[n, V, 1, 2]` with camera z `depth`
/// `[n, V, 1]`, if the occlusion gate is on.
fn visibility<A: Array>(prepared: &Prepared<A>, centres: &A, depth: &A) -> Result<Option<A>> {
    let Some(maps) = &prepared.depths else { return Ok(None) };
    let [n, v, _] = depth.sizes()?;
    let centres = centres.reshape((n, v, 2))?;
    let depth = depth.reshape((n, v))?;
    centres.occlusion_gate(&depth, maps).map(Some)
}
