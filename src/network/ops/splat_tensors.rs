//! [`Splats`] as candle tensors, and back.

use crate::scene::splats::Splats;
use candle_core::{Device, Tensor};
use subsplat_kernels::layout::{SH_DEGREE_MAX, SPLAT_STRIDE, ShBasis};

/// [`Splats`] as tensors, for optimisation: gradients flow to the tensors' inputs.
#[derive(Clone, Debug)]
pub struct SplatTensors {
    /// `[N, 11]`, as [`Splats::rows`].
    pub rows: Tensor,
    /// `[P, D, 3]`, as [`Splats::sh`].
    pub sh: Tensor,
    /// `[N]` (γ) or `[N, 4]` (γ, δ); none means γ = 1, δ = 0.
    pub gain: Option<Tensor>,
    /// Basis functions of `sh`.
    pub sh_basis: ShBasis,
}

impl SplatTensors {
    /// Packs means `[N, 3]`, quaternions wxyz `[N, 4]` (of any length but zero), σ `[N, 3]`,
    /// opacities `[N]` and SH `[P, D, 3]` without a gain. P divides N.
    ///
    /// # Errors
    /// Shapes, dtypes or devices that do not match.
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

    /// Copies `splats` to `device`.
    ///
    /// # Errors
    /// Errors of candle's allocation.
    pub fn new(splats: &Splats, device: &Device) -> candle_core::Result<Self> {
        let (rows, sh, gain) = splats.to_tensors(device)?;
        let gain = (splats.gain_channels() > 0).then_some(gain);
        Ok(Self { rows, sh, gain, sh_basis: splats.sh_basis })
    }
}

impl Splats {
    /// Copies the buffers to tensors `([N,11], [P,D,3], [N] | [N,4])` on `device`. An empty
    /// gain becomes ones.
    ///
    /// # Errors
    /// Errors of candle's allocation.
    pub fn to_tensors(&self, device: &Device) -> candle_core::Result<(Tensor, Tensor, Tensor)> {
        let n = self.len();
        let rows = Tensor::from_slice(&self.rows, (n, SPLAT_STRIDE), device)?;
        let sh = Tensor::from_slice(&self.sh, (self.parents(), self.sh_coefficients(), 3), device)?;
        let gain = match self.gain_channels() {
            0 => Tensor::ones(n, candle_core::DType::F32, device)?,
            1 => Tensor::from_slice(&self.gain, n, device)?,
            _ => Tensor::from_slice(&self.gain, (n, 4), device)?,
        };
        Ok((rows, sh, gain))
    }

    /// Copies tensors of [`Splats::to_tensors`]'s shapes back.
    ///
    /// # Errors
    /// A tensor of another rank or dtype, shapes that do not match, or a number that is not
    /// finite.
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
