//! What the CPU kernels, the GPU kernels and the custom ops agree on: lane
//! numbers of packed rows, the constants of both rasterizer conventions, and the
//! options of one rasterizer call. Imports nothing of the crate.
//!
//! A constant that appears in a kernel appears here first; nothing else may
//! restate it. `kernels/shared/abi.wgsl` does, and `tests/shaders.rs` compares the two.

mod frame;
mod gather;
mod spgr;
mod sweep;
mod uniforms;

pub(crate) use frame::floats_at;
pub use frame::{BlendRules, Geometry, Gradients, Rendered, SplatSlices};
pub use gather::{Drop, GATHER_SAMPLES_MAX, GATHER_WEIGHTS_MAX, Gather, Level};
pub use spgr::{CHILDREN_MAX, DISC_AREA_SQ_MIN, Rules, SPGR_CAMERA_STRIDE};
pub use sweep::{Pair, SWEEP_PAIR_STRIDE, Sweep};
pub use uniforms::{
    AttentionGatherUniform, InvertUniform, PlaneSweepUniform, RasterUniform, RedistributeUniform,
    ShowUniform, SortUniform, SpgrGainsBwdUniform, SpgrUniform,
};

use serde::{Deserialize, Serialize};

/// Floats of one packed splat row: mean 3, quaternion 4, scale 3, opacity 1.
pub const SPLAT_STRIDE: usize = 11;
/// First lane of the mean, world units.
pub const MEAN_OFFSET: usize = 0;
/// First lane of the quaternion, (w, x, y, z), world frame, need not be unit.
pub const QUAT_OFFSET: usize = 3;
/// First lane of the scales: σ along the three axes of the quaternion's frame,
/// world units, not logarithms.
pub const SCALE_OFFSET: usize = 7;
/// Lane of the opacity, after the sigmoid, in [0, 1].
pub const OPACITY_OFFSET: usize = 10;

/// A contribution below this alpha is skipped (8-bit quantisation; 3DGS).
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// log₂ of [`ALPHA_MIN`].
pub const ALPHA_MIN_LOG2: f32 = -7.994_353_3;
/// Compositing stops where the transmittance would fall to this (3DGS).
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Largest alpha of one splat at one pixel, `standard` (gsplat).
pub const ALPHA_MAX_STANDARD: f32 = 0.999;
/// Largest alpha of one splat at one pixel, `mvsplat` (INRIA, August 2023).
pub const ALPHA_MAX_MVSPLAT: f32 = 0.99;
/// Nearest camera z that is drawn, `standard`, world units.
pub const NEAR_STANDARD: f32 = 0.01;
/// Nearest camera z that is drawn, `mvsplat`, in units of the camera's near plane.
pub const NEAR_MVSPLAT: f32 = 0.2;
/// Low-pass added to both diagonal entries of the 2-D covariance, px² (3DGS).
pub const LOWPASS: f32 = 0.3;
/// Side of the tiles whose edges the `mvsplat` convention makes visible, px.
pub const TILE_MVSPLAT: usize = 16;

/// How far beyond the picture's edge x/z and y/z still move the Jacobian,
/// `standard`: in units of tan(fov/2) beyond each edge (gsplat).
pub const JACOBIAN_MARGIN_STANDARD: f32 = FRUSTUM_MARGIN as f32;
/// Largest |x/z|, |y/z| that moves the Jacobian, `mvsplat`: in units of
/// tan(fov/2) from the axis (INRIA).
pub const JACOBIAN_LIMIT_MVSPLAT: f32 = 1.3;
/// Added to camera z where a mean is projected, `mvsplat`, in units of the
/// camera's near plane (INRIA).
pub const Z_EPSILON_MVSPLAT: f32 = 1e-7;
/// Smallest discriminant under the root of λ_max, `mvsplat`, px⁴ (INRIA).
pub const DISCRIMINANT_MIN_MVSPLAT: f32 = 0.1;
/// Radius of a splat in σ of its longer axis, `mvsplat` (INRIA).
pub const RADIUS_SIGMAS_MVSPLAT: f32 = 3.0;
/// Smallest divisor of Σ w z where depth is divided by the accumulated alpha.
pub const DEPTH_ALPHA_MIN: f32 = 1e-10;

