//! Where a stage samples the maps (spec 1.4 and 1.5).
//!
//! * `ref`: the parent's projected centre.
//! * `pixelgaussian`: key points on the Gaussian, fixed ones at the centre and at
//!   ±0.45 σ of each axis, learned ones at (sigmoid(Linear(f)) − ½) σ of all three,
//!   turned by the parent's rotation and projected.
//! * `map_offsets`: the centre and learned offsets in pixels of each map, Linear(q),
//!   starting on a ring one map pixel wide (Deformable DETR).

use super::Shared;
use crate::config::{Aggregation as Keys, Points};
use crate::model::geometry::rotate;
use crate::model::mlp::linear;
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

/// The layer that gives learned points, if there is one: `key_points` or `offsets`.
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

/// Initial bias of `offsets`, `len` numbers (u, v of one point after another): points
/// on a circle one map pixel in radius, golden-angle steps apart, so that the run
/// that any level takes of them goes all the way round.
pub fn ring(len: usize) -> Vec<f32> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let number = |i: usize| {
        let angle = golden * (i / 2) as f32;
        if i.is_multiple_of(2) { angle.cos() } else { angle.sin() }
    };
    (0..len).map(number).collect()
}

/// Sampling positions `[n, V, M or L·M, 2]`, given the stage's input `f` and query
/// `q`, both `[n, E]`.
pub(super) fn sample_points(
    keys: &Keys,
    shared: &Shared,
    learned: Option<&Linear>,
    (f, q): (&Tensor, &Tensor),
) -> Result<Tensor> {
    match keys.points {
        Points::Ref => Ok(shared.centres.clone()),
        Points::Pixelgaussian => key_points(keys, shared, learned, f),
        Points::MapOffsets => map_offsets(keys, shared, learned, q),
    }
}

fn key_points(
    keys: &Keys,
    shared: &Shared,
    learned: Option<&Linear>,
    f: &Tensor,
) -> Result<Tensor> {
    let parents = shared.parents;
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
    Ok(shared.frames.project(&world, keys.mask)?.0)
}

fn map_offsets(
    keys: &Keys,
    shared: &Shared,
    learned: Option<&Linear>,
    q: &Tensor,
) -> Result<Tensor> {
    let n = q.dim(0)?;
    let (v, levels) = (shared.frames.0.len(), shared.levels.len());
    let centres = shared.centres.unsqueeze(2)?;
    let own = centres.broadcast_as((n, v, levels, 1, 2))?;
    let all = match learned {
        None => own,
        Some(layer) => {
            let m = keys.n_learned;
            let size =
                shared.levels.iter().flat_map(|l| [1.0 / l.width as f32, 1.0 / l.height as f32]);
            let size = Tensor::from_vec(size.collect::<Vec<f32>>(), (levels, 1, 2), q.device())?;
            let offsets = layer.forward(q)?.reshape((n, levels, m, 2))?;
            let offsets = offsets.broadcast_mul(&size.to_dtype(q.dtype())?)?.unsqueeze(1)?;
            Tensor::cat(&[own, centres.broadcast_add(&offsets)?], 3)?
        }
    };
    all.reshape((n, v, (), 2))
}
