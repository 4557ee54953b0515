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
//! [`crate::config::AggregationAblations`]; [`Aggregation::new`] chooses between them.
//! Differs from the paper, which leaves them open: factor 1/√E, projections of keys and
//! values, residual, LayerNorm and occlusion gate (`tuned`).
//!
//! The occlusion gate weighs views after the softmax and is constant to gradients.

mod ablated;
mod points;
mod preset;

use super::embed::Descriptors;
use super::geometry::{Frames, ParentChunk};
use super::mlp::Mode;
use super::{BackboneOutput, Primaries, Views};
use crate::config::{Aggregation as Keys, AggregationAblations, FeatureLevel, HeadInput, MaskMode};
use crate::ops::Backend;
use crate::ops::attention_gather::{Deferred, Level, occlusion_gate};
use crate::ops::moves::{channels_last, sum};
use ablated::Ablated;
use candle_core::{DType, Result, Tensor, bail};
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
struct StageInput<'a> {
    /// Index over all stages, geometry first.
    index: usize,
    /// Projected maps, `[cells, stride]`.
    maps: &'a Tensor,
    /// Receiver of the maps' gradient; `None` leaves it to candle's graph.
    deferred: Option<&'a Deferred>,
    /// `[n, E]`: output of the stage before.
    f: &'a Tensor,
    /// `[n, E]`: embedding.
    z: &'a Tensor,
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
    fn run(
        &self,
        prepared: &Prepared,
        z: &Descriptors,
        step: impl Fn(&S, StageInput) -> Result<Tensor>,
    ) -> Result<Descriptors> {
        let deferred = |index: usize| prepared.deferred.get(index);
        let mut geometry = z.geometry.zeros_like()?;
        for (index, (stage, maps)) in self.geometry.iter().zip(&prepared.geometry).enumerate() {
            let (f, z, deferred) = (&geometry, &z.geometry, deferred(index));
            geometry = step(stage, StageInput { index, maps, deferred, f, z })?;
        }
        let mut appearance = geometry.clone();
        for (t, (stage, maps)) in self.appearance.iter().zip(&prepared.appearance).enumerate() {
            let index = self.geometry.len() + t;
            let (f, z, deferred) = (&appearance, &z.appearance, deferred(index));
            appearance = step(stage, StageInput { index, maps, deferred, f, z })?;
        }
        Ok(Descriptors { geometry, appearance })
    }
}

/// Projected feature maps and depth maps of one scene, computed once per scene.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Projected maps of each geometry stage, `[cells, stride]`.
    geometry: Vec<Tensor>,
    /// Projected maps of each appearance stage, `[cells, stride]`.
    appearance: Vec<Tensor>,
    levels: Vec<Level>,
    /// `[V, H, W]`: camera z, if the occlusion gate is on.
    depths: Option<Tensor>,
    /// Receivers of the maps' gradients, one a stage; empty: candle's graph has them.
    deferred: Vec<Deferred>,
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

    /// Returns the projected maps `[cells, stride]` of every stage, geometry first.
    pub fn maps(&self) -> impl Iterator<Item = &Tensor> {
        self.geometry.iter().chain(&self.appearance)
    }

    /// Returns the deferred gradients of every stage; empty unless made by
    /// [`Prepared::deferring`].
    pub fn deferred(&self) -> &[Deferred] {
        &self.deferred
    }
}

/// Values that all stages share for one chunk of parents.
struct Call<'a> {
    parents: &'a ParentChunk,
    frames: &'a Frames,
    /// `[n, V, 1, 2]`: projected centres, in units of each image's size.
    centres: Tensor,
    /// `[n, V]` in [0, 1], if the occlusion gate is on.
    visibility: Option<Tensor>,
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

    /// Sets the backend of the following gathers.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
    }

    /// Projects the feature maps of the one scene in `backbone`, and makes its depth maps
    /// if the occlusion gate is on.
    ///
    /// # Errors
    /// Levels, views or sizes do not fit; the scene has more views than the learned
    /// per-view parameters serve.
    pub fn prepare(
        &self,
        views: &Views,
        frames: &Frames,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Prepared> {
        let v = frames.0.len();
        if let Some(limit) = self.view_limit.filter(|limit| v > *limit) {
            bail!(
                "agg.gate_views: the model has learned per-view parameters for {limit} views, \
                 got {v} views; gate `query` or `off` with op `dot` takes any number"
            );
        }
        let (levels, maps) = self.map_rows(backbone, v)?;
        let (geometry, appearance) = match &self.plan {
            Plan::Preset(stages) => {
                let project = |all: &[preset::Stage]| -> Result<Vec<Tensor>> {
                    all.iter().map(|stage| stage.project(&maps)).collect()
                };
                (project(&stages.geometry)?, project(&stages.appearance)?)
            }
            Plan::Ablated(ablated) => ablated.project(maps)?,
        };
        let depths = match self.occlusion_gate {
            true => Some(frames.depth_maps(&primaries.means.squeeze(0)?.detach(), views.size()?)?),
            false => None,
        };
        Ok(Prepared { geometry, appearance, levels, depths, deferred: Vec::new() })
    }

    /// Returns the place of each level in the joined maps, and each level's map as rows
    /// `[V·h·w, C]`.
    fn map_rows(&self, backbone: &BackboneOutput, v: usize) -> Result<(Vec<Level>, Vec<Tensor>)> {
        let mut levels = Vec::with_capacity(self.levels.len());
        let mut maps = Vec::with_capacity(self.levels.len());
        let mut first_cell = 0;
        for level in &self.levels {
            let map = backbone.feature(*level)?;
            let (b, got, c, height, width) = map.dims5()?;
            if b != 1 || got != v {
                bail!("feature map {level:?}: expected 1 scene of {v} views, got {b} of {got}");
            }
            let map = map.squeeze(0)?;
            let map = match map.dtype() {
                DType::F32 => channels_last(&map)?,
                _ => map.permute((0, 2, 3, 1))?.contiguous()?,
            };
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
    pub fn forward(
        &self,
        prepared: &Prepared,
        parents: &ParentChunk,
        frames: &Frames,
        z: &Descriptors,
        mode: Mode,
    ) -> Result<Descriptors> {
        let backend = &self.backend;
        match &self.plan {
            Plan::Preset(stages) => {
                let means = parents.means.unsqueeze(1)?;
                let (centres, depth) = frames.project(&means, MaskMode::Renorm)?;
                let visibility = visibility(prepared, &centres, &depth)?;
                let levels = &prepared.levels;
                let call = Call { parents, frames, centres, visibility, levels, mode, backend };
                stages.run(prepared, z, |stage, input| stage.forward(&call, input))
            }
            Plan::Ablated(ablated) => ablated.forward(prepared, parents, frames, z, mode, backend),
        }
    }

    /// Returns the heads' inputs, `[n, E]`: f + z, or f in one ablation.
    ///
    /// # Errors
    /// Shapes differ.
    pub fn head_inputs(&self, f: Descriptors, z: &Descriptors) -> Result<Descriptors> {
        match &self.plan {
            Plan::Ablated(ablated) if ablated.head_input() == HeadInput::F => Ok(f),
            _ => Ok(Descriptors {
                geometry: sum(&f.geometry, &z.geometry)?,
                appearance: sum(&f.appearance, &z.appearance)?,
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
fn visibility(prepared: &Prepared, centres: &Tensor, depth: &Tensor) -> Result<Option<Tensor>> {
    match &prepared.depths {
        Some(maps) => Ok(Some(occlusion_gate(&centres.squeeze(2)?, &depth.squeeze(2)?, maps)?)),
        None => Ok(None),
    }
}
