//! The two heads of SPGR, and its constants (SubSplat 3.2).
//!
//! g_θ: f^g + z^g → K × (Δu, Δv, Δz, Δlog s, Δr);   h_φ: f^a + z^a → K × (ℓ, γ̃).
//! Their outputs form one record `[n, K, 11]`; columns as in [`crate::abi`].
//!
//! * `mlp2`: `norm`, `lin0`, GELU, `lin1` to K·9 or K·2.
//! * `pg`: (Linear, ReLU, Linear, ReLU, LayerNorm) twice, Linear: `lin0` … `lin4`,
//!   `ln0`, `ln1`.
//! * `coord`: hid_k = GELU(lin0·norm(x) + c_k), o_k = lin1·hid_k, with
//!   c_k = `pos1`·GELU(`pos0`·posenc(g_k)) of the sub-pixel's position g_k. The
//!   parameters do not depend on K.

use super::embed::Descriptors;
use super::mlp::{LayerNorm, affine, gelu, linear};
use crate::abi::{HEAD_GEOMETRY_LEN, HEAD_STRIDE};
use crate::config::{AMin, Config, SpgrHead};
use crate::ops::columns::columns;
use crate::ops::spgr::Rules;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, VarBuilder};

/// Octaves of the positional encoding of a sub-pixel.
const OCTAVES: usize = 4;
/// Width of the positional encoding: x, y, and their sines and cosines.
const POSENC: usize = 2 + 4 * OCTAVES;

#[derive(Clone, Debug)]
enum Form {
    Mlp2 { norm: LayerNorm, lin0: Linear, lin1: Linear },
    Pg { lin: Vec<Linear>, ln: Vec<LayerNorm> },
    Coord { norm: LayerNorm, lin0: Linear, lin1: Linear, pos: [Linear; 2] },
}

/// One head: E channels to K × `outputs` numbers.
#[derive(Clone, Debug)]
pub struct Head {
    form: Form,
    outputs: usize,
}

impl Head {
    /// `outputs`: numbers per child.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(config: &Config, outputs: usize, vb: VarBuilder) -> Result<Self> {
        let (e, h) = (config.embed.dim, config.spgr.hidden);
        let kaiming = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
        let last = if config.spgr.zero_init { Init::Const(0.0) } else { kaiming };
        let all = config.children() * outputs;
        let form = match config.spgr.head {
            SpgrHead::Mlp2 => Form::Mlp2 {
                norm: LayerNorm::new(e, vb.pp("norm"))?,
                lin0: linear(e, h, kaiming, vb.pp("lin0"))?,
                lin1: linear(h, all, last, vb.pp("lin1"))?,
            },
            SpgrHead::Pg => {
                let widths = [(e, h), (h, h), (h, h), (h, h), (h, all)];
                let layer = |(i, (a, b)): (usize, (usize, usize))| {
                    linear(a, b, if i == 4 { last } else { kaiming }, vb.pp(format!("lin{i}")))
                };
                let norm = |i: usize| LayerNorm::new(h, vb.pp(format!("ln{i}")));
                Form::Pg {
                    lin: widths.into_iter().enumerate().map(layer).collect::<Result<_>>()?,
                    ln: (0..2).map(norm).collect::<Result<_>>()?,
                }
            }
            SpgrHead::Coord => Form::Coord {
                norm: LayerNorm::new(e, vb.pp("norm"))?,
                lin0: linear(e, h, kaiming, vb.pp("lin0"))?,
                lin1: linear(h, outputs, last, vb.pp("lin1"))?,
                pos: [
                    linear(POSENC, h, kaiming, vb.pp("pos0"))?,
                    linear(h, h, kaiming, vb.pp("pos1"))?,
                ],
            },
        };
        Ok(Self { form, outputs })
    }

    /// Maps `x` `[n, E]` to `[n, r², outputs]`, r = `side`.
    ///
    /// # Errors
    /// Shapes do not fit; r differs from the configured one (every form but `coord`).
    pub fn forward(&self, x: &Tensor, side: usize) -> Result<Tensor> {
        let (n, k) = (x.dim(0)?, side * side);
        let out = match &self.form {
            Form::Mlp2 { norm, lin0, lin1 } => {
                let hidden = affine(lin0, &norm.forward(x)?)?;
                affine(lin1, &gelu(&hidden)?)?
            }
            Form::Pg { lin, ln } => {
                let mut x = x.clone();
                for (i, ln) in ln.iter().enumerate() {
                    x = affine(&lin[2 * i], &x)?.relu()?;
                    x = ln.forward(&affine(&lin[2 * i + 1], &x)?.relu()?)?;
                }
                affine(&lin[4], &x)?
            }
            Form::Coord { norm, lin0, lin1, pos } => {
                let x = affine(lin0, &norm.forward(x)?)?;
                let positions = gelu(&affine(&pos[0], &posenc(side, &x)?)?)?;
                let positions = affine(&pos[1], &positions)?;
                // One child at a time, so that no tensor [n, K, hidden] exists.
                let child = |i: usize| {
                    let hidden = x.broadcast_add(&positions.narrow(0, i, 1)?)?;
                    affine(lin1, &gelu(&hidden)?)
                };
                Tensor::cat(&(0..k).map(child).collect::<Result<Vec<_>>>()?, 1)?
            }
        };
        out.reshape((n, k, self.outputs))
    }
}

