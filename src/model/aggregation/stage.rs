//! One attention stage: projections, query, gates, gather, residual, feed-forward.

use super::points::{learned, sample_points};
use super::{Shared, points_per_sample};
use crate::config::{
    Aggregation as Keys, AttentionOp, Gate, LogitScale, MaskMode, Points, Residual,
    SampleConvention, StageNorm,
};
use crate::model::mlp::{LayerNorm, Mode, affine, linear, xavier};
use crate::ops::attention_gather::{Drop, Gather, attention_gather_deferred};
use crate::ops::columns::columns;
use crate::ops::moves;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, Module, VarBuilder};

/// Hidden width of the feed-forward block over E (GaussianFormer: 512 for 128).
const FFN_EXPANSION: usize = 4;

/// Whether each stage's W_v maps a level's channels to E before sampling. Several
/// groups keep one W_o after it instead.
pub(super) fn projects_values(keys: &Keys) -> bool {
    keys.kv_proj && keys.groups == 1
}

fn projects_keys(keys: &Keys) -> bool {
    keys.kv_proj && keys.op == AttentionOp::Dot
}

#[derive(Clone, Debug)]
enum Gates {
    /// β, factor of its softmax over the views in use (`None`: their number).
    PerView(Tensor, Option<f64>),
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
pub(super) struct Stage {
    norm: Option<LayerNorm>,
    /// W_k per level.
    wk: Vec<Linear>,
    /// W_v per level.
    wv: Vec<Linear>,
    /// W_o after sampling.
    wo: Option<Linear>,
    /// b_ℓ, where there is more than one level to tell apart.
    level_bias: Option<Tensor>,
    /// Attention logits of op `linear`, `[gate_views, L, M, G]`.
    weights: Option<Linear>,
    gates: Gates,
    learned: Option<Linear>,
    cat: Option<Linear>,
    ffn: Option<FeedForward>,
}

impl Stage {
    /// `widths`: channels of each level's map.
    pub(super) fn new(keys: &Keys, dim: usize, widths: &[usize], vb: VarBuilder) -> Result<Self> {
        let zero = Init::Const(0.0);
        let levels = widths.len();
        let per_level = |on: bool, name: &str| -> Result<Vec<Linear>> {
            let each = |(l, &c): (usize, &usize)| {
                linear(c, dim, xavier(c, dim), vb.pp(name).pp(l.to_string()))
            };
            if on { widths.iter().enumerate().map(each).collect() } else { Ok(Vec::new()) }
        };
        let dot = keys.op == AttentionOp::Dot;
        let samples = keys.gate_views * levels * points_per_sample(keys);
        let joined = if keys.residual == Residual::Cat { 2 * dim } else { dim };
        Ok(Self {
            norm: on(keys.norm == StageNorm::Pre, || LayerNorm::new(dim, vb.pp("norm")))?,
            wk: per_level(projects_keys(keys), "wk")?,
            wv: per_level(projects_values(keys), "wv")?,
            wo: on(keys.kv_proj && keys.groups > 1, || {
                linear(dim, dim, xavier(dim, dim), vb.pp("wo"))
            })?,
            level_bias: on(dot && levels > 1, || vb.get_with_hints(levels, "level_bias", zero))?,
            weights: on(!dot, || linear(dim, samples * keys.groups, zero, vb.pp("weights")))?,
            gates: match keys.gate {
                Gate::SoftmaxV => {
                    Gates::PerView(vb.get_with_hints(keys.gate_views, "gate", zero)?, None)
                }
                Gate::Softmax => {
                    Gates::PerView(vb.get_with_hints(keys.gate_views, "gate", zero)?, Some(1.0))
                }
                Gate::Query => Gates::Query(linear(dim, 1, zero, vb.pp("gate"))?),
                Gate::Off => Gates::Off,
            },
            learned: learned(keys, dim, levels, &vb)?,
            cat: on(keys.residual == Residual::Cat, || {
                linear(2 * dim, dim, xavier(2 * dim, dim), vb.pp("cat"))
            })?,
            ffn: on(keys.ffn, || FeedForward::new(joined, dim, vb.pp("ffn")))?,
        })
    }

    /// The stage's maps `[cells, E]` or `[cells, 2E]` (keys, values) of all levels.
    pub(super) fn project(&self, maps: &[Tensor]) -> Result<Tensor> {
        let mut levels = Vec::with_capacity(maps.len());
        for (l, map) in maps.iter().enumerate() {
            // Without projections keys and values are one and the same row.
            levels.push(match (self.wk.get(l), self.wv.get(l)) {
                (Some(wk), Some(wv)) => affine(&stacked(wk, wv)?, map)?,
                (Some(wk), None) => Tensor::cat(&[&affine(wk, map)?, map], 1)?,
                (None, Some(wv)) => affine(wv, map)?,
                (None, None) => map.clone(),
            });
        }
        moves::stacked(&levels)
    }

