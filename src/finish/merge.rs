//! Merges of Gaussians by their moments, and the order of points along a curve through space.
//!
//! A merge keeps the moments of its Gaussians and their integrated optical depth. With weights
//! `w = τ·A`, `τ = −ln(1 − α)` and A the footprint of a Gaussian:
//!
//! ```text
//! μ = Σ w μ_i / W,  Σ = Σ w (Σ_i + (μ_i − μ)(μ_i − μ)ᵀ) / W,  SH = Σ w SH_i / W,  τ·A = W
//! ```
//!
//! A is `√((σ₁² + l)(σ₂² + l))`, σ₁ and σ₂ the two largest. The variance l, world units squared, is
//! that of a low-pass of the rasterizer; it is 0 where the size of a pixel is unknown.

use crate::scene::splats::Splats;
use glam::{DMat3, DQuat, DVec3};
use subsplat_kernels::layout::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET};
use subsplat_kernels::sh::C0;

/// Bits of a coordinate on the curve.
pub const CURVE_BITS: u32 = 21;
/// Largest opacity of a merged Gaussian.
const OPACITY_MAX: f64 = 0.9999;
/// Opacity for each unit of a large optical depth: a stack of Gaussians of the opacities of a scene then
/// has the same silhouette.
const DENSE_OPACITY: f64 = 0.35;

/// Mean, covariance and optical depth of a Gaussian.
#[derive(Clone, Copy)]
pub struct Blob {
    /// Centre, world units.
    pub mean: DVec3,
    /// World units squared.
    pub covariance: DMat3,
    /// The two largest σ, the smaller one first.
    pub sigmas: [f64; 2],
    /// Optical depth at the centre.
    pub depth: f64,
}

impl Blob {
    /// Reads a packed row.
    pub fn of(row: &[f32]) -> Self {
        let at = |i: usize| f64::from(row[i]);
        let [w, x, y, z] = [0, 1, 2, 3].map(|i| at(QUAT_OFFSET + i));
        let q = DQuat::from_xyzw(x, y, z, w);
        let q = if q.length_squared() > 0.0 { q.normalize() } else { DQuat::IDENTITY };
        let mut scales = [0, 1, 2].map(|i| at(SCALE_OFFSET + i).abs());
        let axes = DMat3::from_quat(q) * DMat3::from_diagonal(DVec3::from_array(scales));
        scales.sort_by(f64::total_cmp);
        let alpha = at(OPACITY_OFFSET).clamp(0.0, OPACITY_MAX);
        Self {
            mean: DVec3::from_array([0, 1, 2].map(|i| at(MEAN_OFFSET + i))),
            covariance: axes * axes.transpose(),
            sigmas: [scales[1], scales[2]],
            depth: -(-alpha).ln_1p(),
        }
    }

    /// Returns the moments, weighted by the integrated optical depth under a low-pass.
    pub fn moments(&self, lowpass: f64) -> Moments {
        let weight = self.depth * footprint(self.sigmas, lowpass);
        Moments { mean: self.mean, covariance: self.covariance, weight }
    }
}

/// Moments of one or more Gaussians.
#[derive(Clone, Copy)]
pub struct Moments {
    /// Weighted mean, world units.
    pub mean: DVec3,
    /// Weighted covariance about the mean, world units squared.
    pub covariance: DMat3,
    /// W: sum of the integrated optical depths.
    pub weight: f64,
}

impl Moments {
    /// Returns the share of `other` in the weight of both; half where neither has a weight.
    pub fn share_of(&self, other: &Self) -> f64 {
        let sum = self.weight + other.weight;
        if sum > 0.0 { other.weight / sum } else { 0.5 }
    }

    /// Returns the moments of both.
    pub fn joined(&self, other: &Self) -> Self {
        let part = self.share_of(other);
        let mean = self.mean.lerp(other.mean, part);
        let about = |m: &Self| {
            let d = m.mean - mean;
            m.covariance + DMat3::from_cols(d * d.x, d * d.y, d * d.z)
        };
        let covariance = about(self) * (1.0 - part) + about(other) * part;
        Self { mean, covariance, weight: self.weight + other.weight }
    }

