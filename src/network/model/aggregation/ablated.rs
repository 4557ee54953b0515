//! The general form of the attention, behind
//! [`crate::network::config::AggregationAblations`]: every key of it, one stage at a time.
//!
//! Parameters beyond the presets': `wo` where groups of channels share one output
//! projection, `weights` of op `linear`, `key_points` and `offsets` of learned points,
//! `cat`, `ffn`; `in.L` where no stage projects a map to E channels.

use super::points::{learned, sample_points};
use super::preset::{joined, per_level, view_shares, visible};
use super::{Call, Prepared, StageInput, Stages, visibility};
use crate::network::config::{
    Aggregation as Keys, AggregationAblations, AttentionOp, Gate, HeadInput, LogitScale, MaskMode,
    Points, Residual, StageNorm,
};
use crate::network::model::embed::Descriptors;
use crate::network::model::geometry::{Frames, ParentChunk};
use crate::network::model::layers::{LayerNorm, xavier};
use crate::network::model::mlp::{Mode, affine, linear};
use crate::network::ops::Backend;
use crate::network::ops::add::add;
use crate::network::ops::attention_gather::{Drop, Gather, attention_gather_deferred};
use crate::network::ops::cat::{cat_columns, cat_rows};
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, Module, VarBuilder};

/// Hidden width of the feed-forward block over E (GaussianFormer: 512 for 128).
const FFN_EXPANSION: usize = 4;

/// All stages of an ablated attention.
#[derive(Clone, Debug)]
pub(super) struct Ablated {
    keys: AggregationAblations,
    /// Map to E channels, for each level that no stage projects.
    input: Vec<Option<Linear>>,
    stages: Stages<Stage>,
}

impl Ablated {
    /// `keys` in force; `dim`: E; `widths`: channels of each level's map.
    pub(super) fn new(keys: &Keys, dim: usize, widths: &[usize], vb: &VarBuilder) -> Result<Self> {
        let input = widths.iter().enumerate().map(|(l, &c)| {
            if c == dim || projects_values(&keys.ablations) {
                return Ok(None);
            }
            let w = vb.pp(format!("in.{l}")).get_with_hints((dim, c), "weight", xavier(c, dim))?;
            Ok(Some(Linear::new(w, None)))
        });
        let input: Vec<Option<Linear>> = input.collect::<Result<_>>()?;
        let widths: Vec<usize> =
            widths.iter().zip(&input).map(|(&c, i)| if i.is_some() { dim } else { c }).collect();
        let stage = |name| Stage::new(keys, dim, &widths, vb.pp(name));
        let stages = if keys.ablations.share_stage_weights && keys.stages_geo > 0 {
            let one = Stages::new(&Keys { stages_geo: 1, ..keys.clone() }, stage)?;
            let geometry = one.geometry.iter().cycle().take(keys.stages_geo).cloned().collect();
            Stages { geometry, ..one }
        } else {
            Stages::new(keys, stage)?
        };
        Ok(Self { keys: keys.ablations.clone(), input, stages })
    }

    /// True if a parameter exists for each view, which limits the number of views.
    pub(super) fn has_per_view_parameters(&self) -> bool {
        matches!(self.keys.gate, Gate::SoftmaxV | Gate::Softmax)
            || self.keys.op == AttentionOp::Linear
    }

    pub(super) fn head_input(&self) -> HeadInput {
        self.keys.head_input
    }

    /// Projects `maps`, `[cells of the level, C]` each, for every geometry and every
    /// appearance stage.
    pub(super) fn project(&self, maps: Vec<Tensor>) -> Result<(Vec<Tensor>, Vec<Tensor>)> {
        let widened = maps.into_iter().zip(&self.input).map(|(map, input)| match input {
            Some(linear) => linear.forward(&map),
            None => Ok(map),
        });
        let maps = widened.collect::<Result<Vec<_>>>()?;
        let mut geometry: Vec<Tensor> = Vec::with_capacity(self.stages.geometry.len());
        for stage in &self.stages.geometry {
            geometry.push(match geometry.first() {
                Some(shared) if self.keys.share_stage_weights => shared.clone(),
                _ => stage.project(&maps)?,
            });
        }
        let appearance = self.stages.appearance.iter().map(|stage| stage.project(&maps));
        Ok((geometry, appearance.collect::<Result<_>>()?))
    }

    /// Returns f^g and f^a, `[n, E]`.
    pub(super) fn forward(
        &self,
        prepared: &Prepared,
        parents: &ParentChunk,
        frames: &Frames,
        z: &Descriptors,
        mode: Mode,
        backend: &Backend,
    ) -> Result<Descriptors> {
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
        let means = parents.means.unsqueeze(1)?;
        let (centres, depth) = frames.project(&means, self.keys.mask)?;
        let visibility = match self.keys.mask {
            MaskMode::Renorm => visibility(prepared, &centres, &depth)?,
            // The depth map's edge says nothing about a parent outside the image, so the
            // gate takes positions that are not clamped.
            MaskMode::PgClamp if prepared.depths.is_some() => {
                let unclamped = frames.project(&means, MaskMode::Renorm)?.0;
                visibility(prepared, &unclamped, &depth)?
            }
            MaskMode::PgClamp => None,
        };
        let levels = &prepared.levels;
        let call = Call { parents, frames, centres, visibility, levels, mode, backend };
        self.stages.run(prepared, z, |stage, input| stage.forward(&self.keys, &call, input))
    }
}

