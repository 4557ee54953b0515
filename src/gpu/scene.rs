//! Splats in device memory, cut where one binding does not hold them.

use crate::abi::{FOOTPRINT_STRIDE, Geometry, SPLAT_STRIDE, SplatSlices, sh_coefficients};
use crate::gpu::buffers::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;

/// Floats of a row with covariance: mean 3, covariance 6, opacity 1.
pub(crate) const COV6_LANES: usize = 10;

/// Splats in device memory, drawn from any number of cameras.
#[derive(Clone, Debug)]
pub struct Scene {
    pub(crate) parts: Vec<Part>,
    pub(crate) len: usize,
    pub(crate) children: usize,
    /// Floats of a row.
    pub(crate) stride: usize,
    pub(crate) sh_degree: usize,
    pub(crate) gain_lanes: usize,
}

/// Splats `first..first + count` with their parents.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) rows: Buffer,
    pub(crate) sh: Buffer,
    pub(crate) gain: Buffer,
}

impl Scene {
    /// N.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Floats of a parent's SH set.
    pub(crate) fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.sh_degree)
    }
}

impl Gpu {
    /// Copies splats to the device.
    ///
    /// # Errors
    /// Lengths that do not fit one another; out of memory.
    pub fn upload_splats(&self, splats: &SplatSlices) -> Result<Scene, GpuError> {
        let n = splats.len();
        if !splats.is_consistent() {
            return Err(GpuError::Argument {
                kernel: "project",
                what: "splats",
                expected: format!("sh and gain that fit {n} splats"),
                got: format!("{} and {} numbers", splats.sh.len(), splats.gain.len()),
            });
        }
        let packed;
        let (rows, stride) = match splats.geometry {
            Geometry::Packed(rows) => (rows, SPLAT_STRIDE),
            Geometry::Cov6 { means, cov6, opacities } => {
                packed = rows_of_covariances(means, cov6, opacities);
                (&packed[..], COV6_LANES)
            }
        };
        let children = splats.children_per_parent();
        let sh_stride = 3 * sh_coefficients(splats.sh_degree);
        let gain_lanes = splats.gain.len().checked_div(n).unwrap_or(0);
        // A part's footprints fit a binding too (src/gpu/layers.rs).
        let most = [FOOTPRINT_STRIDE * children, sh_stride, gain_lanes * children]
            .into_iter()
            .map(|floats| self.rows_per_binding(floats))
            .min()
            .unwrap_or(1);
        let part = |of: &[f32], from: usize, past: usize, lanes: usize| {
            self.upload("splats", of.get(from * lanes..past * lanes).unwrap_or(&[]))
        };
        let parts = Self::chunks(n.div_ceil(children), most).map(|parents| {
            let (first, past) = (parents.start * children, (parents.end * children).min(n));
            Ok(Part {
                first,
                count: past - first,
                rows: part(rows, first, past, stride)?,
                sh: part(splats.sh, parents.start, parents.end, sh_stride)?,
                gain: part(splats.gain, first, past, gain_lanes)?,
            })
        });
        let parts = parts.collect::<Result<_, GpuError>>()?;
        let sh_degree = splats.sh_degree;
        Ok(Scene { parts, len: n, children, stride, sh_degree, gain_lanes })
    }
}

fn rows_of_covariances(means: &[f32], cov6: &[f32], opacities: &[f32]) -> Vec<f32> {
    let mut rows = Vec::with_capacity(COV6_LANES * opacities.len());
    for ((mean, cov), opacity) in means.chunks_exact(3).zip(cov6.chunks_exact(6)).zip(opacities) {
        rows.extend_from_slice(mean);
        rows.extend_from_slice(cov);
        rows.push(*opacity);
    }
    rows
}
