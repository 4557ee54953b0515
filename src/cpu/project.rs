//! Projection of all splats: geometry to footprints, SH to colour, in parallel over
//! chunks of splats.
//!
//! In: [`SplatSlices`] in world frame. Out: one [`Footprint`] per splat (empty where
//! dropped, see [`crate::cpu::ewa`]) and the number of visible ones per chunk.
//! Colour of child i of parent p: max(0, ½ + γ_i·Σ_k sh_{p,k} Y_k(d) + δ_i)
//! (SubSplat, colour gain; 3DGS for γ = 1, δ = 0).

use crate::abi::{
    LANE_MEAN, LANE_OPACITY, LANE_QUAT, LANE_SCALE, RasterOptions, SPLAT_LANES, ShDirection,
    sh_coefficients,
};
use crate::cpu::ewa::{Footprint, View};
use crate::cpu::sh::{direction, radiance};
use rayon::prelude::*;

/// Splats per unit of parallel work. A constant, so that no result can depend on
/// the number of threads.
pub(crate) const CHUNK: usize = 4096;

/// Where N splats' positions, shapes and opacities lie.
#[derive(Clone, Copy, Debug)]
pub enum Geometry<'a> {
    /// `[N, 11]` rows: mean, quaternion wxyz, σ, opacity (lanes in [`crate::abi`]).
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
}

/// Borrowed splats, as the kernels read them. Lengths must fit one another
/// (checked in debug builds; otherwise missing numbers read as neutral ones).
#[derive(Clone, Copy, Debug)]
pub struct SplatSlices<'a> {
    /// Positions, shapes and opacities of N splats.
    pub geometry: Geometry<'a>,
    /// `[P, D, 3]` with D = (`sh_degree` + 1)²; splat i reads set i / (N / P).
    pub sh: &'a [f32],
    /// `[]` (γ = 1, δ = 0), `[N]` (γ) or `[N, 4]` (γ, δ RGB).
    pub gain: &'a [f32],
    /// Degree that `sh` stores.
    pub sh_degree: usize,
}

impl SplatSlices<'_> {
    /// N.
    pub fn len(&self) -> usize {
        match self.geometry {
            Geometry::Packed(rows) => rows.len() / SPLAT_LANES,
            Geometry::Cov6 { means, cov6, opacities } => {
                (means.len() / 3).min(cov6.len() / 6).min(opacities.len())
            }
        }
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// P.
    pub fn parents(&self) -> usize {
        self.sh.len() / (3 * sh_coefficients(self.sh_degree))
    }

    /// K = N / P.
    pub fn children_per_parent(&self) -> usize {
        self.len().div_ceil(self.parents().max(1)).max(1)
    }

    /// Whether all lengths fit one another.
    pub fn is_consistent(&self) -> bool {
        let n = self.len();
        let geometry = match self.geometry {
            Geometry::Packed(rows) => rows.len() == n * SPLAT_LANES,
            Geometry::Cov6 { means, cov6, opacities } => {
                means.len() == 3 * n && cov6.len() == 6 * n && opacities.len() == n
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
            Geometry::Packed(rows) => lanes(rows, i * SPLAT_LANES + LANE_MEAN),
            Geometry::Cov6 { means, .. } => lanes(means, 3 * i),
        }
    }

    pub(crate) fn sh_of_parent(&self, p: usize) -> &[f32] {
        let set = 3 * sh_coefficients(self.sh_degree);
        self.sh.get(p * set..(p + 1) * set).unwrap_or(&[])
    }

    pub(crate) fn gain_of(&self, i: usize) -> (f32, [f32; 3]) {
        if self.gain.len() == 4 * self.len() && !self.gain.is_empty() {
            let [gain, residual @ ..]: [f32; 4] = lanes(self.gain, 4 * i);
            (gain, residual)
        } else {
            (self.gain.get(i).copied().unwrap_or(1.0), [0.0; 3])
        }
    }

    fn footprint(&self, view: &View, i: usize) -> Option<Footprint> {
        match self.geometry {
            Geometry::Packed(rows) => {
                let row = &rows[i * SPLAT_LANES..(i + 1) * SPLAT_LANES];
                let (quat, scale) = (lanes(row, LANE_QUAT), lanes(row, LANE_SCALE));
                view.project_quat(self.mean(i), quat, scale, row[LANE_OPACITY])
            }
            Geometry::Cov6 { cov6, opacities, .. } => {
                view.project_cov6(self.mean(i), lanes(cov6, 6 * i), opacities[i])
            }
        }
    }
}

/// `L` floats from `at` on; zeros where the slice ends before.
pub(crate) fn lanes<const L: usize>(from: &[f32], at: usize) -> [f32; L] {
    from.get(at..at + L).and_then(|s| s.try_into().ok()).unwrap_or([0.0; L])
}

/// Footprints of a frame, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Projection {
    /// `[N]`.
    pub(crate) footprints: Vec<Footprint>,
    /// Visible splats of each [`CHUNK`].
    pub(crate) visible: Vec<usize>,
    /// `[P]`: Σ sh·Y at each parent's direction ([`ShDirection::Parent`] only).
    parents: Vec<[f32; 3]>,
}

