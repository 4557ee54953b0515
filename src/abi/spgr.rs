//! The rules of one SPGR call ([`crate::cpu::spgr`]).

use super::Rule;

/// Most children per parent: they live on the stack.
pub const CHILDREN_MAX: usize = 64;

/// The rules in numbers; what each means is said at `config::Spgr`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// r: K = r² children, and the target picture is r times the input.
    pub side: usize,
    /// v* is the nearest view that sees the parent; else the source view.
    pub nearest_visible: bool,
    /// ρ, sub-pixels.
    pub offset_bound: Option<f64>,
    /// β_z.
    pub beta_z: f64,
    /// Depth residuals run along the viewing ray; else along the optical axis.
    pub ray: bool,
    /// β_z in units of the parent's depth; else world units.
    pub relative_depth: bool,
    /// Children slide along the parent's disc; else at constant camera z.
    pub disc: bool,
    /// λ_s.
    pub lambda_s: f64,
    /// c of the soft bound of Δlog s.
    pub dlog_clamp: f64,
    /// Footprints take the parent's Jacobian; else the child's.
    pub area_at_parent: bool,
    /// A_min, target px²; 0 is no clamp.
    pub a_min: f64,
    /// The clamp grows the two axes that make the footprint; else all three.
    pub two_axis: bool,
    /// Opacity rule.
    pub opacity: Rule,
    /// Low-pass of the target picture, target px².
    pub lowpass_target: f64,
    /// Low-pass of a native render of the parents, input px².
    pub lowpass_input: f64,
    /// δ of γ = 1 + δ·tanh γ̃.
    pub delta: f64,
    /// The gain multiplies ½ + Σ, not Σ alone: four lanes per child.
    pub rgb_gain: bool,
}

impl Rules {
    /// K.
    pub fn children(&self) -> usize {
        self.side * self.side
    }

    /// Floats of gain per child.
    pub fn gain_lanes(&self) -> usize {
        if self.rgb_gain { 4 } else { 1 }
    }
}

/// Floats of one context camera in the GPU's table.
pub const SPGR_CAMERA_STRIDE: usize = 23;
/// Least squared area of a disc that children slide on, px⁴.
pub const DISC_AREA_SQ_MIN: f64 = 1e-20;
