//! Options of an SPGR call ([`crate::cpu::spgr`]).

use super::{OpacityRule, Positions};
use serde::{Deserialize, Serialize};

/// Largest number of children per parent; they are kept on the stack.
pub const CHILDREN_MAX: usize = 64;

/// v*: the camera in whose frame children are placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PrimaryView {
    /// The view with the smallest positive depth among those that see the parent; the
    /// source view if none does (paper).
    NearestVisible,
    /// The parent's source view: exact tiling of its pixel.
    Source,
}

/// Direction of the depth residual.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthDir {
    /// The optical axis (both of the paper's equations).
    Axis,
    /// The viewing ray (the paper's prose): the projection does not move.
    Ray,
}

/// Unit of β_z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthUnit {
    /// World units (paper).
    World,
    /// The parent's depth.
    Relative,
}

/// Sideways step of a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Slide {
    /// At constant camera z (paper).
    ZConst,
    /// Along the parent's own disc: Σ Jᵀ (J Σ Jᵀ)⁻¹ Δu.
    Disc,
}

/// Point at which the footprint's Jacobian is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AreaAt {
    /// The child's mean (supp.: "matches our implementation").
    Child,
    /// The parent's mean (main text).
    Parent,
}

/// Growth of a child whose footprint is below A_min.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AMinMode {
    /// All three σ by √(A_min/A), at most 50-fold.
    Iso,
    /// The two axes that determine the footprint.
    TwoAxis,
}

/// Operand of the colour gain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GainSpace {
    /// The SH sum: contrast about mid-grey (paper).
    Sh,
    /// The colour ½ + Σ: intensity.
    Rgb,
}

/// Options of SPGR as the kernels read them. `config::Spgr` documents each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// K, and the positions of the children. The target picture is √K times the input, side over
    /// side.
    pub positions: Positions,
    /// Choice of v*.
    pub primary_view: PrimaryView,
    /// ρ, sub-pixels.
    pub offset_bound: Option<f64>,
    /// β_z.
    pub beta_z: f64,
    /// Direction of depth residuals.
    pub depth_dir: DepthDir,
    /// Unit of β_z.
    pub depth_unit: DepthUnit,
    /// Sideways step of a child.
    pub slide: Slide,
    /// λ_s.
    pub lambda_s: f64,
    /// c of the soft bound c·tanh(x/c) of Δlog s.
    pub dlog_clamp: f64,
    /// Point at which the Jacobian of a footprint is taken.
    pub area_at: AreaAt,
    /// A_min, target px²; 0 disables the clamp.
    pub a_min: f64,
    /// Growth of a child whose footprint is below A_min.
    pub a_min_mode: AMinMode,
    /// Opacity rule.
    pub opacity: OpacityRule,
    /// Low-pass of the target picture, target px².
    pub lowpass_target: f64,
    /// Low-pass of a native render of the parents, input px².
    pub lowpass_input: f64,
    /// δ of γ = 1 + δ·tanh γ̃.
    pub delta: f64,
    /// Operand of the gain. [`GainSpace::Rgb`] takes four floats per child.
    pub gain_space: GainSpace,
}

impl Rules {
    /// Returns K.
    pub fn children(&self) -> usize {
        self.positions.children()
    }

    /// Returns √K: target px per input px, side over side. It is r for a grid of r² children.
    pub fn zoom(&self) -> f64 {
        (self.children() as f64).sqrt()
    }

    /// Returns the floats of gain per child, 1 or 4.
    pub fn gain_channels(&self) -> usize {
        match self.gain_space {
            GainSpace::Sh => 1,
            GainSpace::Rgb => 4,
        }
    }
}

/// Smallest squared area of a disc along which children move, px⁴.
pub const DISC_AREA_SQ_MIN: f64 = 1e-20;
