//! The two heads of SPGR and its rules in numbers (SubSplat 3.2; spec 2.1).
//!
//! g_θ: f^g + z^g → K × (Δu, Δv, Δz, Δlog s, Δr);   h_φ: f^a + z^a → K × (ℓ, γ̃).
//! Together one record `[n, K, 11]`, lanes in [`crate::abi`].
//!
//! * `mlp2`: `norm`, `lin0`, GELU, `lin1` to K·9 or K·2.
//! * `pg`: (Linear, ReLU, Linear, ReLU, LayerNorm) twice, Linear: `lin0` … `lin4`,
//!   `ln0`, `ln1`.
//! * `coord`: hid_k = GELU(lin0·norm(x) + c_k), o_k = lin1·hid_k, with
//!   c_k = `pos1`·GELU(`pos0`·posenc(g_k)) of the sub-pixel's place g_k: parameters
//!   do not depend on K.

use super::mlp::{LayerNorm, affine, gelu, linear};
use crate::abi::{HEAD_GEOMETRY_LEN, HEAD_STRIDE};
use crate::config::{
    AMin, AMinMode, AreaAt, Config, DepthDir, DepthUnit, GainSpace, OpacityRule, PrimaryView,
    Slide, SpgrHead,
};
use crate::ops::columns::columns;
use crate::ops::redistribute::Rule;
use crate::ops::spgr::Rules;
use candle_core::{Result, Tensor};
use candle_nn::{Init, Linear, VarBuilder};

/// Octaves of the positional encoding of a sub-pixel's place.
const OCTAVES: usize = 4;
/// x, y, and their sines and cosines.
const POSENC: usize = 2 + 4 * OCTAVES;

#[derive(Clone, Debug)]
enum Form {
    Mlp2 { norm: LayerNorm, lin0: Linear, lin1: Linear },
    Pg { lin: Vec<Linear>, ln: Vec<LayerNorm> },
    Coord { norm: LayerNorm, lin0: Linear, lin1: Linear, pos: [Linear; 2] },
}

/// One head, E → K × `lanes`.
#[derive(Clone, Debug)]
pub struct Head {
    form: Form,
    lanes: usize,
}

impl Head {
    /// `lanes` outputs per child.
    pub fn new(config: &Config, lanes: usize, vb: VarBuilder) -> Result<Self> {
        let (e, h) = (config.embed.dim, config.spgr.hidden);
        let kaiming = candle_nn::init::DEFAULT_KAIMING_UNIFORM;
        let last = if config.spgr.zero_init { Init::Const(0.0) } else { kaiming };
        let all = config.children() * lanes;
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
                lin1: linear(h, lanes, last, vb.pp("lin1"))?,
                pos: [
                    linear(POSENC, h, kaiming, vb.pp("pos0"))?,
                    linear(h, h, kaiming, vb.pp("pos1"))?,
                ],
            },
        };
        Ok(Self { form, lanes })
    }

    /// `x` `[n, E]` to `[n, r², lanes]`.
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
                let places = gelu(&affine(&pos[0], &posenc(side, &x)?)?)?;
                let places = affine(&pos[1], &places)?;
                // One child at a time: [n, K, hidden] never exists.
                let child = |i: usize| {
                    let hidden = x.broadcast_add(&places.narrow(0, i, 1)?)?;
                    affine(lin1, &gelu(&hidden)?)
                };
                Tensor::cat(&(0..k).map(child).collect::<Result<Vec<_>>>()?, 1)?
            }
        };
        out.reshape((n, k, self.lanes))
    }
}

/// Places of the r² sub-pixels in input px, (−½, ½)², and their sines and cosines:
/// `[r², 18]` of `like`'s dtype.
fn posenc(side: usize, like: &Tensor) -> Result<Tensor> {
    let mut table = Vec::with_capacity(side * side * POSENC);
    for k in 0..side * side {
        let place = [k % side, k / side].map(|i| (i as f32 + 0.5) / side as f32 - 0.5);
        table.extend(place);
        for octave in 0..OCTAVES {
            for g in place {
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
    /// Parameters `geo` and `app`.
    pub fn new(config: &Config, vb: VarBuilder) -> Result<Self> {
        let rest = HEAD_STRIDE - HEAD_GEOMETRY_LEN;
        Ok(Self {
            geometry: Head::new(config, HEAD_GEOMETRY_LEN, vb.pp("geo"))?,
            appearance: Head::new(config, rest, vb.pp("app"))?,
        })
    }

    /// Records `[n, r², 11]` from the heads' inputs `[n, E]`.
    pub fn forward(&self, geo: &Tensor, app: &Tensor, side: usize) -> Result<Tensor> {
        let geometry = self.geometry.forward(geo, side)?;
        let appearance = self.appearance.forward(app, side)?;
        let flat = columns(&geometry.flatten(0, 1)?, &appearance.flatten(0, 1)?, None)?;
        flat.reshape((geo.dim(0)?, side * side, HEAD_STRIDE))
    }
}

/// The configuration's rules in numbers, for r = `side`.
pub fn rules(config: &Config, side: usize) -> Rules {
    let s = &config.spgr;
    let k = side * side;
    let a_min = match s.a_min {
        AMin::OverK if k == 1 => 0.0,
        AMin::OverK => 1.0 / k as f64,
        AMin::TargetPx(area) => area,
        AMin::InputPx(area) => area * k as f64,
        AMin::Off => 0.0,
    };
    Rules {
        side,
        nearest_visible: s.primary_view == PrimaryView::NearestVisible,
        offset_bound: s.offset_bound,
        beta_z: s.beta_z,
        ray: s.depth_dir == DepthDir::Ray,
        relative_depth: s.depth_unit == DepthUnit::Relative,
        disc: s.slide == Slide::Disc,
        lambda_s: s.lambda_s.value(k),
        dlog_clamp: s.dlog_clamp,
        area_at_parent: s.area_at == AreaAt::Parent,
        a_min,
        two_axis: s.a_min_mode == AMinMode::TwoAxis,
        opacity: match s.opacity {
            OpacityRule::Linear => Rule::Linear,
            OpacityRule::OpticalDepth => Rule::OpticalDepth,
            OpacityRule::Transmittance => Rule::Transmittance,
            OpacityRule::Area => Rule::Area,
            OpacityRule::None => Rule::None,
        },
        lowpass_target: f64::from(config.render.lowpass_px2(side as f32)),
        lowpass_input: f64::from(config.render.lowpass),
        delta: s.delta,
        rgb_gain: s.gain_space == GainSpace::Rgb,
    }
}