/// True if each stage's W_v maps a level's channels to E before sampling. Several groups
/// use one W_o after it instead.
fn projects_values(keys: &AggregationAblations) -> bool {
    keys.kv_proj && keys.groups == 1
}

fn projects_keys(keys: &AggregationAblations) -> bool {
    keys.kv_proj && keys.op == AttentionOp::Dot
}

/// Points per view and level.
fn points_per_sample(keys: &AggregationAblations) -> usize {
    match keys.points {
        Points::Ref => 1,
        Points::Pixelgaussian => keys.n_fixed + keys.n_learned,
        Points::MapOffsets => 1 + keys.n_learned,
    }
}

#[derive(Clone, Debug)]
enum Gates {
    /// V·softmax(β); β `[gate_views]`.
    SoftmaxV(Tensor),
    /// softmax(β); β `[gate_views]`.
    Softmax(Tensor),
    Query(Linear),
    Off,
}

#[derive(Clone, Debug)]
struct FeedForward {
    norm: LayerNorm,
    lin0: Linear,
    lin1: Linear,
}

/// Parameters of one stage.
#[derive(Clone, Debug)]
struct Stage {
    norm: Option<LayerNorm>,
    /// W_k of each level.
    wk: Vec<Linear>,
    /// W_v of each level.
    wv: Vec<Linear>,
    /// W_o after sampling.
    wo: Option<Linear>,
    /// b_ℓ, `[L]`, if there is more than one level.
    level_bias: Option<Tensor>,
    /// Attention logits of op `linear`, `[gate_views, L, M, G]`.
    weights: Option<Linear>,
    gates: Gates,
    learned: Option<Linear>,
    cat: Option<Linear>,
    ffn: Option<FeedForward>,
}

impl Stage {
    fn new(keys: &Keys, dim: usize, widths: &[usize], vb: VarBuilder) -> Result<Self> {
        let gate_views = keys.gate_views;
        let pre_norm = keys.norm == StageNorm::Pre;
        let keys = &keys.ablations;
        let zero = Init::Const(0.0);
        let levels = widths.len();
        let dot = keys.op == AttentionOp::Dot;
        let samples = gate_views * levels * points_per_sample(keys);
        let joined = if keys.residual == Residual::Cat { 2 * dim } else { dim };
        let beta = || vb.get_with_hints(gate_views, "gate", zero);
        let projections = |wanted: bool, name: &str| {
            if wanted { per_level(dim, widths, vb.pp(name)) } else { Ok(Vec::new()) }
        };
        Ok(Self {
            norm: when(pre_norm, || LayerNorm::new(dim, vb.pp("norm")))?,
            wk: projections(projects_keys(keys), "wk")?,
            wv: projections(projects_values(keys), "wv")?,
            wo: when(keys.kv_proj && keys.groups > 1, || {
                linear(dim, dim, xavier(dim, dim), vb.pp("wo"))
            })?,
            level_bias: when(dot && levels > 1, || vb.get_with_hints(levels, "level_bias", zero))?,
            weights: when(!dot, || linear(dim, samples * keys.groups, zero, vb.pp("weights")))?,
            gates: match keys.gate {
                Gate::SoftmaxV => Gates::SoftmaxV(beta()?),
                Gate::Softmax => Gates::Softmax(beta()?),
                Gate::Query => Gates::Query(linear(dim, 1, zero, vb.pp("gate"))?),
                Gate::Off => Gates::Off,
            },
            learned: learned(keys, dim, levels, &vb)?,
            cat: when(keys.residual == Residual::Cat, || {
                linear(2 * dim, dim, xavier(2 * dim, dim), vb.pp("cat"))
            })?,
            ffn: when(keys.ffn, || FeedForward::new(joined, dim, vb.pp("ffn")))?,
        })
    }

    /// Returns the stage's maps `[cells, E]` or `[cells, 2E]` (keys, values) of all levels.
    fn project(&self, maps: &[Tensor]) -> Result<Tensor> {
        let mut levels = Vec::with_capacity(maps.len());
        for (l, map) in maps.iter().enumerate() {
            // Without projections one row is both key and value.
            levels.push(match (self.wk.get(l), self.wv.get(l)) {
                (Some(wk), Some(wv)) => affine(&joined(wk, wv)?, map)?,
                (Some(wk), None) => Tensor::cat(&[&affine(wk, map)?, map], 1)?,
                (None, Some(wv)) => affine(wv, map)?,
                (None, None) => map.clone(),
            });
        }
        cat_rows(&levels)
    }