    /// Writes the Gaussian of these moments to a packed row, and returns it. Its optical depth,
    /// integrated under the low-pass, is the weight.
    ///
    /// Many opaque Gaussians below the size of a pixel hide more than one Gaussian can. Under a low-pass
    /// the opacity therefore exceeds 1 for a large optical depth: the rasterizer limits alpha.
    pub fn write(&self, lowpass: f64, row: &mut [f32]) -> Blob {
        let matrix = nalgebra::Matrix3::from_column_slice(&self.covariance.to_cols_array());
        let eigen = nalgebra::SymmetricEigen::new(matrix);
        let scales = [0, 1, 2].map(|i| eigen.eigenvalues[i].max(0.0).sqrt());
        let column = |i: usize| {
            let v = eigen.eigenvectors.column(i);
            DVec3::new(v[0], v[1], v[2])
        };
        let (x, y) = (column(0), column(1));
        // The third axis of a rotation; its sign does not change the Gaussian.
        let q = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize();
        let mut sorted = scales;
        sorted.sort_by(f64::total_cmp);
        let area = footprint([sorted[1], sorted[2]], lowpass);
        let depth = self.weight / area.max(f64::MIN_POSITIVE);
        let opacity = if lowpass > 0.0 {
            (-(-depth).exp_m1()).max(DENSE_OPACITY * depth)
        } else {
            (-(-depth).exp_m1()).min(OPACITY_MAX)
        };
        row[MEAN_OFFSET..MEAN_OFFSET + 3].copy_from_slice(&self.mean.to_array().map(|v| v as f32));
        row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|v| v as f32));
        row[SCALE_OFFSET..SCALE_OFFSET + 3].copy_from_slice(&scales.map(|v| v as f32));
        row[OPACITY_OFFSET] = opacity as f32;
        let (mean, covariance) = (self.mean, self.covariance);
        Blob { mean, covariance, sigmas: [sorted[1], sorted[2]], depth }
    }
}

/// Returns A of two σ under a low-pass.
fn footprint([a, b]: [f64; 2], lowpass: f64) -> f64 {
    if lowpass == 0.0 { a * b } else { ((a * a + lowpass) * (b * b + lowpass)).sqrt() }
}

/// Returns the Gaussians of `indices` with SH sets of their own and without gains.
pub fn folded(splats: &Splats, indices: &[usize]) -> Splats {
    let mut own = splats.selected(indices);
    let set = 3 * own.sh_coefficients();
    for i in 0..own.len() {
        let (gamma, delta) = own.gain_of(i);
        let sh = &mut own.sh[i * set..(i + 1) * set];
        sh.iter_mut().for_each(|v| *v *= gamma);
        sh.iter_mut().zip(delta).for_each(|(v, d)| *v += d / C0 as f32);
    }
    own.gain.clear();
    own
}

/// Returns the place on a Morton curve of a point with coordinates from 0 to 2 to the power of
/// [`CURVE_BITS`].
pub fn curve_code(at: DVec3) -> u64 {
    let bits = [at.x, at.y, at.z].map(|v| spread(v as u64));
    bits[0] | bits[1] << 1 | bits[2] << 2
}

/// Puts two zeros between the lowest 21 bits of `v`.
fn spread(v: u64) -> u64 {
    let mut v = v & 0x1F_FFFF;
    v = (v | v << 32) & 0x001F_0000_0000_FFFF;
    v = (v | v << 16) & 0x001F_0000_FF00_00FF;
    v = (v | v << 8) & 0x100F_00F0_0F00_F00F;
    v = (v | v << 4) & 0x10C3_0C30_C30C_30C3;
    (v | v << 2) & 0x1249_2492_4924_9249
}