/// Positions of the r² sub-pixels in input px, (−½, ½)², with their sines and cosines:
/// `[r², 18]`, dtype of `like`.
fn posenc(side: usize, like: &Tensor) -> Result<Tensor> {
    let mut table = Vec::with_capacity(side * side * POSENC);
    for k in 0..side * side {
        let position = [k % side, k / side].map(|i| (i as f32 + 0.5) / side as f32 - 0.5);
        table.extend(position);
        for octave in 0..OCTAVES {
            for g in position {
                let (sin, cos) = (std::f32::consts::PI * (1 << octave) as f32 * g).sin_cos();
                table.extend([sin, cos]);
            }
        }
    }
    Tensor::from_vec(table, (side * side, POSENC), like.device())?.to_dtype(like.dtype())
}

/// Both heads.
#[derive(Clone, Debug)]
pub struct Heads {
    geometry: Head,
    appearance: Head,
}

impl Heads {
    /// Reads the parameters `geo` and `app`.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(config: &Config, vb: VarBuilder) -> Result<Self> {
        let rest = HEAD_STRIDE - HEAD_GEOMETRY_LEN;
        Ok(Self {
            geometry: Head::new(config, HEAD_GEOMETRY_LEN, vb.pp("geo"))?,
            appearance: Head::new(config, rest, vb.pp("app"))?,
        })
    }

    /// Maps the heads' inputs to records `[n, r², 11]`, r = `side`.
    ///
    /// # Errors
    /// Those of [`Head::forward`].
    pub fn forward(&self, inputs: &Descriptors, side: usize) -> Result<Tensor> {
        let geometry = self.geometry.forward(&inputs.geometry, side)?;
        let appearance = self.appearance.forward(&inputs.appearance, side)?;
        let flat = columns(&geometry.flatten(0, 1)?, &appearance.flatten(0, 1)?, None)?;
        flat.reshape((geometry.dim(0)?, side * side, HEAD_STRIDE))
    }
}

/// Returns the constants of the fused op for `config` and r = `side`.
pub fn rules(config: &Config, side: usize) -> Rules {
    let (s, ablations) = (&config.spgr, &config.spgr.ablations);
    let k = side * side;
    let a_min = match ablations.a_min {
        AMin::OverK if k == 1 => 0.0,
        AMin::OverK => 1.0 / k as f64,
        AMin::TargetPx(area) => area,
        AMin::InputPx(area) => area * k as f64,
        AMin::Off => 0.0,
    };
    Rules {
        side,
        primary_view: s.primary_view,
        offset_bound: s.offset_bound,
        beta_z: s.beta_z,
        depth_dir: s.depth_dir,
        depth_unit: s.depth_unit,
        slide: ablations.slide,
        lambda_s: s.lambda_s.value(k),
        dlog_clamp: s.dlog_clamp,
        area_at: ablations.area_at,
        a_min,
        a_min_mode: ablations.a_min_mode,
        opacity: s.opacity,
        lowpass_target: f64::from(config.render.lowpass_px2(side as f32)),
        lowpass_input: f64::from(config.render.lowpass),
        delta: s.delta,
        gain_space: ablations.gain_space,
    }
}
