//! The two heads of SPGR, and its constants (SubSplat 3.2).
//!
//! g_θ: f^g + z^g → K × (Δu, Δv, Δz, Δlog s, Δr);   h_φ: f^a + z^a → K × (ℓ, γ̃).
//! Their outputs form one record `[n, K, 11]`; columns as in [`subsplat_kernels::layout`].
//!
//! * `mlp2`: `norm`, `lin0`, GELU, `lin1` to K·9 or K·2.
//! * `pg`: (Linear, ReLU, Linear, ReLU, LayerNorm) twice, Linear: `lin0` … `lin4`,
//!   `ln0`, `ln1`.
//! * `polynomial`: `mlp2` whose last layer depends on the child. With g_k the sub-pixel's position,
//!   t = 4·g_x, u = 4·g_y and κ = log₂ √K − 1, it is the bilinear interpolation of the four layers
//!   `lin1`, which lie at t, u = ±1, plus Σ_b φ_b(t, u, κ)·`lin2`_b. The 14 terms φ are the products of
//!   one of {1, t, t² − 1}, one of {1, u, u² − 1} and one of {1, κ}, without the four bilinear ones. At
//!   K = 4 all of them are 0, so `lin1` alone gives the four children, as in `mlp2`.
//! * `coord`: hid_k = GELU(lin0·norm(x) + c_k), o_k = lin1·hid_k, with
//!   c_k = `pos1`·GELU(`pos0`·posenc(g_k)) of the sub-pixel's position g_k. The
//!   parameters do not depend on K.
//!
//! One set of `polynomial` heads serves every K. The layer of a child is made once per run, so any K
//! costs what fixed heads cost. `coord` applies its activation K times as often.

use super::embed::Descriptors;
use super::layers::{Activation, LayerNorm};
use super::mlp::{affine, affine_then, linear};
use crate::network::config::{AMin, Config, SpgrHead};
use crate::network::ops::Array;
use crate::network::ops::spgr::Rules;
use candle_core::{Result, Tensor, bail};
use candle_nn::{Init, Linear, VarBuilder};
use subsplat_kernels::layout::{HEAD_GEOMETRY_LEN, HEAD_STRIDE, Positions};

/// Octaves of the positional encoding of a sub-pixel.
const OCTAVES: usize = 4;
/// Width of the positional encoding: x, y, and their sines and cosines.
const POSENC: usize = 2 + 4 * OCTAVES;
/// Layers of `polynomial`: four of `lin1`, 14 of `lin2`.
const LAYERS: [usize; 2] = [4, 14];

