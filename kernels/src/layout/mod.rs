//! The data layout that the CPU kernels, the GPU kernels and the custom ops share: strides
//! and offsets of packed rows, the constants of both rasterizer conventions, the options of
//! a rasterizer call. Imports `camera` alone.
//!
//! Every constant that CPU and GPU kernels share is defined here and nowhere else. The WGSL of the
//! GPU kernels takes its constants from here (gpu/constants.rs).

mod frame;
mod gather;
pub mod parameters;
mod positions;
pub mod random;
mod spgr;
mod sweep;
mod view;

pub(crate) use frame::floats_at;
pub use frame::{BlendRules, Geometry, Gradients, Rendered, SplatSlices};
pub use gather::{Drop, Gather, Level, SampleConvention};
pub use positions::Positions;
pub use spgr::{
    AMinMode, AreaAt, CHILDREN_MAX, DISC_AREA_SQ_MIN, DepthDir, DepthUnit, GainSpace, PrimaryView,
    Rules, Slide,
};
pub use sweep::{Pair, Sweep};
pub use view::View;

use serde::{Deserialize, Serialize};

/// Floats of a packed splat row: mean 3, quaternion 4, scale 3, opacity 1.
pub const SPLAT_STRIDE: usize = 11;
/// Offset of the mean in a row, world units.
pub const MEAN_OFFSET: usize = 0;
/// Offset of the quaternion (w, x, y, z), world frame, of any length but zero.
pub const QUAT_OFFSET: usize = 3;
/// Offset of the scales: σ along the three axes of the quaternion's frame, world units,
/// not logarithms.
pub const SCALE_OFFSET: usize = 7;
/// Offset of the opacity, after the sigmoid, in [0, 1].
pub const OPACITY_OFFSET: usize = 10;

/// Contributions of a smaller alpha are skipped (8-bit quantisation; 3DGS).
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// log₂ of [`ALPHA_MIN`].
pub const ALPHA_MIN_LOG2: f32 = -7.994_353_3;
/// Blending stops where the transmittance would fall to this (3DGS).
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Largest alpha of one splat at one pixel, `standard` (gsplat).
pub const ALPHA_MAX_STANDARD: f32 = 0.999;
/// Largest alpha of one splat at one pixel, `mvsplat` (INRIA, August 2023).
pub const ALPHA_MAX_MVSPLAT: f32 = 0.99;
/// Nearest camera z that is rendered, `standard`, world units.
pub const NEAR_STANDARD: f32 = 0.01;
/// Nearest camera z that is rendered, `mvsplat`, in units of the camera's near plane.
pub const NEAR_MVSPLAT: f32 = 0.2;
/// Low-pass added to both diagonal entries of the 2-D covariance, px² (3DGS).
pub const LOWPASS: f32 = 0.3;
/// Side of the tiles at whose edges the `mvsplat` convention cuts splats, px.
pub const TILE_MVSPLAT: usize = 16;

/// Bound of x/z and y/z inside the Jacobian, `standard`: distance beyond each edge of the
/// picture in units of tan(fov/2) (gsplat).
pub const JACOBIAN_MARGIN_STANDARD: f32 = FRUSTUM_MARGIN as f32;
/// Bound of |x/z| and |y/z| inside the Jacobian, `mvsplat`: distance from the axis in units
/// of tan(fov/2) (INRIA).
pub const JACOBIAN_LIMIT_MVSPLAT: f32 = 1.3;
/// Term added to camera z in the projection of a mean, `mvsplat`, in units of the camera's
/// near plane (INRIA).
pub const Z_EPSILON_MVSPLAT: f32 = 1e-7;
/// Smallest discriminant under the root of λ_max, `mvsplat`, px⁴ (INRIA).
pub const DISCRIMINANT_MIN_MVSPLAT: f32 = 0.1;
/// Radius of a splat in σ of its longer axis, `mvsplat` (INRIA).
pub const RADIUS_SIGMAS_MVSPLAT: f32 = 3.0;
/// Smallest alpha that Σ w z is divided by for a depth.
pub const DEPTH_ALPHA_MIN: f32 = 1e-10;

