//! Feature aggregation: attention of every parent over the views' feature maps
//! (SubSplat A.2; completed as in spec 1.6, every switch of it).
//!
//! Stage t, query embedding z, input f (0 before the first):
//! ```text
//! q = norm(f + z)      K, U = W_k Φ, W_v Φ on the map, once per scene
//! o = Σ_{v,ℓ,m} g_v · softmax(q·K/√E + b_ℓ) · U        (ops::attention_gather)
//! f ← f + o,   then the feed-forward block
//! ```
//! Three geometry stages give f^g from z^g; one appearance stage gives f^a from f^g
//! and z^a. Parameters `g0`, `g1`, …, `a0`, each `{norm, wk.L, wv.L, wo, level_bias,
//! weights, gate, key_points, offsets, cat, ffn}` as far as the configuration needs
//! them; `in.L` where a map must become E channels wide with no projection to do it.

mod points;
mod stage;

use super::geometry::{Frames, ParentChunk};
use super::mlp::{Mode, xavier};
use super::{BackboneOutput, Primaries, Views};
use crate::config::{Aggregation as Keys, FeatureLevel, Gate, MaskMode, Points};
use crate::ops::Backend;
use crate::ops::attention_gather::{Deferred, Level, occlusion_gate};
use crate::ops::moves::channels_last;
use candle_core::{DType, Result, Tensor, bail};
use candle_nn::{Linear, Module, VarBuilder};
pub use points::ring;
use stage::Stage;

/// The attention's parameters.
#[derive(Clone, Debug)]
pub struct Aggregation {
    keys: Keys,
    dim: usize,
    /// Map to E channels, where no stage projects it.
    input: Vec<Option<Linear>>,
    geometry: Vec<Stage>,
    appearance: Vec<Stage>,
    backend: Backend,
}

/// What is computed once per scene.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Projected maps of each geometry stage, `[cells, stride]`.
    geometry: Vec<Tensor>,
    /// Of each appearance stage.
    appearance: Vec<Tensor>,
    levels: Vec<Level>,
    /// `[V, H, W]`, where occlusion counts.
    depths: Option<Tensor>,
    /// Where each stage's gradient of its maps goes; none for candle's graph.
    deferred: Vec<Deferred>,
}

impl Prepared {
    /// The same maps outside any graph, their gradients deferred: stage by stage, geometry
    /// first, in the order of [`Prepared::maps`].
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

    /// Projected maps of every stage, `[cells, stride]`.
    pub fn maps(&self) -> impl Iterator<Item = &Tensor> {
        self.geometry.iter().chain(&self.appearance)
    }

    /// Gradients that wait, stage by stage; none but of [`Prepared::deferring`].
    pub fn deferred(&self) -> &[Deferred] {
        &self.deferred
    }
}

/// What all stages of one chunk share.
struct Shared<'a> {
    parents: &'a ParentChunk,
    frames: &'a Frames,
    /// `[n, V, 1, 2]`.
    centres: Tensor,
    /// `[n, V]`, where occlusion counts.
    occlusion: Option<Tensor>,
    levels: &'a [Level],
    mode: Mode,
    backend: &'a Backend,
    deferred: &'a [Deferred],
}

impl Aggregation {
    /// `keys` as configured (spelled out here), `dim` = E, `channels` of the
    /// backbone's levels.
    ///
    /// # Errors
    /// A level that the backbone does not have; tensors that do not fit.
    pub fn new(
        keys: &Keys,
        dim: usize,
        channels: &[(FeatureLevel, usize)],
        vb: VarBuilder,
    ) -> Result<Self> {
        let keys = keys.resolved();
        let widths =
            keys.levels.iter().map(|level| match channels.iter().find(|(l, _)| l == level) {
                Some(&(_, c)) => Ok(c),
                None => bail!("agg.levels: expected levels of {channels:?}, got {level:?}"),
            });
        let widths: Vec<usize> = widths.collect::<Result<_>>()?;
        let input = widths.iter().enumerate().map(|(l, &c)| {
            if c == dim || stage::projects_values(&keys) {
                return Ok(None);
            }
            let w = vb.pp(format!("in.{l}")).get_with_hints((dim, c), "weight", xavier(c, dim))?;
            Ok(Some(Linear::new(w, None)))
        });
        let input: Vec<Option<Linear>> = input.collect::<Result<_>>()?;
        let widths: Vec<usize> =
            widths.iter().zip(&input).map(|(&c, i)| if i.is_some() { dim } else { c }).collect();
        let stage = |name: String| Stage::new(&keys, dim, &widths, vb.pp(name));
        let mut geometry: Vec<Stage> = Vec::with_capacity(keys.stages_geo);
        for t in 0..keys.stages_geo {
            let next = match geometry.first() {
                Some(shared) if keys.share_stage_weights => shared.clone(),
                _ => stage(format!("g{t}"))?,
            };
            geometry.push(next);
        }
        let appearance = (0..keys.stages_app).map(|t| stage(format!("a{t}")));
        let appearance = appearance.collect::<Result<_>>()?;
        Ok(Self { keys, dim, input, geometry, appearance, backend: Backend::Cpu })
    }

