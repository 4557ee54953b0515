//! Splats in device memory, divided into parts where one binding is too small.

use crate::gpu::array::Array;
use crate::gpu::buffers::Binding;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::FOOTPRINT_STRIDE;
use crate::layout::{Geometry, SH_DEGREE_MAX, SPLAT_STRIDE, SplatSlices, sh_coefficients};

/// Floats of a row with a covariance: mean 3, covariance 6, opacity 1.
pub(crate) const COV6_STRIDE: usize = 10;

/// Splats in device memory, for rendering from any number of cameras.
#[derive(Clone, Debug)]
pub struct Scene {
    pub(crate) parts: Vec<Part>,
    pub(crate) len: usize,
    pub(crate) children: usize,
    /// Floats per row.
    pub(crate) stride: usize,
    pub(crate) sh_degree: usize,
    /// Floats of a splat's gain: 0, 1 or 4.
    pub(crate) gain_stride: usize,
}

/// Splats `first..first + count` and their parents.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) rows: Binding,
    pub(crate) sh: Binding,
    pub(crate) gain: Binding,
}

/// Consecutive splats that an operation left in device memory, and their parents' SH.
#[derive(Clone, Copy, Debug)]
pub struct SceneArrays<'a> {
    /// `[n·K, 11]`.
    pub rows: &'a Array,
    /// `[n, D, 3]`.
    pub sh: &'a Array,
    /// `[n·K]` or `[n·K, 4]`; `None` for gains of 1.
    pub gain: Option<&'a Array>,
}

impl SceneArrays<'_> {
    /// Floats of a gain, and D.
    fn layout(&self) -> (usize, usize) {
        let count = self.rows.dims().first().copied().unwrap_or(0).max(1);
        let gain = self.gain.map_or(0, |gain| gain.count() / count);
        (gain, self.sh.dims().get(1).copied().unwrap_or(0))
    }
}

impl Scene {
    /// Returns the scene of arrays in device memory, part by part, without a copy; `children` is K.
    /// The recorder of the arrays must be flushed before a frame is drawn.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for dimensions that do not fit; [`GpuError::TooSmall`] for a part with
    /// more footprints than a binding holds.
    pub fn from_arrays(parts: &[SceneArrays], children: usize) -> Result<Self, GpuError> {
        let misfit = |argument, expected: String, got: String| {
            Err(GpuError::Argument { kernel: "project", argument, expected, got })
        };
        let of = |part: Option<&SceneArrays>| part.map_or((0, 0), |part| part.layout());
        let (gain_stride, d) = of(parts.first());
        let Some(sh_degree) = (0..=SH_DEGREE_MAX).find(|l| sh_coefficients(*l) == d) else {
            return misfit("sh", "1, 4, 9, 16 or 25 functions".to_owned(), d.to_string());
        };
        let mut first = 0;
        let mut own = Vec::with_capacity(parts.len());
        for part in parts {
            let (rows, sh) = (part.rows.dims(), part.sh.dims());
            let count = rows.first().copied().unwrap_or(0);
            let fits = rows == [count, SPLAT_STRIDE]
                && sh == [count / children.max(1), d, 3]
                && count.is_multiple_of(children.max(1))
                && part.gain.is_none_or(|gain| gain.count() == count * gain_stride)
                && part.layout() == (gain_stride, d);
            if !fits {
                let expected = format!("rows [n·{children}, 11], sh [n, {d}, 3] and gains");
                return misfit("splats", expected, format!("{rows:?}, {sh:?}"));
            }
            let limit = part.rows.recorder().gpu().rows_per_binding(FOOTPRINT_STRIDE);
            if count > limit {
                let (needed, limit) = (count as u64, limit as u64);
                let resource = "splats of a part";
                return Err(GpuError::TooSmall { resource, needed, limit });
            }
            let (rows, sh) = (part.rows.binding(), part.sh.binding());
            // Without gains the kernel reads none.
            let gain = part.gain.unwrap_or(part.rows);
            let gain = if gain_stride == 0 { gain.first_binding() } else { gain.binding() };
            own.push(Part { first, count, rows, sh, gain });
            first += count;
        }
        let stride = SPLAT_STRIDE;
        Ok(Self { parts: own, len: first, children, stride, sh_degree, gain_stride })
    }

    /// Returns the number of splats N.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether N is 0.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns the floats of a parent's SH set.
    pub(crate) fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.sh_degree)
    }
}

impl Gpu {
    /// Copies splats to the device.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths and for [`Geometry::Separate`], which the CPU alone
    /// reads; [`GpuError::OutOfMemory`].
    pub fn upload_splats(&self, splats: &SplatSlices) -> Result<Scene, GpuError> {
        let n = splats.len();
        if !splats.is_consistent() {
            return Err(GpuError::Argument {
                kernel: "project",
                argument: "splats",
                expected: format!("sh and gain for {n} splats"),
                got: format!("{} and {} numbers", splats.sh.len(), splats.gain.len()),
            });
        }
        let joined_rows;
        let (rows, stride) = match splats.geometry {
            Geometry::Packed(rows) => (rows, SPLAT_STRIDE),
            Geometry::Cov6 { means, cov6, opacities } => {
                joined_rows = covariance_rows(means, cov6, opacities);
                (&joined_rows[..], COV6_STRIDE)
            }
            Geometry::Separate { .. } => {
                return Err(GpuError::Argument {
                    kernel: "project",
                    argument: "splats",
                    expected: "packed rows or covariances".to_owned(),
                    got: "separate arrays".to_owned(),
                });
            }
        };
        let children = splats.children_per_parent();
        let sh_stride = 3 * sh_coefficients(splats.sh_degree);
        let gain_stride = splats.gain.len().checked_div(n).unwrap_or(0);
        // The footprints of a part fit a binding, too (gpu/raster/layers.rs).
        let max_parents = [FOOTPRINT_STRIDE * children, sh_stride, gain_stride * children]
            .into_iter()
            .map(|floats| self.rows_per_binding(floats))
            .min()
            .unwrap_or(1);
        let part = |of: &[f32], from: usize, past: usize, stride: usize| {
            let own = of.get(from * stride..past * stride).unwrap_or(&[]);
            Ok::<_, GpuError>(Binding::from(&self.upload("splats", own)?))
        };
        let parts = Self::chunks(n.div_ceil(children), max_parents).map(|parents| {
            let first = parents.start * children;
            let past = (parents.end * children).min(n);
            Ok(Part {
                first,
                count: past - first,
                rows: part(rows, first, past, stride)?,
                sh: part(splats.sh, parents.start, parents.end, sh_stride)?,
                gain: part(splats.gain, first, past, gain_stride)?,
            })
        });
        let parts = parts.collect::<Result<_, GpuError>>()?;
        let sh_degree = splats.sh_degree;
        Ok(Scene { parts, len: n, children, stride, sh_degree, gain_stride })
    }
}

fn covariance_rows(means: &[f32], cov6: &[f32], opacities: &[f32]) -> Vec<f32> {
    let mut rows = Vec::with_capacity(COV6_STRIDE * opacities.len());
    for ((mean, cov), opacity) in means.chunks_exact(3).zip(cov6.chunks_exact(6)).zip(opacities) {
        rows.extend_from_slice(mean);
        rows.extend_from_slice(cov);
        rows.push(*opacity);
    }
    rows
}
