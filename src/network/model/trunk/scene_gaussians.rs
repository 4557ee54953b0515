//! Gaussians of one scene as tensors.

use crate::network::model::primaries::Packed;
use crate::scene::splats::Splats;
use candle_core::{Result, Tensor};
use subsplat_kernels::layout::ShBasis;

/// Gaussians of one scene that share SH by parent.
#[derive(Clone, Debug)]
pub struct Children {
    /// `[N·K, 11]`, columns as in [`subsplat_kernels::layout`]; child k of parent n is row n·K + k.
    pub rows: Tensor,
    /// `[N·K]`: gain γ; or `[N·K, 4]`: γ and the residual δ in RGB.
    pub gain: Tensor,
    /// `[N, D, 3]`: the parents' SH, world frame, RGB innermost.
    pub sh: Tensor,
    /// Basis of `sh`.
    pub sh_basis: ShBasis,
    /// K: children per parent.
    pub k: usize,
}

impl Children {
    /// Returns the primaries of one scene as their own children, K = 1: the result of a
    /// trunk with SPGR off.
    ///
    /// # Errors
    /// Those of candle.
    pub fn whole(parents: &Packed) -> Result<Self> {
        let rows = parents.rows().clone();
        Ok(Self {
            gain: Tensor::ones(rows.dim(0)?, rows.dtype(), rows.device())?,
            rows,
            sh: parents.sh()?,
            sh_basis: parents.sh_basis,
            k: 1,
        })
    }

    /// Returns packed rows for the renderer and the file writers.
    ///
    /// # Errors
    /// Tensors are not `f32`, do not fit one another, or hold a number that is not finite.
    pub fn to_splats(&self) -> Result<Splats> {
        Splats::from_tensors(&self.rows, &self.sh, &self.gain, self.sh_basis)
    }
}