/// Relative and absolute widening of a support, in log₂ of alpha: pixels on its
/// rim are found whatever the rounding, and the per-pixel test decides.
pub const SUPPORT_SLACK: f32 = 1e-4;
/// Widening of a row's interval, px, for the rounding of pixel positions.
pub const SPAN_SLACK_PX: f32 = 1e-3;
/// Larger opacities act as this one, far beyond any alpha cap, so that their
/// logarithm stays within what an exponent can hold.
pub const OPACITY_MAX: f32 = 1e36;
/// Side of the tiles that the GPU kernels work in, px: a thread a pixel.
pub const TILE_GPU: usize = 16;
/// Floats of a projected splat in the GPU kernels (kernels/shared/raster.wgsl).
pub const FOOTPRINT_STRIDE: usize = 12;
/// Sums over pixels that the rasterizer's backward kernels keep per (splat, tile) pair:
/// of ∂L/∂ln α times six moments, of weights times four gradients.
pub const PAIR_SUMS: usize = 10;
/// Elements that a workgroup of the GPU's sort and prefix sum takes.
pub const GPU_BLOCK: usize = 2048;
/// Place of a number in the plan of a sort: elements.
pub const PLAN_COUNT: usize = 3;
/// Blocks of [`GPU_BLOCK`] elements.
pub const PLAN_BLOCKS: usize = 4;
/// Elements that were asked for, room or not.
pub const PLAN_REQUESTED: usize = 5;
/// Workgroups of 256 elements along x, y and z; those of blocks stand at 0.
pub const PLAN_ELEMENT_GROUPS: usize = 8;
/// Words of a plan.
pub const PLAN_WORDS: usize = 12;
/// Side of the tiles that the kernels work in, px. Invisible in the picture.
pub const TILE: usize = 32;
/// Side of the pixel blocks inside a tile, px: 4 × 4 = one 16-lane register.
pub const BLOCK: usize = 4;

/// Number of SH coefficients per colour channel at `degree`.
pub const fn sh_coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Highest SH degree that any part of the crate evaluates.
pub const SH_DEGREE_MAX: usize = 4;
/// Coefficients per channel at [`SH_DEGREE_MAX`]: 25.
pub const SH_COEFFICIENTS_MAX: usize = sh_coefficients(SH_DEGREE_MAX);

/// Which rasterizer's rules a render follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Convention {
    /// 3DGS and gsplat: principal point honoured, support exactly where
    /// alpha ≥ 1/255, alpha capped at 0.999.
    #[default]
    Standard,
    /// The rasterizer that MVSplat's public weights were trained with:
    /// symmetric frustum, visible 16×16 tile cut, alpha capped at 0.99,
    /// lengths in units of the near plane.
    Mvsplat,
}

/// Which functions the SH coefficients multiply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShBasis {
    /// 3DGS: real SH with the Condon-Shortley sign (l = 1 is −y, z, −x), index
    /// l² + l + m, degrees 0 to 4.
    #[default]
    Standard,
    /// The kernel that MVSplat's public weights were trained with: the standard
    /// functions at (z, x, y), function 14 replaced by z(z² − x²), degree ≤ 3
    /// (coefficients 16 and up are ignored).
    Mvsplat,
}

/// From where the direction of view-dependent colour is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShDirection {
    /// Each child's own mean: exact, one SH evaluation per child.
    #[default]
    Child,
    /// The parent's direction, taken as the mean of its children's means: one
    /// SH evaluation per parent and camera.
    Parent,
}

/// Everything of one rasterizer call that is not a splat or a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Rules of projection, extent and blending.
    pub convention: Convention,
    /// Functions that the SH coefficients multiply.
    pub sh_basis: ShBasis,
    /// Degrees above this are not evaluated, however many coefficients a splat has.
    pub sh_degree: usize,
    /// Direction of the SH evaluation.
    pub sh_direction: ShDirection,
    /// Added to the diagonal of the 2-D covariance, px² of the rendered picture.
    pub lowpass: f32,
    /// Scale each opacity by √(det Σ / det(Σ + low-pass)), so that a splat
    /// smaller than a pixel keeps its integral (`standard` only).
    pub antialiased: bool,
    /// `standard`: nearest camera z drawn, world units. `mvsplat`: the camera's
    /// near plane, whose 0.2-fold is the nearest z drawn.
    pub near: f32,
    /// Colour behind everything, linear blend with the final transmittance.
    pub background: [f32; 3],
}

