//! Options of an SPGR call ([`crate::cpu::spgr`]).

use super::Rule;

/// Largest number of children per parent; they are kept on the stack.
pub const CHILDREN_MAX: usize = 64;

/// Options of SPGR as the kernels read them. `config::Spgr` documents each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// r: K = r² children; the target picture is r times the input.
    pub side: usize,
    /// v* is the nearest of the views in whose picture the parent lies; else the source view.
    pub nearest_visible: bool,
    /// ρ, sub-pixels.
    pub offset_bound: Option<f64>,
    /// β_z.
    pub beta_z: f64,
    /// Applies depth residuals along the viewing ray; else along the optical axis.
    pub ray: bool,
    /// β_z is in units of the parent's depth; else in world units.
    pub relative_depth: bool,
    /// Moves children along the parent's disc; else at constant camera z.
    pub disc: bool,
    /// λ_s.
    pub lambda_s: f64,
    /// c of the soft bound c·tanh(x/c) of Δlog s.
    pub dlog_clamp: f64,
    /// Takes the Jacobian of a footprint at the parent; else at the child.
    pub area_at_parent: bool,
    /// A_min, target px²; 0 disables the clamp.
    pub a_min: f64,
    /// The clamp grows the two axes that span the footprint; else all three.
    pub two_axis: bool,
    /// Opacity rule.
    pub opacity: Rule,
    /// Low-pass of the target picture, target px².
    pub lowpass_target: f64,
    /// Low-pass of a native render of the parents, input px².
    pub lowpass_input: f64,
    /// δ of γ = 1 + δ·tanh γ̃.
    pub delta: f64,
    /// The gain multiplies ½ + Σ rather than Σ alone: four floats per child.
    pub rgb_gain: bool,
}

impl Rules {
    /// Returns K.
    pub fn children(&self) -> usize {
        self.side * self.side
    }

    /// Returns the floats of gain per child, 1 or 4.
    pub fn gain_channels(&self) -> usize {
        if self.rgb_gain { 4 } else { 1 }
    }
}

/// Floats of a context camera in the GPU's table.
pub const SPGR_CAMERA_STRIDE: usize = 23;
/// Smallest squared area of a disc along which children move, px⁴.
pub const DISC_AREA_SQ_MIN: f64 = 1e-20;
