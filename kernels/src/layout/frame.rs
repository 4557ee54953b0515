//! Inputs and outputs of a rasterizer call in host memory, the same for every rasterizer of
//! the crate.

use super::{
    ALPHA_MAX_MVSPLAT, ALPHA_MAX_STANDARD, Convention, DEPTH_ALPHA_MIN, MEAN_OFFSET, SPLAT_STRIDE,
    TRANSMITTANCE_MIN, sh_coefficients,
};
use rayon::prelude::*;

/// Positions, shapes and opacities of N splats.
#[derive(Clone, Copy, Debug)]
pub enum Geometry<'a> {
    /// `[N, 11]` rows: mean, quaternion wxyz, σ, opacity (offsets in [`crate::layout`]).
    Packed(&'a [f32]),
    /// World covariances instead of quaternions and σ.
    Cov6 {
        /// `[N, 3]`, world.
        means: &'a [f32],
        /// `[N, 6]`: 00, 01, 02, 11, 12, 22.
        cov6: &'a [f32],
        /// `[N]`, after the sigmoid.
        opacities: &'a [f32],
    },
    /// An array for each attribute, as applications outside this crate hold them.
    Separate {
        /// `[N, 3]`, world.
        means: &'a [f32],
        /// `[N, 4]`, wxyz, of any length but zero.
        quats: &'a [f32],
        /// `[N, 3]`: σ, world units.
        scales: &'a [f32],
        /// `[N]`, after the sigmoid.
        opacities: &'a [f32],
    },
}

/// Borrowed splats as the kernels read them. Lengths must match. Debug builds check them;
/// release builds read missing numbers as neutral ones.
#[derive(Clone, Copy, Debug)]
pub struct SplatSlices<'a> {
    /// Positions, shapes and opacities of N splats.
    pub geometry: Geometry<'a>,
    /// `[P, D, 3]` with D = (`sh_degree` + 1)²; splat i reads set i / (N / P).
    pub sh: &'a [f32],
    /// `[]` (γ = 1, δ = 0), `[N]` (γ) or `[N, 4]` (γ, δ RGB).
    pub gain: &'a [f32],
    /// SH degree of `sh`.
    pub sh_degree: usize,
}

impl SplatSlices<'_> {
    /// Returns N, the number of splats.
    pub fn len(&self) -> usize {
        match self.geometry {
            Geometry::Packed(rows) => rows.len() / SPLAT_STRIDE,
            Geometry::Cov6 { means, cov6, opacities } => {
                (means.len() / 3).min(cov6.len() / 6).min(opacities.len())
            }
            Geometry::Separate { means, quats, scales, opacities } => {
                let shapes = (quats.len() / 4).min(scales.len() / 3);
                (means.len() / 3).min(shapes).min(opacities.len())
            }
        }
    }

    /// Reports whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns P, the number of SH sets.
    pub fn parents(&self) -> usize {
        self.sh.len() / (3 * sh_coefficients(self.sh_degree))
    }

    /// Returns K = N / P, at least 1.
    pub fn children_per_parent(&self) -> usize {
        self.len().div_ceil(self.parents().max(1)).max(1)
    }

    /// Reports whether all lengths match.
    pub fn is_consistent(&self) -> bool {
        let n = self.len();
        let geometry = match self.geometry {
            Geometry::Packed(rows) => rows.len() == n * SPLAT_STRIDE,
            Geometry::Cov6 { means, cov6, opacities } => {
                means.len() == 3 * n && cov6.len() == 6 * n && opacities.len() == n
            }
            Geometry::Separate { means, quats, scales, opacities } => {
                let shapes = quats.len() == 4 * n && scales.len() == 3 * n;
                means.len() == 3 * n && shapes && opacities.len() == n
            }
        };
        let p = self.parents();
        let sh = self.sh.len() == p * 3 * sh_coefficients(self.sh_degree);
        let children = if p == 0 { n == 0 } else { n.is_multiple_of(p) };
        let gain = self.gain.is_empty() || self.gain.len() == n || self.gain.len() == 4 * n;
        geometry && sh && children && gain
    }

    pub(crate) fn mean(&self, i: usize) -> [f32; 3] {
        match self.geometry {
            Geometry::Packed(rows) => floats_at(rows, i * SPLAT_STRIDE + MEAN_OFFSET),
            Geometry::Cov6 { means, .. } | Geometry::Separate { means, .. } => {
                floats_at(means, 3 * i)
            }
        }
    }
}

/// Returns the `N` floats from `at` on, or zeros where the slice is shorter.
pub(crate) fn floats_at<const N: usize>(from: &[f32], at: usize) -> [f32; N] {
    from.get(at..at + N).and_then(|s| s.try_into().ok()).unwrap_or([0.0; N])
}

