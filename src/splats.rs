//! Gaussians as every room passes them on: packed rows, one SH set per parent,
//! and a colour gain per child.
//!
//! A child stores no SH of its own (SubSplat, Eq. for h_{p,k}: γ_k · h_p), so N
//! children of P parents (N = P·K) cost 12 to 15 floats each instead of 86.

use crate::abi::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SH_DEGREE_MAX, SPLAT_STRIDE, ShBasis,
};
use candle_core::{Device, Tensor};
use thiserror::Error;

/// Why packed splats were refused.
#[derive(Debug, Error, PartialEq)]
pub enum SplatsError {
    /// A buffer's length does not fit the others.
    #[error("splats {what}: expected {expected}, got {got}")]
    Shape {
        /// Which buffer.
        what: &'static str,
        /// What would have fitted.
        expected: String,
        /// What came.
        got: String,
    },
}

/// A set of Gaussians in world frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Splats {
    /// `[N, 11]`: mean 3, quaternion wxyz 4 (not necessarily unit), σ 3, opacity 1;
    /// lanes in [`crate::abi`].
    pub rows: Vec<f32>,
    /// `[P, D, 3]`: SH coefficients per parent, D = (degree + 1)², RGB innermost.
    /// Splat `i` uses set `i / K`, K = N / P.
    pub sh: Vec<f32>,
    /// `[N]` or `[N, 4]`: colour = max(0, ½ + γ·Σ_j sh_j Y_j + δ). Four lanes are
    /// γ and the residual δ (RGB); one lane is γ alone; empty means γ = 1, δ = 0.
    pub gain: Vec<f32>,
    /// Highest degree stored, 0 to 4.
    pub sh_degree: usize,
    /// Functions that `sh` multiplies.
    pub sh_basis: ShBasis,
}

/// [`Splats`] as tensors, for optimisation: gradients reach what they were made of.
#[derive(Clone, Debug)]
pub struct SplatTensors {
    /// `[N, 11]`, as [`Splats::rows`].
    pub rows: Tensor,
    /// `[P, D, 3]`, as [`Splats::sh`].
    pub sh: Tensor,
    /// `[N]` (γ) or `[N, 4]` (γ, δ); none means γ = 1, δ = 0.
    pub gain: Option<Tensor>,
    /// Functions that `sh` multiplies.
    pub sh_basis: ShBasis,
}

impl SplatTensors {
    /// Packs means `[N, 3]`, quaternions wxyz `[N, 4]` (of any length), σ `[N, 3]`,
    /// opacities `[N]` and SH `[P, D, 3]`, P dividing N; no gain.
    ///
    /// # Errors
    /// Tensors that cannot stand side by side.
    pub fn from_parts(
        means: &Tensor,
        quats_wxyz: &Tensor,
        scales: &Tensor,
        opacities: &Tensor,
        sh: &Tensor,
        sh_basis: ShBasis,
    ) -> candle_core::Result<Self> {
        let rows = Tensor::cat(&[means, quats_wxyz, scales, &opacities.unsqueeze(1)?], 1)?;
        Ok(Self { rows, sh: sh.clone(), gain: None, sh_basis })
    }

    /// Copies of `splats` on `device`.
    ///
    /// # Errors
    /// Whatever candle says of the allocation.
    pub fn new(splats: &Splats, device: &Device) -> candle_core::Result<Self> {
        let (rows, sh, gain) = splats.to_tensors(device)?;
        let gain = (splats.gain_lanes() > 0).then_some(gain);
        Ok(Self { rows, sh, gain, sh_basis: splats.sh_basis })
    }
}