    /// Returns the next f, `[n, E]`.
    fn forward(
        &self,
        keys: &AggregationAblations,
        call: &Call,
        input: StageInput,
    ) -> Result<Tensor> {
        let StageInput { index, maps, deferred, f, z } = input;
        let mut q = add(f, z)?;
        if let Some(norm) = &self.norm {
            q = norm.forward(&q)?;
        }
        let points = sample_points(keys, call, self.learned.as_ref(), f, &q)?;
        let gather = self.gather(keys, call, index, q.dim(1)?);
        let query = self.query(keys, call, &gather, &q)?;
        let mut o =
            attention_gather_deferred(call.backend, maps, &query, &points, gather, deferred)?;
        if let Some(wo) = &self.wo {
            o = affine(wo, &o)?;
        }
        let (joined, next) = match (keys.residual, &self.cat) {
            (Residual::Cat, Some(cat)) => {
                let joined = cat_columns(f, &o, None)?;
                let next = affine(cat, &joined)?;
                (joined, next)
            }
            (Residual::None, _) => (o.clone(), o),
            _ => {
                let next = add(f, &o)?;
                (next.clone(), next)
            }
        };
        match &self.ffn {
            Some(ffn) => add(&next, &ffn.forward(&joined)?),
            None => Ok(next),
        }
    }

    fn gather(&self, keys: &AggregationAblations, call: &Call, index: usize, dim: usize) -> Gather {
        let separate = !self.wk.is_empty();
        let drop = match call.mode {
            Mode::Train { seed } if keys.attn_drop > 0.0 => Some(Drop {
                probability: keys.attn_drop,
                seed: seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(index as u64),
                first_parent: call.parents.first,
            }),
            _ => None,
        };
        Gather {
            levels: call.levels.to_vec(),
            views: call.frames.0.len(),
            points: points_per_sample(keys),
            points_per_level: keys.points == Points::MapOffsets,
            dim,
            groups: keys.groups,
            stride: if separate { 2 * dim } else { dim },
            key: (keys.op == AttentionOp::Dot).then_some(0),
            value: if separate { dim } else { 0 },
            logit_scale: match keys.logit_scale {
                LogitScale::InvSqrt => ((dim / keys.groups) as f64).sqrt().recip(),
                LogitScale::One => 1.0,
            },
            renormalise: keys.mask == MaskMode::Renorm,
            sample_convention: keys.sample_convention,
            drop,
            point_gradient: !keys.detach_points || self.learned.is_some(),
        }
    }

    /// Rows of (q, bias `[V,L,M,G]`, gate `[V]`); q only where there are keys.
    fn query(
        &self,
        keys: &AggregationAblations,
        call: &Call,
        g: &Gather,
        q: &Tensor,
    ) -> Result<Tensor> {
        let n = q.dim(0)?;
        let v = g.views;
        let l = g.levels.len();
        let m = g.points;
        let width = v * l * m * keys.groups;
        let bias = match (&self.weights, &self.level_bias) {
            (Some(weights), _) => affine(weights, q)?.narrow(1, 0, width)?,
            (None, Some(bias)) => {
                let bias = bias.reshape((1, 1, l, 1, 1))?;
                bias.broadcast_as((n, v, l, m, keys.groups))?.reshape((n, width))?
            }
            (None, None) => Tensor::zeros((n, width), q.dtype(), q.device())?,
        };
        let rows = |shares: Tensor, factor: f64| {
            shares.affine(factor, 0.0)?.unsqueeze(0)?.broadcast_as((n, v))
        };
        let gates = match &self.gates {
            Gates::SoftmaxV(beta) => rows(view_shares(beta, v)?, v as f64)?,
            Gates::Softmax(beta) => rows(view_shares(beta, v)?, 1.0)?,
            Gates::Query(layer) => {
                let gate = candle_nn::ops::sigmoid(&layer.forward(q)?)?;
                gate.affine(2.0, 0.0)?.broadcast_as((n, v))?
            }
            Gates::Off => Tensor::ones((n, v), q.dtype(), q.device())?,
        };
        let gates = visible(gates, call)?;
        match g.key {
            Some(_) => cat_columns(q, &bias, Some(&gates)),
            None => cat_columns(&bias, &gates, None),
        }
    }
}

impl FeedForward {
    fn new(inputs: usize, dim: usize, vb: VarBuilder) -> Result<Self> {
        let hidden = FFN_EXPANSION * dim;
        let relu = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
        Ok(Self {
            norm: LayerNorm::new(inputs, vb.pp("norm"))?,
            lin0: linear(inputs, hidden, relu, vb.pp("lin0"))?,
            lin1: linear(hidden, dim, xavier(hidden, dim), vb.pp("lin1"))?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = self.norm.forward(x)?;
        affine(&self.lin1, &affine(&self.lin0, &x)?.relu()?)
    }
}

/// Returns `make()` if `wanted`.
fn when<T>(wanted: bool, make: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    if wanted { make().map(Some) } else { Ok(None) }
}