    /// Where the next calls gather.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
    }

    /// Projects the maps of the one scene in `backbone`, and its depth maps.
    ///
    /// # Errors
    /// Levels, views or sizes that do not fit; more views than the learned per-view
    /// parameters serve.
    pub fn prepare(
        &self,
        views: &Views,
        frames: &Frames,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Prepared> {
        let v = frames.0.len();
        self.check_views(v)?;
        let mut levels = Vec::new();
        let mut maps = Vec::new();
        let mut first_cell = 0;
        for (level, input) in self.keys.levels.iter().zip(&self.input) {
            let (b, got, c, height, width) = backbone.feature(*level)?.dims5()?;
            if b != 1 || got != v {
                bail!("feature map {level:?}: expected 1 scene of {v} views, got {b} of {got}");
            }
            let map = backbone.feature(*level)?.squeeze(0)?;
            let map = match map.dtype() {
                DType::F32 => channels_last(&map)?,
                _ => map.permute((0, 2, 3, 1))?.contiguous()?,
            };
            let map = map.reshape((v * height * width, c))?;
            let map = match input {
                Some(linear) => linear.forward(&map)?,
                None => map,
            };
            levels.push(Level { height, width, first_cell });
            first_cell += v * height * width;
            maps.push(map);
        }
        let mut geometry: Vec<Tensor> = Vec::new();
        for stage in &self.geometry {
            let projected = match geometry.first() {
                Some(shared) if self.keys.share_stage_weights => shared.clone(),
                _ => stage.project(&maps)?,
            };
            geometry.push(projected);
        }
        let appearance = self.appearance.iter().map(|s| s.project(&maps)).collect::<Result<_>>()?;
        let depths = match self.keys.occlusion_gate {
            true => Some(frames.depth_maps(&primaries.means.squeeze(0)?.detach(), views.size()?)?),
            false => None,
        };
        Ok(Prepared { geometry, appearance, levels, depths, deferred: Vec::new() })
    }

    fn check_views(&self, v: usize) -> Result<()> {
        let per_view = matches!(self.keys.gate, Gate::SoftmaxV | Gate::Softmax);
        let linear = self.keys.op == crate::config::AttentionOp::Linear;
        if (per_view || linear) && v > self.keys.gate_views {
            bail!(
                "agg.gate_views: expected at most {} views with gate {:?} and op {:?}, got {v}; \
                 gate `query` or `off` with op `dot` takes any number",
                self.keys.gate_views,
                self.keys.gate,
                self.keys.op
            );
        }
        Ok(())
    }

    /// f^g and f^a, `[n, E]`, of one chunk of parents with embeddings `z_g`, `z_a`.
    pub fn forward(
        &self,
        prepared: &Prepared,
        parents: &ParentChunk,
        frames: &Frames,
        (z_g, z_a): (&Tensor, &Tensor),
        mode: Mode,
    ) -> Result<(Tensor, Tensor)> {
        let detached;
        let parents = if self.keys.detach_points {
            detached = ParentChunk {
                means: parents.means.detach(),
                quats_wxyz: parents.quats_wxyz.detach(),
                scales: parents.scales.detach(),
                ..parents.clone()
            };
            &detached
        } else {
            parents
        };
        let (centres, z) = frames.project(&parents.means.unsqueeze(1)?, self.keys.mask)?;
        let occlusion = match &prepared.depths {
            Some(depths) => {
                let at = match self.keys.mask {
                    MaskMode::Renorm => centres.clone(),
                    // Clamped, a parent beside the picture would be judged by its edge.
                    MaskMode::PgClamp => {
                        frames.project(&parents.means.unsqueeze(1)?, MaskMode::Renorm)?.0
                    }
                };
                Some(occlusion_gate(&at.squeeze(2)?, &z.squeeze(2)?, depths)?)
            }
            None => None,
        };
        let (levels, backend) = (&prepared.levels, &self.backend);
        let deferred = &prepared.deferred;
        let shared =
            Shared { parents, frames, centres, occlusion, levels, mode, backend, deferred };
        let mut f_g = z_g.zeros_like()?;
        for (t, (stage, maps)) in self.geometry.iter().zip(&prepared.geometry).enumerate() {
            f_g = stage.forward(&self.keys, &shared, (t, maps), (&f_g, z_g))?;
        }
        let mut f_a = f_g.clone();
        for (t, (stage, maps)) in self.appearance.iter().zip(&prepared.appearance).enumerate() {
            let t = self.geometry.len() + t;
            f_a = stage.forward(&self.keys, &shared, (t, maps), (&f_a, z_a))?;
        }
        Ok((f_g, f_a))
    }

    /// E.
    pub fn dim(&self) -> usize {
        self.dim
    }
}

/// Points per view and level.
fn points_per_sample(keys: &Keys) -> usize {
    match keys.points {
        Points::Ref => 1,
        Points::Pixelgaussian => keys.n_fixed + keys.n_learned,
        Points::MapOffsets => 1 + keys.n_learned,
    }
}
