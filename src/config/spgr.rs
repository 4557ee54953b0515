//! Sub-pixel Gaussian reparameterization (paper 3.2; spec 2).

use super::Preset;
use serde::{Deserialize, Serialize};

/// Sub-pixel Gaussian reparameterization (paper 3.2; spec 2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spgr {
    /// Off: the primaries themselves are rendered (MVSplat).
    pub enabled: bool,
    /// Form of the two heads.
    pub head: SpgrHead,
    /// Hidden width of the heads (128).
    pub hidden: usize,
    /// Last layers start at zero: every child begins as the deterministic split.
    pub zero_init: bool,
    /// v*: the camera in whose frame children are placed.
    pub primary_view: PrimaryView,
    /// ρ: bound of the learned offset, in sub-pixels; `None` is unbounded (paper).
    pub offset_bound: Option<f64>,
    /// β_z: bound of the depth residual (supp.: 0.25).
    pub beta_z: f64,
    /// Direction of the depth residual.
    pub depth_dir: DepthDir,
    /// Unit of β_z.
    pub depth_unit: DepthUnit,
    /// How a child moves sideways.
    pub slide: Slide,
    /// λ_s: factor of the child's σ (supp.: 0.60 for all K).
    pub lambda_s: LambdaS,
    /// Soft bound of Δlog s, c·tanh(x/c) (3).
    pub dlog_clamp: f64,
    /// Where the footprint's Jacobian is taken (supp.: at the child).
    pub area_at: AreaAt,
    /// A_min: least footprint σ₁σ₂, target px² (paper: 1/K).
    pub a_min: AMin,
    /// How a child that is too small grows.
    pub a_min_mode: AMinMode,
    /// Opacity rule.
    pub opacity: OpacityRule,
    /// δ: colour gain lies in [1 − δ, 1 + δ] (supp.: 0.25).
    pub delta: f64,
    /// What the gain multiplies.
    pub gain_space: GainSpace,
}

/// Form of the SPGR heads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpgrHead {
    /// LayerNorm, Linear, GELU, Linear to K·9 and K·2.
    Mlp2,
    /// (Linear, ReLU, Linear, ReLU, LayerNorm) twice, Linear (PixelGaussian).
    Pg,
    /// One output layer for all children, told apart by an embedding of their
    /// sub-pixel coordinate: any K at inference.
    Coord,
}

/// v*: in whose frame children are placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PrimaryView {
    /// The least positive depth among the views that see the parent; the source
    /// view if none does (paper).
    NearestVisible,
    /// The view that the parent came from: exact tiling of its pixel.
    Source,
}

/// Direction of the depth residual.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthDir {
    /// The optical axis (both equations).
    Axis,
    /// The viewing ray (the prose): the projection does not move.
    Ray,
}

/// Unit of β_z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthUnit {
    /// World units (paper).
    World,
    /// Of the parent's depth.
    Relative,
}

/// How a child moves sideways.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Slide {
    /// At constant camera z (paper).
    ZConst,
    /// Along the parent's own disc: Σ Jᵀ (J Σ Jᵀ)⁻¹ Δu.
    Disc,
}

/// λ_s: factor of the child's σ.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LambdaS {
    /// The same for every K (supp.: 0.60).
    Value(f64),
    /// c/√K (`tuned`: c = 1; the supplement's 0.60 at K = 4 is c = 1.2).
    OverSqrtK(f64),
}

impl LambdaS {
    /// λ_s for `children` children.
    pub fn value(self, children: usize) -> f64 {
        match self {
            LambdaS::Value(v) => v,
            LambdaS::OverSqrtK(c) => c / (children as f64).sqrt(),
        }
    }
}

/// Where the footprint's Jacobian is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AreaAt {
    /// At the child's mean (supp.: "matches our implementation").
    Child,
    /// At the parent's (main text).
    Parent,
}

/// A_min: least footprint σ₁σ₂.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AMin {
    /// 1/K target px² (paper), off at K = 1 so that the only child is its parent.
    OverK,
    /// This many target px².
    TargetPx(f64),
    /// This many input px².
    InputPx(f64),
    /// No clamp.
    Off,
}

/// How a child that is too small grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AMinMode {
    /// All three σ by √(A_min/A), at most 50-fold.
    Iso,
    /// The two axes that make the footprint.
    TwoAxis,
}

/// How the parent's opacity is shared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OpacityRule {
    /// α_k = α_p·softmax(ℓ_k − ln A_k): sums to the parent's (paper).
    Linear,
    /// Conserves Σ Ã_k τ_k, τ = −ln(1 − α), Ã with the low-pass (spec 2.8).
    OpticalDepth,
    /// 1 − (1 − α_p)^{w_k}: conserves transmittance through all children.
    Transmittance,
    /// min(0.99, α_p·A_p·w_k/A_k): conserves integrated opacity.
    Area,
    /// α_p.
    None,
}

/// What the colour gain multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GainSpace {
    /// The SH sum: contrast about mid-grey (paper).
    Sh,
    /// The colour ½ + Σ: intensity.
    Rgb,
}

impl Spgr {
    pub(super) fn preset(preset: Preset) -> Self {
        let paper = Self {
            enabled: true,
            head: SpgrHead::Mlp2,
            hidden: 128,
            zero_init: true,
            primary_view: PrimaryView::NearestVisible,
            offset_bound: None,
            beta_z: 0.25,
            depth_dir: DepthDir::Axis,
            depth_unit: DepthUnit::World,
            slide: Slide::ZConst,
            lambda_s: LambdaS::Value(0.60),
            dlog_clamp: 3.0,
            area_at: AreaAt::Child,
            a_min: AMin::OverK,
            a_min_mode: AMinMode::Iso,
            opacity: OpacityRule::Linear,
            delta: 0.25,
            gain_space: GainSpace::Sh,
        };
        match preset {
            Preset::Paper => paper,
            Preset::Tuned => Self {
                primary_view: PrimaryView::Source,
                offset_bound: Some(0.5),
                beta_z: 0.1,
                depth_dir: DepthDir::Ray,
                depth_unit: DepthUnit::Relative,
                lambda_s: LambdaS::OverSqrtK(1.0),
                opacity: OpacityRule::OpticalDepth,
                ..paper
            },
        }
    }
}