/// Relative and absolute widening of a support, in log₂ of alpha. With it, rounding loses
/// no pixel on the rim; the test per pixel decides.
pub const SUPPORT_SLACK: f32 = 1e-4;
/// Widening of a row's interval, px, for the rounding of pixel positions.
pub const SPAN_SLACK_PX: f32 = 1e-3;
/// Largest opacity that is used, far beyond any cap on alpha: its logarithm fits the
/// exponential's range.
pub const OPACITY_MAX: f32 = 1e36;
/// Side of the tiles of the CPU kernels, px. It has no effect on the picture.
pub const TILE: usize = 32;
/// Side of the pixel blocks of a tile, px: 4 × 4 pixels fill a register of 16 lanes.
pub const BLOCK: usize = 4;

/// Returns the number of SH coefficients per colour channel at `degree`.
pub const fn sh_coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Highest SH degree that any part of the crate evaluates.
pub const SH_DEGREE_MAX: usize = 4;
/// Coefficients per channel at [`SH_DEGREE_MAX`]: 25.
pub const SH_COEFFICIENTS_MAX: usize = sh_coefficients(SH_DEGREE_MAX);

/// The rasterizer whose rules a render follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Convention {
    /// 3DGS and gsplat: any principal point, support where alpha ≥ 1/255, alpha capped at
    /// 0.999.
    #[default]
    Standard,
    /// The rasterizer of MVSplat's public weights: symmetric frustum, splats cut at 16×16
    /// tiles, alpha capped at 0.99, lengths in units of the near plane.
    Mvsplat,
}

/// The functions that SH coefficients multiply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShBasis {
    /// 3DGS: real SH with the Condon-Shortley sign (l = 1 is −y, z, −x), index
    /// l² + l + m, degrees 0 to 4.
    #[default]
    Standard,
    /// The functions of MVSplat's public weights: the standard ones at (z, x, y), function 14
    /// replaced by z(z² − x²), degree ≤ 3 (coefficients 16 and up are ignored).
    Mvsplat,
}

/// The direction in which view-dependent colour is evaluated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShDirection {
    /// Towards each child's own mean: exact, one SH evaluation per child.
    #[default]
    Child,
    /// Towards the mean of a parent's children: one SH evaluation per parent and camera.
    Parent,
    /// None: an SH set of degree 0 is the colour itself, of any sign, without the term ½ and without
    /// a lower bound (gsplat's `colors`). The rasterizer of the CPU alone has it. Not for files.
    #[serde(skip)]
    Colour,
}

/// Options of one rasterizer call.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Rules of projection, extent and blending.
    pub convention: Convention,
    /// Functions that the SH coefficients multiply.
    pub sh_basis: ShBasis,
    /// Highest SH degree that is evaluated; further coefficients are ignored.
    pub sh_degree: usize,
    /// Direction of the SH evaluation.
    pub sh_direction: ShDirection,
    /// Low-pass: term added to the diagonal of the 2-D covariance, px² of the picture.
    pub lowpass: f32,
    /// Scales each opacity by √(det Σ / det(Σ + low-pass)): a splat smaller than a pixel
    /// keeps its integral (`standard` only).
    pub antialiased: bool,
    /// `standard`: nearest camera z that is rendered, world units. `mvsplat`: the camera's
    /// near plane; the nearest z is 0.2 times it.
    pub near: f32,
    /// Background RGB, weighted by the final transmittance.
    pub background: [f32; 3],
}

