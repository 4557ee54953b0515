//! A set of Gaussians: packed rows, one SH set per parent, and a colour gain per child.
//!
//! A child stores no SH of its own (SubSplat, h_{p,k} = γ_k · h_p). N children of P parents
//! (N = P·K) take 12 to 15 floats each instead of 86.

mod statistics;

pub use statistics::{Quantiles, SplatStatistics};

use rayon::prelude::*;
use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SH_DEGREE_MAX, SPLAT_STRIDE, ShBasis,
};
use thiserror::Error;

/// Reason for which packed splats are refused.
#[derive(Debug, Error, PartialEq)]
pub enum SplatsError {
    /// The length of a buffer does not match the others.
    #[error("splats {what}: expected {expected}, got {got}")]
    Shape {
        /// The buffer.
        what: &'static str,
        /// The expected length.
        expected: String,
        /// The length found.
        got: String,
    },
    /// A number is NaN or infinite.
    #[error("splats {what}: expected finite numbers, got {got} at splat {splat}")]
    NotFinite {
        /// The buffer.
        what: &'static str,
        /// Index of the first such splat. For SH coefficients it is the parent's first child.
        splat: usize,
        /// The number found.
        got: String,
    },
}

/// Floats per task of a parallel check.
const CHECK_CHUNK: usize = 1 << 16;

/// Returns the index of the first number that is NaN or infinite.
fn first_not_finite(values: &[f32]) -> Option<usize> {
    let in_chunk = |(c, chunk): (usize, &[f32])| {
        // The maximum of integers has a SIMD form, a search that stops early has none.
        let magnitude = |v: &f32| v.to_bits() & !(1 << 31);
        let largest = chunk.iter().map(magnitude).fold(0, u32::max);
        if largest < f32::INFINITY.to_bits() {
            return None;
        }
        chunk.iter().position(|v| !v.is_finite()).map(|i| c * CHECK_CHUNK + i)
    };
    values.par_chunks(CHECK_CHUNK).enumerate().find_map_first(in_chunk)
}

/// A set of Gaussians in the world frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Splats {
    /// `[N, 11]`: mean 3, quaternion wxyz 4 (of any length but zero), σ 3, opacity 1; offsets
    /// in [`subsplat_kernels::layout`].
    pub(crate) rows: Vec<f32>,
    /// `[P, D, 3]`: SH coefficients per parent, D = (degree + 1)², RGB innermost. Splat `i`
    /// uses set `i / K`, K = N / P.
    pub(crate) sh: Vec<f32>,
    /// `[N]`, `[N, 4]` or empty: colour = max(0, ½ + γ·Σ_j sh_j Y_j + δ). Four numbers are γ
    /// and the residual δ (RGB); one number is γ alone; empty means γ = 1, δ = 0.
    pub(crate) gain: Vec<f32>,
    /// Highest SH degree, 0 to 4.
    pub(crate) sh_degree: usize,
    /// Basis functions of `sh`.
    pub(crate) sh_basis: ShBasis,
}

/// The buffers of [`Splats`], not checked: what [`Splats::into_parts`] returns and
/// [`Splats::try_from`] accepts.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatParts {
    /// Rows, as [`Splats::rows`].
    pub rows: Vec<f32>,
    /// SH coefficients, as [`Splats::sh`].
    pub sh: Vec<f32>,
    /// Gains, as [`Splats::gain`].
    pub gain: Vec<f32>,
    /// Highest SH degree, 0 to 4.
    pub sh_degree: usize,
    /// Basis functions of `sh`.
    pub sh_basis: ShBasis,
}

impl TryFrom<SplatParts> for Splats {
    type Error = SplatsError;

    fn try_from(parts: SplatParts) -> Result<Self, SplatsError> {
        let new = Self::with_unchecked_numbers(parts)?;
        let check = |what, values: &[f32], floats_per_set: usize, splats_per_set: usize| {
            let Some(at) = first_not_finite(values) else { return Ok(()) };
            let splat = at / floats_per_set * splats_per_set;
            Err(SplatsError::NotFinite { what, splat, got: values[at].to_string() })
        };
        check("rows", &new.rows, SPLAT_STRIDE, 1)?;
        check("SH coefficients", &new.sh, 3 * new.sh_coefficients(), new.children_per_parent())?;
        check("gain", &new.gain, new.gain_channels().max(1), 1)?;
        Ok(new)
    }
}

impl Splats {
    /// Returns the buffers, to change them; [`Splats::try_from`] checks them again.
    pub fn into_parts(self) -> SplatParts {
        let Self { rows, sh, gain, sh_degree, sh_basis } = self;
        SplatParts { rows, sh, gain, sh_degree, sh_basis }
    }

    /// Checks that the lengths of the three buffers match and that their numbers are finite.
    ///
    /// Other properties are not checked. The rasterizer drops splats with a quaternion of zero
    /// or an opacity below 1/255, ignores the sign of σ, and limits alpha where the opacity
    /// exceeds 1. The file writers refuse opacities outside [0, 1], replace a σ below 1e-12 by
    /// 1e-12 and write the identity for a quaternion of zero.
    ///
    /// # Errors
    /// [`SplatsError`] names the buffer.
    pub fn new(
        rows: Vec<f32>,
        sh: Vec<f32>,
        gain: Vec<f32>,
        sh_degree: usize,
        sh_basis: ShBasis,
    ) -> Result<Self, SplatsError> {
        Self::try_from(SplatParts { rows, sh, gain, sh_degree, sh_basis })
    }