impl RasterOptions {
    /// The defaults of `convention`: SH degree as far as it evaluates, low-pass
    /// 0.3 px², black background.
    pub fn new(convention: Convention) -> Self {
        Self {
            convention,
            sh_basis: ShBasis::Standard,
            sh_degree: SH_DEGREE_MAX,
            sh_direction: ShDirection::Child,
            lowpass: LOWPASS,
            antialiased: false,
            near: match convention {
                Convention::Standard => NEAR_STANDARD,
                Convention::Mvsplat => 1.0,
            },
            background: [0.0; 3],
        }
    }
}

impl Default for RasterOptions {
    fn default() -> Self {
        Self::new(Convention::Standard)
    }
}

/// Floats of one child in the heads' record: Δu, Δv, Δz, Δlog s (3), Δr (3), ℓ, γ̃
/// (SubSplat, g_θ and h_φ).
pub const HEAD_STRIDE: usize = 11;
/// First lane of the learned offset (û, v̂), sub-pixels before any bound.
pub const HEAD_UV_OFFSET: usize = 0;
/// Lane of the depth residual before its tanh.
pub const HEAD_DEPTH_OFFSET: usize = 2;
/// First lane of Δlog s.
pub const HEAD_LOG_SCALE_OFFSET: usize = 3;
/// First lane of Δr, a rotation vector in the parent's own axes, radians.
pub const HEAD_ROTATION_OFFSET: usize = 6;
/// Lane of the opacity logit ℓ.
pub const HEAD_LOGIT_OFFSET: usize = 9;
/// Lane of the colour gain γ̃ before its tanh.
pub const HEAD_GAIN_OFFSET: usize = 10;
/// Lanes that the geometry head g_θ gives; the appearance head h_φ gives the rest.
pub const HEAD_GEOMETRY_LEN: usize = 9;

/// How a parent's opacity is shared among its children ([`crate::ops::redistribute`]).
/// The numbers are the kernels'.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Rule {
    /// Sums to the parent's.
    Linear = 0,
    /// Conserves footprint-weighted optical depth.
    OpticalDepth = 1,
    /// Conserves transmittance through all children.
    Transmittance = 2,
    /// Conserves integrated opacity.
    Area = 3,
    /// Every child has the parent's.
    None = 4,
}

impl Rule {
    /// Whether areas count in units of the parent's own.
    pub fn areas_are_relative(self) -> bool {
        matches!(self, Rule::OpticalDepth | Rule::Area)
    }
}

/// No cell, in the lists that gradients are summed by.
pub const NONE: u32 = u32::MAX;

/// ε of w̃ = w / (A + ε), px² (supp. A.3).
pub const AREA_EPS: f64 = 1e-8;
/// Largest parent opacity of which a logarithm is taken (spec 2.11).
pub const OPACITY_CEILING: f64 = 0.9999;
/// Largest child opacity under the `area` rule.
pub const AREA_RULE_OPACITY_MAX: f64 = 0.99;
/// Least relative area that is divided by.
pub const RELATIVE_AREA_MIN: f64 = 1e-12;
/// Most that the minimum-footprint rule multiplies a σ by (spec 2.6).
pub const GROWTH_MAX: f64 = 50.0;
/// Added to the squared area, so that its root has a gradient at zero, px⁴.
pub const AREA_SQ_EPS: f64 = 1e-24;
/// A child lies at least this fraction of its parent's depth away (spec 2.4).
pub const DEPTH_FRACTION_MIN: f64 = 0.1;
/// How far beyond each picture edge, in tan(fov/2), the Jacobian's x/z and y/z may
/// reach (3DGS: 1.3·tan(fov/2) in all).
pub const FRUSTUM_MARGIN: f64 = 0.3;
/// Least camera z at which a point is projected for sampling (GaussianFormer).
pub const VISIBLE_Z_MIN: f64 = 1e-5;
