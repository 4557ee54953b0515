//! Sampling positions of an ablated attention stage.
//!
//! * `ref`: the parent's projected centre (SubSplat A.2).
//! * `pixelgaussian`: key points on the Gaussian. Fixed points lie at the centre and at
//!   ±0.45 σ of each axis, learned points at (sigmoid(Linear(f)) − ½) σ of all three. The
//!   parent's rotation applies to both (PixelGaussian, GaussianFormer).
//! * `map_offsets`: the centre and learned offsets in pixels of each map, Linear(q). The
//!   offsets start on a ring of one map pixel (Deformable DETR).

use super::Call;
use crate::network::config::{AggregationAblations as Keys, Points};
use crate::network::model::geometry::rotate;
use crate::network::model::mlp::linear;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, Module, VarBuilder};

/// Fixed key points in σ, in GaussianFormer's order.
const FIXED: [[f32; 3]; 7] = [
    [0.0, 0.0, 0.0],
    [0.45, 0.0, 0.0],
    [-0.45, 0.0, 0.0],
    [0.0, 0.45, 0.0],
    [0.0, -0.45, 0.0],
    [0.0, 0.0, 0.45],
    [0.0, 0.0, -0.45],
];

/// The layer of learned points, if there are any: `key_points` or `offsets`.
pub(super) fn learned(
    keys: &Keys,
    dim: usize,
    levels: usize,
    vb: &VarBuilder,
) -> Result<Option<Linear>> {
    if keys.n_learned == 0 {
        return Ok(None);
    }
    let zero = Init::Const(0.0);
    Ok(match keys.points {
        Points::Ref => None,
        Points::Pixelgaussian => {
            let kaiming = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
            Some(linear(dim, 3 * keys.n_learned, kaiming, vb.pp("key_points"))?)
        }
        Points::MapOffsets => {
            Some(linear(dim, 2 * levels * keys.n_learned, zero, vb.pp("offsets"))?)
        }
    })
}

/// Returns the initial bias of `offsets`, `len` numbers (u, v of one point after
/// another): points on a circle of one map pixel in radius, golden-angle steps apart. The
/// points of each level then spread over the whole circle.
pub fn ring(len: usize) -> Vec<f32> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let number = |i: usize| {
        let angle = golden * (i / 2) as f32;
        if i.is_multiple_of(2) { angle.cos() } else { angle.sin() }
    };
    (0..len).map(number).collect()
}

/// Returns sampling positions `[n, V, M or L·M, 2]` for the stage's input `f` and query
/// `q`, both `[n, E]`.
pub(super) fn sample_points(
    keys: &Keys,
    call: &Call,
    learned: Option<&Linear>,
    f: &Tensor,
    q: &Tensor,
) -> Result<Tensor> {
    match keys.points {
        Points::Ref => Ok(call.centres.clone()),
        Points::Pixelgaussian => key_points(keys, call, learned, f),
        Points::MapOffsets => map_offsets(keys, call, learned, q),
    }
}

fn key_points(keys: &Keys, call: &Call, learned: Option<&Linear>, f: &Tensor) -> Result<Tensor> {
    let parents = call.parents;
    let n = f.dim(0)?;
    let mut kappas = Vec::with_capacity(2);
    if keys.n_fixed > 0 {
        let fixed: Vec<f32> = FIXED[..keys.n_fixed].iter().flatten().copied().collect();
        let fixed = Tensor::from_vec(fixed, (1, keys.n_fixed, 3), f.device())?;
        kappas.push(fixed.to_dtype(f.dtype())?.broadcast_as((n, keys.n_fixed, 3))?);
    }
    if let Some(layer) = learned {
        let kappa = (candle_nn::ops::sigmoid(&layer.forward(f)?)? - 0.5)?;
        kappas.push(kappa.reshape((n, keys.n_learned, 3))?);
    }
    let kappa = Tensor::cat(&kappas, 1)?;
    let local = kappa.broadcast_mul(&parents.scales.unsqueeze(1)?)?;
    let world = rotate(&parents.quats_wxyz, &local)?.broadcast_add(&parents.means.unsqueeze(1)?)?;
    Ok(call.frames.project(&world, keys.mask)?.0)
}

fn map_offsets(keys: &Keys, call: &Call, learned: Option<&Linear>, q: &Tensor) -> Result<Tensor> {
    let n = q.dim(0)?;
    let v = call.frames.0.len();
    let levels = call.levels.len();
    let centres = call.centres.unsqueeze(2)?;
    let own = centres.broadcast_as((n, v, levels, 1, 2))?;
    let all = match learned {
        None => own,
        Some(layer) => {
            let m = keys.n_learned;
            let size =
                call.levels.iter().flat_map(|l| [1.0 / l.width as f32, 1.0 / l.height as f32]);
            let size = Tensor::from_vec(size.collect::<Vec<f32>>(), (levels, 1, 2), q.device())?;
            let offsets = layer.forward(q)?.reshape((n, levels, m, 2))?;
            let offsets = offsets.broadcast_mul(&size.to_dtype(q.dtype())?)?.unsqueeze(1)?;
            Tensor::cat(&[own, centres.broadcast_add(&offsets)?], 3)?
        }
    };
    all.reshape((n, v, (), 2))
}
