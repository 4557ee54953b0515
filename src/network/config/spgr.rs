//! Sub-pixel Gaussian reparameterization (SubSplat 3.2, supplement A.3).
//!
//! The presets differ in some keys of [`Spgr`]; choices that neither preset makes belong
//! to [`SpgrAblations`].

pub use subsplat_kernels::layout::{
    AMinMode, AreaAt, DepthDir, DepthUnit, GainSpace, OpacityRule, PrimaryView, Slide,
};

use super::Preset;
use serde::{Deserialize, Serialize};

/// Sub-pixel Gaussian reparameterization (SubSplat 3.2, supplement A.3).
///
/// The serialised form holds these keys and those of [`SpgrAblations`] side by side,
/// without nesting.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "FlatKeys", into = "FlatKeys")]
pub struct Spgr {
    /// False: the primaries themselves are rendered (MVSplat).
    pub enabled: bool,
    /// Form of the two heads.
    pub head: SpgrHead,
    /// Hidden width of the heads (128).
    pub hidden: usize,
    /// The heads' last layers start at zero: every child starts as the even split of its
    /// parent.
    pub zero_init: bool,
    /// v*: the camera in whose frame children are placed.
    pub primary_view: PrimaryView,
    /// ρ: bound of the learned offset, sub-pixels; `None` is unbounded (paper).
    pub offset_bound: Option<f64>,
    /// β_z: bound of the depth residual (supp.: 0.25).
    pub beta_z: f64,
    /// Direction of the depth residual.
    pub depth_dir: DepthDir,
    /// Unit of β_z.
    pub depth_unit: DepthUnit,
    /// λ_s: factor of the child's σ (supp.: 0.60 for all K).
    pub lambda_s: LambdaS,
    /// Soft bound of Δlog s, c·tanh(x/c) (3).
    pub dlog_clamp: f64,
    /// Distribution of the parent's opacity over the children.
    pub opacity: OpacityRule,
    /// δ: the colour gain lies in [1 − δ, 1 + δ] (supp.: 0.25).
    pub delta: f64,
    /// Choices that neither preset makes.
    pub ablations: SpgrAblations,
}

/// Choices of the reparameterization that neither preset makes. [`Default`] is the form
/// of both presets.
#[derive(Clone, Debug, PartialEq)]
pub struct SpgrAblations {
    /// Sideways step of a child.
    pub slide: Slide,
    /// Point at which the footprint's Jacobian is taken (supp.: the child).
    pub area_at: AreaAt,
    /// A_min: smallest footprint σ₁σ₂, target px² (paper: 1/K).
    pub a_min: AMin,
    /// Growth of a child whose footprint is below A_min.
    pub a_min_mode: AMinMode,
    /// Operand of the colour gain.
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
    /// One output layer for all children, which differ by an embedding of their
    /// sub-pixel coordinate: any K at inference.
    Coord,
    /// `mlp2` whose output layer is a polynomial of the child's position and of log K: any K at
    /// inference, at the cost of `mlp2`. At K = 1 the only child is its parent.
    Polynomial,
}

impl SpgrHead {
    /// Returns whether one set of parameters serves every K.
    pub fn serves_any_k(self) -> bool {
        match self {
            Self::Mlp2 | Self::Pg => false,
            Self::Coord | Self::Polynomial => true,
        }
    }
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
    /// Returns λ_s for `children` children.
    pub fn value(self, children: usize) -> f64 {
        match self {
            LambdaS::Value(v) => v,
            LambdaS::OverSqrtK(c) => c / (children as f64).sqrt(),
        }
    }
}

/// A_min: smallest footprint σ₁σ₂.
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
            lambda_s: LambdaS::Value(0.60),
            dlog_clamp: 3.0,
            opacity: OpacityRule::Linear,
            delta: 0.25,
            ablations: SpgrAblations::default(),
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

impl Default for SpgrAblations {
    fn default() -> Self {
        Self {
            slide: Slide::ZConst,
            area_at: AreaAt::Child,
            a_min: AMin::OverK,
            a_min_mode: AMinMode::Iso,
            gain_space: GainSpace::Sh,
        }
    }
}

/// The serialised form of [`Spgr`]: all keys on one level. Weight files and training
/// configurations hold it, so keys and their order stay as they are.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Spgr")]
struct FlatKeys {
    enabled: bool,
    head: SpgrHead,
    hidden: usize,
    zero_init: bool,
    primary_view: PrimaryView,
    offset_bound: Option<f64>,
    beta_z: f64,
    depth_dir: DepthDir,
    depth_unit: DepthUnit,
    slide: Slide,
    lambda_s: LambdaS,
    dlog_clamp: f64,
    area_at: AreaAt,
    a_min: AMin,
    a_min_mode: AMinMode,
    opacity: OpacityRule,
    delta: f64,
    gain_space: GainSpace,
}

impl From<FlatKeys> for Spgr {
    fn from(k: FlatKeys) -> Self {
        Self {
            enabled: k.enabled,
            head: k.head,
            hidden: k.hidden,
            zero_init: k.zero_init,
            primary_view: k.primary_view,
            offset_bound: k.offset_bound,
            beta_z: k.beta_z,
            depth_dir: k.depth_dir,
            depth_unit: k.depth_unit,
            lambda_s: k.lambda_s,
            dlog_clamp: k.dlog_clamp,
            opacity: k.opacity,
            delta: k.delta,
            ablations: SpgrAblations {
                slide: k.slide,
                area_at: k.area_at,
                a_min: k.a_min,
                a_min_mode: k.a_min_mode,
                gain_space: k.gain_space,
            },
        }
    }
}

impl From<Spgr> for FlatKeys {
    fn from(s: Spgr) -> Self {
        let a = s.ablations;
        Self {
            enabled: s.enabled,
            head: s.head,
            hidden: s.hidden,
            zero_init: s.zero_init,
            primary_view: s.primary_view,
            offset_bound: s.offset_bound,
            beta_z: s.beta_z,
            depth_dir: s.depth_dir,
            depth_unit: s.depth_unit,
            slide: a.slide,
            lambda_s: s.lambda_s,
            dlog_clamp: s.dlog_clamp,
            area_at: a.area_at,
            a_min: a.a_min,
            a_min_mode: a.a_min_mode,
            opacity: s.opacity,
            delta: s.delta,
            gain_space: a.gain_space,
        }
    }
}