impl Projection {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        self.footprints.capacity() * size_of::<Footprint>()
            + self.visible.capacity() * size_of::<usize>()
            + self.parents.capacity() * size_of::<[f32; 3]>()
    }

    /// Σ sh·Y of each parent; stale unless directions are the parents'.
    pub(crate) fn parents(&self) -> &[[f32; 3]] {
        &self.parents
    }

    /// Projects all splats.
    pub(crate) fn run(&mut self, splats: &SplatSlices, view: &View, options: &RasterOptions) {
        let degree = options.sh_degree.min(splats.sh_degree);
        let shared = options.sh_direction == ShDirection::Parent;
        if shared {
            self.parent_radiance(splats, view, options);
        }
        let children = splats.children_per_parent();
        self.footprints.resize(splats.len(), Footprint::default());
        self.visible.resize(splats.len().div_ceil(CHUNK), 0);
        let parents = &self.parents;
        let one = |i: usize| -> Footprint {
            let Some(mut f) = splats.footprint(view, i) else { return Footprint::default() };
            let p = i / children;
            let sum = if shared {
                parents[p]
            } else {
                let d = direction(minus(splats.mean(i), view.eye));
                radiance(options.sh_basis, degree, d, splats.sh_of_parent(p))
            };
            let (gain, residual) = splats.gain_of(i);
            let rgb: [f32; 3] = std::array::from_fn(|c| 0.5 + gain * sum[c] + residual[c]);
            if !rgb.iter().all(|v| v.is_finite()) {
                return Footprint::default();
            }
            f.rgb = rgb.map(|v| v.max(0.0));
            f
        };
        let chunks = self.footprints.par_chunks_mut(CHUNK).zip(&mut self.visible);
        chunks.enumerate().for_each(|(c, (chunk, visible))| {
            *visible = 0;
            for (j, f) in chunk.iter_mut().enumerate() {
                *f = one(c * CHUNK + j);
                *visible += usize::from(f.visible());
            }
        });
    }

    /// Σ sh·Y of every parent, seen along the mean of its children's means (those
    /// that are finite).
    fn parent_radiance(&mut self, splats: &SplatSlices, view: &View, options: &RasterOptions) {
        let degree = options.sh_degree.min(splats.sh_degree);
        let (children, n) = (splats.children_per_parent(), splats.len());
        self.parents.resize(splats.parents().max(n.div_ceil(children)), [0.0; 3]);
        self.parents.par_iter_mut().with_min_len(CHUNK / 16).enumerate().for_each(|(p, out)| {
            let (mut sum, mut count) = ([0.0f32; 3], 0.0f32);
            for i in p * children..((p + 1) * children).min(n) {
                let d = minus(splats.mean(i), view.eye);
                if d.iter().all(|v| v.is_finite()) {
                    sum = [sum[0] + d[0], sum[1] + d[1], sum[2] + d[2]];
                    count += 1.0;
                }
            }
            let d = direction(sum.map(|v| v / count.max(1.0)));
            *out = radiance(options.sh_basis, degree, d, splats.sh_of_parent(p));
        });
    }
}

pub(crate) fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}