/// Gradients of a scalar loss with respect to [`SplatSlices`], in the same layout. Buffers
/// are reused from call to call. Splats that contribute to no pixel have zeros.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gradients {
    /// `[N, 11]` for [`Geometry::Packed`], offsets in [`crate::layout`] (the quaternion's
    /// gradient passes through its normalisation); else empty.
    pub rows: Vec<f32>,
    /// `[N, 3]` unless [`Geometry::Packed`]; there empty.
    pub means: Vec<f32>,
    /// `[N, 6]` for [`Geometry::Cov6`], else empty. An off-diagonal gradient is that of both
    /// entries of the matrix.
    pub cov6: Vec<f32>,
    /// `[N, 4]` for [`Geometry::Separate`], else empty. It passes through the normalisation.
    pub quats: Vec<f32>,
    /// `[N, 3]` for [`Geometry::Separate`], else empty.
    pub scales: Vec<f32>,
    /// `[N]` unless [`Geometry::Packed`]; there empty.
    pub opacities: Vec<f32>,
    /// `[P, D, 3]`: summed over the children of each parent. D is [`Gradients::coefficients`].
    pub sh: Vec<f32>,
    /// Shape of [`SplatSlices::gain`].
    pub gain: Vec<f32>,
    /// `[3]`: of the background.
    pub background: [f32; 3],
    /// Set by the caller: the first SH coefficients of each channel whose gradients `sh` has. Default: all.
    /// Sets of degree 4 are the largest part of the gradients, 300 bytes of 360.
    pub sh_limit: Option<usize>,
}

impl Gradients {
    /// Resizes every buffer for `splats`.
    pub(crate) fn fit(&mut self, splats: &SplatSlices) {
        let n = splats.len();
        let (packed, cov, separate) = match splats.geometry {
            Geometry::Packed(_) => (n, 0, 0),
            Geometry::Cov6 { .. } => (0, n, 0),
            Geometry::Separate { .. } => (0, 0, n),
        };
        self.rows.resize(packed * SPLAT_STRIDE, 0.0);
        self.means.resize(3 * (cov + separate), 0.0);
        self.cov6.resize(6 * cov, 0.0);
        self.quats.resize(4 * separate, 0.0);
        self.scales.resize(3 * separate, 0.0);
        self.opacities.resize(cov + separate, 0.0);
        let set = 3 * self.coefficients(splats.sh_degree);
        resize(&mut self.sh, splats.parents() * set);
        self.gain.resize(splats.gain.len(), 0.0);
    }

    /// Coefficients of each channel whose gradients `sh` has, of sets of degree `sh_degree`.
    pub fn coefficients(&self, sh_degree: usize) -> usize {
        let all = sh_coefficients(sh_degree);
        self.sh_limit.map_or(all, |limit| limit.min(all))
    }

    /// Removes the gradients of the coefficients beyond `limit` ([`Gradients::sh_limit`]) from those of all
    /// coefficients of degree `sh_degree`.
    #[must_use]
    pub fn limited(mut self, sh_degree: usize, limit: Option<usize>) -> Self {
        self.sh_limit = limit;
        let (all, kept) = (3 * sh_coefficients(sh_degree), 3 * self.coefficients(sh_degree));
        if kept < all {
            self.sh = self.sh.chunks_exact(all).flat_map(|set| &set[..kept]).copied().collect();
        }
        self
    }

    /// Resizes every buffer for `splats` and fills it with zeros.
    pub(crate) fn clear(&mut self, splats: &SplatSlices) {
        *self = Self { sh_limit: self.sh_limit, ..Self::default() };
        self.fit(splats);
    }
}

/// Resizes `values`; new memory is cleared by all threads, which takes as long as a tenth of a backward pass
/// on one.
fn resize(values: &mut Vec<f32>, len: usize) {
    if values.capacity() < len {
        *values = Vec::with_capacity(len);
        values.par_extend(rayon::iter::repeat_n(0.0, len));
    } else {
        values.resize(len, 0.0);
    }
}

/// A rendered picture, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendered {
    /// W, px.
    pub width: usize,
    /// H, px.
    pub height: usize,
    /// `[H, W, 3]`: Σ w·c + T·background.
    pub rgb: Vec<f32>,
    /// `[H, W]`: 1 − T.
    pub alpha: Vec<f32>,
    /// `[H, W]`: Σ w·z, camera z in world units.
    pub depth_sum: Vec<f32>,
}

impl Rendered {
    /// Returns the depth `[H, W]`: Σ w·z / max(alpha, 1e-10), camera z in world units.
    pub fn depth(&self) -> Vec<f32> {
        let pixels = self.depth_sum.iter().zip(&self.alpha);
        pixels.map(|(z, a)| z / a.max(DEPTH_ALPHA_MIN)).collect()
    }
}

/// The two constants of blending that depend on the convention.
#[derive(Clone, Copy, Debug)]
pub struct BlendRules {
    /// Largest alpha of one splat at one pixel.
    pub alpha_max: f32,
    /// Blending stops where the transmittance would fall to this or below.
    pub stop: f32,
}

impl BlendRules {
    /// Returns the constants of `convention`.
    pub fn new(convention: Convention) -> Self {
        match convention {
            Convention::Standard => Self { alpha_max: ALPHA_MAX_STANDARD, stop: TRANSMITTANCE_MIN },
            Convention::Mvsplat => {
                Self { alpha_max: ALPHA_MAX_MVSPLAT, stop: TRANSMITTANCE_MIN.next_down() }
            }
        }
    }
}