#[derive(Clone, Debug)]
enum Form {
    Mlp2 {
        norm: LayerNorm,
        lin0: Linear,
        lin1: Linear,
    },
    Pg {
        lin: Vec<Linear>,
        ln: Vec<LayerNorm>,
    },
    Coord {
        norm: LayerNorm,
        lin0: Linear,
        lin1: Linear,
        pos: [Linear; 2],
    },
    /// The last two map to 4·`outputs` and 14·`outputs` numbers, layer by layer.
    Polynomial {
        norm: LayerNorm,
        lin0: Linear,
        last: [Linear; 2],
    },
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
            SpgrHead::Polynomial => Form::Polynomial {
                norm: LayerNorm::new(e, vb.pp("norm"))?,
                lin0: linear(e, h, kaiming, vb.pp("lin0"))?,
                last: [
                    linear(h, LAYERS[0] * outputs, last, vb.pp("lin1"))?,
                    linear(h, LAYERS[1] * outputs, Init::Const(0.0), vb.pp("lin2"))?,
                ],
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

    /// Returns the head for K = `children`: `polynomial` becomes `mlp2`, other forms stay.
    fn for_children(&self, children: usize) -> Result<Self> {
        let Form::Polynomial { norm, lin0, last } = &self.form else { return Ok(self.clone()) };
        let hidden = last[0].weight().dim(1)?;
        // Layers of the children: sums of the given ones.
        let summed =
            |part: fn(&Linear) -> Option<&Tensor>, width: usize| -> Result<Option<Tensor>> {
                let [Some(four), Some(further)] = [part(&last[0]), part(&last[1])] else {
                    return Ok(None);
                };
                let [bilinear, terms] = factors(children, four)?;
                let four = bilinear.matmul(&four.reshape((LAYERS[0], width))?)?;
                Ok(Some((four + terms.matmul(&further.reshape((LAYERS[1], width))?)?)?))
            };
        let weight = summed(|layer| Some(layer.weight()), self.outputs * hidden)?;
        let Some(weight) = weight else { bail!("head: expected a weight, got none") };
        let bias = match summed(Linear::bias, self.outputs)? {
            Some(bias) => Some(bias.flatten_all()?),
            None => None,
        };
        let lin1 = Linear::new(weight.reshape((children * self.outputs, hidden))?, bias);
        let form = Form::Mlp2 { norm: norm.clone(), lin0: lin0.clone(), lin1 };
        Ok(Self { form, outputs: self.outputs })
    }

    /// Maps `x` `[n, E]` to `[n, K, outputs]`.
    ///
    /// # Errors
    /// Shapes do not fit; K differs from the one of the parameters (`mlp2` and `pg`).
    pub fn forward<A: Array>(&self, x: &A, k: usize) -> Result<A> {
        let [n, _] = x.sizes()?;
        let out = match &self.form {
            Form::Mlp2 { norm, lin0, lin1 } => {
                let hidden = affine_then(lin0, &norm.forward(x)?, Activation::Gelu)?;
                affine(lin1, &hidden)?
            }
            Form::Pg { lin, ln } => {
                let mut x = x.clone();
                for (i, ln) in ln.iter().enumerate() {
                    x = affine_then(&lin[2 * i], &x, Activation::Relu)?;
                    x = ln.forward(&affine_then(&lin[2 * i + 1], &x, Activation::Relu)?)?;
                }
                affine(&lin[4], &x)?
            }
            Form::Coord { norm, lin0, lin1, pos } => {
                let x = affine(lin0, &norm.forward(x)?)?;
                let positions = x.new_tensor(posenc(k), &[k, POSENC])?;
                let positions = affine_then(&pos[0], &positions, Activation::Gelu)?;
                let positions = affine(&pos[1], &positions)?;
                // One child at a time, so that no tensor [n, K, hidden] exists.
                let child = |i: usize| {
                    let hidden = x.add_activation(&positions.narrow(0, i, 1)?, Activation::Gelu)?;
                    affine(lin1, &hidden)
                };
                let children = (0..k).map(child).collect::<Result<Vec<_>>>()?;
                A::cat(&children.iter().collect::<Vec<_>>(), 1)?
            }
            Form::Polynomial { .. } => return self.for_children(k)?.forward(x, k),
        };
        if out.elem_count() != n * k * self.outputs {
            let expected = k * self.outputs;
            bail!("head: expected {expected} outputs for {k} children, got {:?}", out.dims());
        }
        out.reshape((n, k, self.outputs))
    }
}

/// Positions of the K children in input px, (−½, ½)², with their sines and cosines: `[K, 18]`.
fn posenc(children: usize) -> Vec<f32> {
    let positions = Positions::new(children);
    let mut table = Vec::with_capacity(children * POSENC);
    for k in 0..children {
        let position = positions.of(k).map(|x| x as f32);
        table.extend(position);
        for octave in 0..OCTAVES {
            for g in position {
                let (sin, cos) = (std::f32::consts::PI * (1 << octave) as f32 * g).sin_cos();
                table.extend([sin, cos]);
            }
        }
    }
    table
}

/// Factors of the layers of `polynomial` for each child: `[K, 4]` and `[K, 14]`, dtype of `like`.
fn factors(children: usize, like: &Tensor) -> Result<[Tensor; 2]> {
    let positions = Positions::new(children);
    let kappa = (children as f32).sqrt().log2() - 1.0;
    let towards = |at: f32, second: bool| 0.5 * if second { 1.0 + at } else { 1.0 - at };
    let (mut bilinear, mut terms) = (Vec::new(), Vec::new());
    for k in 0..children {
        let [t, u] = positions.of(k).map(|x| 4.0 * x as f32);
        let corners = (0..LAYERS[0]).map(|c| towards(t, c % 2 == 1) * towards(u, c / 2 == 1));
        bilinear.extend(corners);
        for (power, factor) in [1.0, kappa].into_iter().enumerate() {
            for (j, by_u) in [1.0, u, u * u - 1.0].into_iter().enumerate() {
                for (i, by_t) in [1.0, t, t * t - 1.0].into_iter().enumerate() {
                    // The bilinear terms without κ belong to the four layers.
                    if power == 1 || i == 2 || j == 2 {
                        terms.push(factor * by_t * by_u);
                    }
                }
            }
        }
    }
    let table = |values: Vec<f32>, width: usize| {
        Tensor::from_vec(values, (children, width), like.device())?.to_dtype(like.dtype())
    };
    Ok([table(bilinear, LAYERS[0])?, table(terms, LAYERS[1])?])
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

    /// Returns the heads for K = `children`, which compute no polynomial per call.
    ///
    /// # Errors
    /// Those of candle.
    pub fn for_children(&self, children: usize) -> Result<Self> {
        let Self { geometry, appearance } = self;
        Ok(Self {
            geometry: geometry.for_children(children)?,
            appearance: appearance.for_children(children)?,
        })
    }

    /// Maps the heads' inputs to records `[n, K, 11]`.
    ///
    /// # Errors
    /// Those of [`Head::forward`].
    pub fn forward<A: Array>(&self, inputs: &Descriptors<A>, children: usize) -> Result<A> {
        let geometry = self.geometry.forward(&inputs.geometry, children)?;
        let appearance = self.appearance.forward(&inputs.appearance, children)?;
        let [n, k, outputs] = geometry.sizes()?;
        let rest = appearance.reshape((n * k, ()))?;
        let flat = geometry.reshape((n * k, outputs))?.cat_columns(&rest, None)?;
        flat.reshape((n, k, HEAD_STRIDE))
    }
}

/// Returns the constants of the fused op for `config` and K = `k`.
pub fn rules(config: &Config, k: usize) -> Rules {
    let s = &config.spgr;
    let ablations = &config.spgr.ablations;
    let positions = Positions::new(k);
    let a_min = match ablations.a_min {
        AMin::OverK if k == 1 => 0.0,
        AMin::OverK => 1.0 / k as f64,
        AMin::TargetPx(area) => area,
        AMin::InputPx(area) => area * k as f64,
        AMin::Off => 0.0,
    };
    Rules {
        positions,
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
        lowpass_target: f64::from(config.render.lowpass_px2((k as f32).sqrt())),
        lowpass_input: f64::from(config.render.lowpass),
        delta: s.delta,
        gain_space: ablations.gain_space,
    }
}