    /// The next f from this one and the embedding z, both `[n, E]`; `(t, maps)`: index
    /// of the stage and what [`Stage::project`] gave.
    pub(super) fn forward(
        &self,
        keys: &Keys,
        shared: &Shared,
        (t, maps): (usize, &Tensor),
        (f, z): (&Tensor, &Tensor),
    ) -> Result<Tensor> {
        let mut q = moves::sum(f, z)?;
        if let Some(norm) = &self.norm {
            q = norm.forward(&q)?;
        }
        let points = sample_points(keys, shared, self.learned.as_ref(), (f, &q))?;
        let gather = self.gather(keys, shared, t, q.dim(1)?);
        let query = self.query(keys, shared, &gather, &q)?;
        let (backend, deferred) = (shared.backend, shared.deferred.get(t));
        let mut o = attention_gather_deferred(backend, maps, &query, &points, gather, deferred)?;
        if let Some(wo) = &self.wo {
            o = affine(wo, &o)?;
        }
        let (joined, next) = match (keys.residual, &self.cat) {
            (Residual::Cat, Some(cat)) => {
                let joined = columns(f, &o, None)?;
                let next = affine(cat, &joined)?;
                (joined, next)
            }
            (Residual::None, _) => (o.clone(), o),
            _ => {
                let next = moves::sum(f, &o)?;
                (next.clone(), next)
            }
        };
        match &self.ffn {
            Some(ffn) => moves::sum(&next, &ffn.forward(&joined)?),
            None => Ok(next),
        }
    }

    fn gather(&self, keys: &Keys, shared: &Shared, t: usize, dim: usize) -> Gather {
        let separate = !self.wk.is_empty();
        let drop = match shared.mode {
            Mode::Train { seed } if keys.attn_drop > 0.0 => Some(Drop {
                probability: keys.attn_drop,
                seed: seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(t as u64),
                first_parent: shared.parents.first,
            }),
            _ => None,
        };
        Gather {
            levels: shared.levels.to_vec(),
            views: shared.frames.0.len(),
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
            half_pixel: keys.sample_convention == SampleConvention::HalfPixel,
            drop,
            point_gradient: !keys.detach_points || self.learned.is_some(),
        }
    }

    /// Rows of (q, bias `[V,L,M,G]`, gate `[V]`).
    fn query(&self, keys: &Keys, shared: &Shared, g: &Gather, q: &Tensor) -> Result<Tensor> {
        let n = q.dim(0)?;
        let (v, l, m) = (g.views, g.levels.len(), g.points);
        let width = v * l * m * keys.groups;
        let bias = match (&self.weights, &self.level_bias) {
            (Some(weights), _) => affine(weights, q)?.narrow(1, 0, width)?,
            (None, Some(bias)) => {
                let bias = bias.reshape((1, 1, l, 1, 1))?;
                bias.broadcast_as((n, v, l, m, keys.groups))?.reshape((n, width))?
            }
            (None, None) => Tensor::zeros((n, width), q.dtype(), q.device())?,
        };
        let gates = match &self.gates {
            Gates::PerView(beta, factor) => {
                let beta = beta.narrow(0, 0, v)?;
                let e = beta.broadcast_sub(&beta.max_keepdim(0)?)?.exp()?;
                let p = e.broadcast_div(&e.sum_keepdim(0)?)?;
                p.affine(factor.unwrap_or(v as f64), 0.0)?.unsqueeze(0)?.broadcast_as((n, v))?
            }
            Gates::Query(layer) => {
                let gate = candle_nn::ops::sigmoid(&layer.forward(q)?)?;
                gate.affine(2.0, 0.0)?.broadcast_as((n, v))?
            }
            Gates::Off => Tensor::ones((n, v), q.dtype(), q.device())?,
        };
        let gates = match &shared.occlusion {
            Some(visible) => gates.mul(visible)?,
            None => gates,
        };
        match g.key {
            Some(_) => columns(q, &bias, Some(&gates)),
            None => columns(&bias, &gates, None),
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

/// One layer that gives the outputs of both, side by side.
fn stacked(a: &Linear, b: &Linear) -> Result<Linear> {
    let bias = match (a.bias(), b.bias()) {
        (Some(a), Some(b)) => Some(Tensor::cat(&[a, b], 0)?),
        _ => None,
    };
    Ok(Linear::new(Tensor::cat(&[a.weight(), b.weight()], 0)?, bias))
}

/// `make()` where `wanted`.
fn on<T>(wanted: bool, make: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    if wanted { make().map(Some) } else { Ok(None) }
}