impl Splats {
    /// Checks that the three buffers fit one another.
    ///
    /// # Errors
    /// [`SplatsError::Shape`] names the buffer.
    pub fn new(
        rows: Vec<f32>,
        sh: Vec<f32>,
        gain: Vec<f32>,
        sh_degree: usize,
        sh_basis: ShBasis,
    ) -> Result<Self, SplatsError> {
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

    /// Number of Gaussians, N.
    pub fn len(&self) -> usize {
        self.rows.len() / SPLAT_STRIDE
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// SH coefficients per colour channel, D.
    pub fn sh_coefficients(&self) -> usize {
        (self.sh_degree + 1) * (self.sh_degree + 1)
    }

    /// Number of SH sets, P.
    pub fn parents(&self) -> usize {
        self.sh.len() / (3 * self.sh_coefficients())
    }

    /// Children per parent, K = N / P (1 where there is none).
    pub fn children_per_parent(&self) -> usize {
        self.len().checked_div(self.parents()).unwrap_or(1)
    }

    /// Floats of `gain` per splat: 0, 1 or 4.
    pub fn gain_lanes(&self) -> usize {
        self.gain.len().checked_div(self.len()).unwrap_or(0)
    }

    /// Row of splat `i`.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.rows[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE]
    }

    /// Mean of splat `i`, world.
    pub fn mean(&self, i: usize) -> [f32; 3] {
        let r = self.row(i);
        [r[MEAN_OFFSET], r[MEAN_OFFSET + 1], r[MEAN_OFFSET + 2]]
    }

    /// Quaternion of splat `i`, wxyz, as stored.
    pub fn quat_wxyz(&self, i: usize) -> [f32; 4] {
        let r = self.row(i);
        [r[QUAT_OFFSET], r[QUAT_OFFSET + 1], r[QUAT_OFFSET + 2], r[QUAT_OFFSET + 3]]
    }

    /// σ of splat `i`, world units.
    pub fn scale(&self, i: usize) -> [f32; 3] {
        let r = self.row(i);
        [r[SCALE_OFFSET], r[SCALE_OFFSET + 1], r[SCALE_OFFSET + 2]]
    }

    /// Opacity of splat `i`.
    pub fn opacity(&self, i: usize) -> f32 {
        self.row(i)[OPACITY_OFFSET]
    }

    /// SH set of splat `i`, `[D, 3]`: its parent's.
    pub fn sh_of(&self, i: usize) -> &[f32] {
        let set = 3 * self.sh_coefficients();
        let p = i / self.children_per_parent();
        &self.sh[p * set..(p + 1) * set]
    }

    /// γ and δ of splat `i`.
    pub fn gain_of(&self, i: usize) -> (f32, [f32; 3]) {
        match self.gain_lanes() {
            0 => (1.0, [0.0; 3]),
            1 => (self.gain[i], [0.0; 3]),
            _ => {
                let g = &self.gain[4 * i..4 * i + 4];
                (g[0], [g[1], g[2], g[3]])
            }
        }
    }

    /// Three tensors `([N,11], [P,D,3], [N] | [N,4])` on `device`; a missing gain
    /// becomes ones.
    ///
    /// # Errors
    /// Whatever candle says of the allocation.
    pub fn to_tensors(&self, device: &Device) -> candle_core::Result<(Tensor, Tensor, Tensor)> {
        let n = self.len();
        let rows = Tensor::from_slice(&self.rows, (n, SPLAT_STRIDE), device)?;
        let sh = Tensor::from_slice(&self.sh, (self.parents(), self.sh_coefficients(), 3), device)?;
        let gain = match self.gain_lanes() {
            0 => Tensor::ones(n, candle_core::DType::F32, device)?,
            1 => Tensor::from_slice(&self.gain, n, device)?,
            _ => Tensor::from_slice(&self.gain, (n, 4), device)?,
        };
        Ok((rows, sh, gain))
    }

    /// The inverse of [`Splats::to_tensors`].
    ///
    /// # Errors
    /// A tensor of another rank or dtype, or shapes that do not fit one another.
    pub fn from_tensors(
        rows: &Tensor,
        sh: &Tensor,
        gain: &Tensor,
        sh_basis: ShBasis,
    ) -> candle_core::Result<Self> {
        let (_, d, _) = sh.dims3()?;
        let degree = (0..=SH_DEGREE_MAX).find(|l| (l + 1) * (l + 1) == d);
        let Some(degree) = degree else {
            candle_core::bail!("splats SH: expected 1, 4, 9, 16 or 25 coefficients, got {d}")
        };
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        Self::new(flat(rows)?, flat(sh)?, flat(gain)?, degree, sh_basis)
            .map_err(candle_core::Error::wrap)
    }
}
