//! The attention stage of both presets (SubSplat A.2): dot products at each parent's
//! projected centre, one softmax over views and levels, view gates V·softmax(β).

use super::{Call, StageInput};
use crate::network::config::{Aggregation as Keys, StageNorm};
use crate::network::model::layers::{LayerNorm, xavier};
use crate::network::model::mlp::{affine, linear};
use crate::network::ops::Array;
use crate::network::ops::attention_gather::Gather;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, VarBuilder};
use subsplat_kernels::layout::SampleConvention;

/// Parameters of one stage.
#[derive(Clone, Debug)]
pub(super) struct Stage {
    norm: Option<LayerNorm>,
    /// W_k of each level.
    wk: Vec<Linear>,
    /// W_v of each level.
    wv: Vec<Linear>,
    /// b_ℓ, `[L]`, if there is more than one level.
    level_bias: Option<Tensor>,
    /// β, `[gate_views]`.
    gate: Tensor,
}

impl Stage {
    /// `dim`: E; `widths`: channels of each level's map.
    pub(super) fn new(keys: &Keys, dim: usize, widths: &[usize], vb: VarBuilder) -> Result<Self> {
        let zero = Init::Const(0.0);
        Ok(Self {
            norm: match keys.norm {
                StageNorm::Pre => Some(LayerNorm::new(dim, vb.pp("norm"))?),
                StageNorm::None => None,
            },
            wk: per_level(dim, widths, vb.pp("wk"))?,
            wv: per_level(dim, widths, vb.pp("wv"))?,
            level_bias: match widths.len() {
                0 | 1 => None,
                levels => Some(vb.get_with_hints(levels, "level_bias", zero)?),
            },
            gate: vb.get_with_hints(keys.gate_views, "gate", zero)?,
        })
    }

    /// Projects `maps`, `[cells of the level, C]` each, to rows `[cells, 2E]` of keys and
    /// values of all levels.
    pub(super) fn project<A: Array>(&self, maps: &[A]) -> Result<A> {
        let layers = self.wk.iter().zip(&self.wv);
        let rows = maps.iter().zip(layers).map(|(map, (wk, wv))| affine(&joined(wk, wv)?, map));
        A::cat(&rows.collect::<Result<Vec<_>>>()?.iter().collect::<Vec<_>>(), 0)
    }

    /// Returns the next f, `[n, E]`.
    pub(super) fn forward<A: Array>(
        &self,
        call: &Call<'_, A>,
        input: StageInput<'_, A>,
    ) -> Result<A> {
        let StageInput { maps, deferred, f, z, .. } = input;
        let q = match &self.norm {
            Some(norm) => norm.forward_of_sum(f, z)?,
            None => f.add(z)?,
        };
        let [_, dim] = q.sizes()?;
        let query = self.query(call, &q)?;
        let gather = gather(call, dim);
        let centres = &call.centres;
        let backend = call.backend;
        maps.attention_gather(&query, centres, gather, deferred, Some(f), backend)
    }

    /// Rows of (q `[E]`, bias `[V·L]`, gate `[V]`).
    fn query<A: Array>(&self, call: &Call<'_, A>, q: &A) -> Result<A> {
        let [n, _] = q.sizes()?;
        let (v, l) = (call.frames.0.len(), call.levels.len());
        let bias = match &self.level_bias {
            Some(bias) => {
                let bias = q.upload(&bias.reshape((1, 1, l))?)?;
                bias.broadcast_as(&[n, v, l])?.reshape((n, v * l))?
            }
            None => q.new_tensor(vec![0.0], &[1, 1])?.broadcast_as(&[n, v * l])?,
        };
        let gates = view_shares(&self.gate, v)?.affine(v as f64, 0.0)?;
        let gates = visible(q.upload(&gates.unsqueeze(0)?)?.broadcast_as(&[n, v])?, call)?;
        q.cat_columns(&bias, Some(&gates))
    }
}

fn gather<A>(call: &Call<'_, A>, dim: usize) -> Gather {
    Gather {
        levels: call.levels.to_vec(),
        views: call.frames.0.len(),
        points: 1,
        points_per_level: false,
        dim,
        groups: 1,
        stride: 2 * dim,
        key: Some(0),
        value: dim,
        logit_scale: (dim as f64).sqrt().recip(),
        renormalise: true,
        sample_convention: SampleConvention::HalfPixel,
        drop: None,
        point_gradient: true,
    }
}

/// One projection to E channels for each level's `widths`.
pub(super) fn per_level(dim: usize, widths: &[usize], vb: VarBuilder) -> Result<Vec<Linear>> {
    let layer = |(l, &c): (usize, &usize)| linear(c, dim, xavier(c, dim), vb.pp(l.to_string()));
    widths.iter().enumerate().map(layer).collect()
}

/// One layer that gives the outputs of `a` and then those of `b`.
pub(super) fn joined(a: &Linear, b: &Linear) -> Result<Linear> {
    let bias = match (a.bias(), b.bias()) {
        (Some(a), Some(b)) => Some(Tensor::cat(&[a, b], 0)?),
        _ => None,
    };
    Ok(Linear::new(Tensor::cat(&[a.weight(), b.weight()], 0)?, bias))
}

/// softmax(β) over the first `views` views, `[views]`.
pub(super) fn view_shares(beta: &Tensor, views: usize) -> Result<Tensor> {
    let beta = beta.narrow(0, 0, views)?;
    let e = beta.broadcast_sub(&beta.max_keepdim(0)?)?.exp()?;
    e.broadcast_div(&e.sum_keepdim(0)?)
}

/// `gates` `[n, V]` times the visibility, if the occlusion gate is on.
pub(super) fn visible<A: Array>(gates: A, call: &Call<'_, A>) -> Result<A> {
    match &call.visibility {
        Some(visibility) => gates.mul(visibility),
        None => Ok(gates),
    }
}