impl RasterOptions {
    /// Returns the defaults of `convention`: all SH degrees, low-pass 0.3 px², black
    /// background.
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

/// Floats of a child's record from the heads: Δu, Δv, Δz, Δlog s (3), Δr (3), ℓ, γ̃
/// (SubSplat, g_θ and h_φ).
pub const HEAD_STRIDE: usize = 11;
/// Offset in a record of the learned displacement (û, v̂), sub-pixels before any bound.
pub const HEAD_UV_OFFSET: usize = 0;
/// Offset of the depth residual before its tanh.
pub const HEAD_DEPTH_OFFSET: usize = 2;
/// Offset of Δlog s.
pub const HEAD_LOG_SCALE_OFFSET: usize = 3;
/// Offset of Δr, a rotation vector in the parent's own axes, radians.
pub const HEAD_ROTATION_OFFSET: usize = 6;
/// Offset of the opacity logit ℓ.
pub const HEAD_LOGIT_OFFSET: usize = 9;
/// Offset of the colour gain γ̃ before its tanh.
pub const HEAD_GAIN_OFFSET: usize = 10;
/// Floats of a record from the geometry head g_θ; the appearance head h_φ gives the rest.
pub const HEAD_GEOMETRY_LEN: usize = 9;

/// Distribution of a parent's opacity over its children (`subsplat::network::ops::redistribute`). Kernels
/// read the discriminant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum OpacityRule {
    /// α_k = α_p·softmax(ℓ_k − ln A_k): the opacities sum to the parent's (paper).
    Linear = 0,
    /// Conserves Σ Ã_k τ_k, the footprint-weighted optical depth: τ = −ln(1 − α), Ã with the
    /// low-pass.
    OpticalDepth = 1,
    /// 1 − (1 − α_p)^{w_k}: conserves transmittance through all children.
    Transmittance = 2,
    /// min(0.99, α_p·A_p·w_k/A_k): conserves integrated opacity.
    Area = 3,
    /// α_p for every child.
    None = 4,
}

impl OpacityRule {
    /// Reports whether areas are measured in units of the parent's own.
    pub fn areas_are_relative(self) -> bool {
        matches!(self, OpacityRule::OpticalDepth | OpacityRule::Area)
    }
}

/// Form of the mean in the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MuInput {
    /// x, y, z.
    Raw,
    /// x/z, y/z, ln z.
    RayLogz,
}

/// ε of w̃ = w / (A + ε), px² (supp. A.3).
pub const AREA_EPS: f64 = 1e-8;
/// Largest parent opacity of which a logarithm is taken.
pub const OPACITY_CEILING: f64 = 0.9999;
/// Largest child opacity under the `area` rule.
pub const AREA_RULE_OPACITY_MAX: f64 = 0.99;
/// Smallest relative area that is divided by.
pub const RELATIVE_AREA_MIN: f64 = 1e-12;
/// Largest factor by which the minimum-footprint rule grows a σ.
pub const GROWTH_MAX: f64 = 50.0;
/// Term added to the squared area, so that its root has a gradient at zero, px⁴.
pub const AREA_SQ_EPS: f64 = 1e-24;
/// Smallest depth of a child as a fraction of its parent's depth.
pub const DEPTH_FRACTION_MIN: f64 = 0.1;
/// Bound of x/z and y/z inside the Jacobian beyond each edge of the picture, in units of
/// tan(fov/2) (3DGS: 1.3·tan(fov/2) from the axis).
pub const FRUSTUM_MARGIN: f64 = 0.3;
/// Smallest camera z at which a point is projected for sampling (GaussianFormer).
pub const VISIBLE_Z_MIN: f64 = 1e-5;

/// Returns γ and δ of `n` Gaussians, `[N, 4]`, from a gain of 0 (γ = 1), N (γ) or 4·N floats. δ is 0
/// where the gain has none.
pub fn gain_with_offsets(gain: &[f32], n: usize) -> Vec<f32> {
    debug_assert!([0, n, 4 * n].contains(&gain.len()), "gain of {} floats", gain.len());
    match gain.len().checked_div(n) {
        Some(4) => gain.to_vec(),
        Some(1) => gain.iter().flat_map(|&g| [g, 0.0, 0.0, 0.0]).collect(),
        _ => [1.0, 0.0, 0.0, 0.0].repeat(n),
    }
}