    /// Checks the lengths of the buffers only, for numbers that are checked elsewhere: the errors
    /// of the file readers name the file. The rasterizer drops Gaussians whose numbers are not
    /// finite.
    ///
    /// # Errors
    /// [`SplatsError::Shape`] names the buffer.
    pub fn with_unchecked_numbers(parts: SplatParts) -> Result<Self, SplatsError> {
        let SplatParts { rows, sh, gain, sh_degree, sh_basis } = parts;
        let shape = |what, expected: String, got: usize| {
            Err(SplatsError::Shape { what, expected, got: got.to_string() })
        };
        if sh_degree > SH_DEGREE_MAX {
            return shape("SH degree", format!("0 to {SH_DEGREE_MAX}"), sh_degree);
        }
        if !rows.len().is_multiple_of(SPLAT_STRIDE) {
            return shape("rows", format!("a multiple of {SPLAT_STRIDE} floats"), rows.len());
        }
        let n = rows.len() / SPLAT_STRIDE;
        let set = 3 * (sh_degree + 1) * (sh_degree + 1);
        let p = sh.len() / set;
        if !sh.len().is_multiple_of(set) || (n == 0) != (p == 0) || (p > 0 && !n.is_multiple_of(p))
        {
            let expected = format!("{set} floats for each of P parents, P dividing {n} splats");
            return shape("SH coefficients", expected, sh.len());
        }
        if !(gain.is_empty() || gain.len() == n || gain.len() == 4 * n) {
            return shape("gain", format!("0, {n} or {} floats", 4 * n), gain.len());
        }
        Ok(Self { rows, sh, gain, sh_degree, sh_basis })
    }

    /// Returns the splats of `indices`, each with an SH set of its own.
    pub fn selected(&self, indices: &[usize]) -> Self {
        let channels = self.gain_channels();
        let mut chosen = Self { rows: Vec::new(), sh: Vec::new(), gain: Vec::new(), ..*self };
        for &i in indices {
            chosen.rows.extend_from_slice(self.row(i));
            chosen.sh.extend_from_slice(self.sh_of(i));
            chosen.gain.extend_from_slice(&self.gain[i * channels..(i + 1) * channels]);
        }
        chosen
    }

    /// Returns the packed rows `[N, 11]`: mean 3, quaternion wxyz 4, σ 3, opacity 1.
    pub fn rows(&self) -> &[f32] {
        &self.rows
    }

    /// Returns the SH coefficients of all parents, `[P, D, 3]`.
    pub fn sh(&self) -> &[f32] {
        &self.sh
    }

    /// Returns the gains, `[N]`, `[N, 4]` or empty.
    pub fn gain(&self) -> &[f32] {
        &self.gain
    }

    /// Returns the highest SH degree, 0 to 4.
    pub fn sh_degree(&self) -> usize {
        self.sh_degree
    }

    /// Returns the basis functions of the SH coefficients.
    pub fn sh_basis(&self) -> ShBasis {
        self.sh_basis
    }

    /// Returns N, the number of Gaussians.
    pub fn len(&self) -> usize {
        self.rows.len() / SPLAT_STRIDE
    }

    /// Reports whether there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns D, the SH coefficients per colour channel.
    pub fn sh_coefficients(&self) -> usize {
        (self.sh_degree + 1) * (self.sh_degree + 1)
    }

    /// Returns P, the number of SH sets.
    pub fn parents(&self) -> usize {
        self.sh.len() / (3 * self.sh_coefficients())
    }

    /// Returns K = N / P, the children per parent (1 for an empty set).
    pub fn children_per_parent(&self) -> usize {
        self.len().checked_div(self.parents()).unwrap_or(1)
    }

    /// Returns the floats of `gain` per splat: 0, 1 or 4.
    pub fn gain_channels(&self) -> usize {
        self.gain.len().checked_div(self.len()).unwrap_or(0)
    }

    /// Returns the row of splat `i`, `[11]`.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.rows[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE]
    }

    /// Returns the mean of splat `i`, world.
    pub fn mean(&self, i: usize) -> [f32; 3] {
        let r = self.row(i);
        [r[MEAN_OFFSET], r[MEAN_OFFSET + 1], r[MEAN_OFFSET + 2]]
    }

    /// Returns the means of all splats, world.
    pub fn means(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        (0..self.len()).map(|i| self.mean(i))
    }

    /// Returns the quaternion of splat `i`, wxyz, as stored.
    pub fn quat_wxyz(&self, i: usize) -> [f32; 4] {
        let r = self.row(i);
        [r[QUAT_OFFSET], r[QUAT_OFFSET + 1], r[QUAT_OFFSET + 2], r[QUAT_OFFSET + 3]]
    }

    /// Returns σ of splat `i`, world units.
    pub fn scale(&self, i: usize) -> [f32; 3] {
        let r = self.row(i);
        [r[SCALE_OFFSET], r[SCALE_OFFSET + 1], r[SCALE_OFFSET + 2]]
    }

    /// Returns the opacity of splat `i`.
    pub fn opacity(&self, i: usize) -> f32 {
        self.row(i)[OPACITY_OFFSET]
    }

    /// Returns the SH set of splat `i`'s parent, `[D, 3]`.
    pub fn sh_of(&self, i: usize) -> &[f32] {
        let set = 3 * self.sh_coefficients();
        let p = i / self.children_per_parent();
        &self.sh[p * set..(p + 1) * set]
    }

    /// Returns γ and δ of splat `i`.
    pub fn gain_of(&self, i: usize) -> (f32, [f32; 3]) {
        match self.gain_channels() {
            0 => (1.0, [0.0; 3]),
            1 => (self.gain[i], [0.0; 3]),
            _ => {
                let g = &self.gain[4 * i..4 * i + 4];
                (g[0], [g[1], g[2], g[3]])
            }
        }
    }
}
