//! Real spherical harmonics: the two bases of [`ShBasis`], exact rotation up to degree 4, and
//! the change from MVSplat's basis to the standard one.
//!
//! Standard basis (3DGS): index l² + l + m, Condon-Shortley sign, so that l = 1 is
//! C₁·(−y, z, −x). MVSplat rotates in e3nn's basis: the standard functions at (z, x, y)
//! without that sign, so that l = 1 is C₁·(x, y, z).
//!
//! All numbers are `f64`: the functions run once per camera, not per Gaussian.
//!
//! The basis belongs to the coefficients (`Splats`), the convention of the rasterizer to the render call.

use crate::layout::ShBasis;
use glam::{DMat3, DVec3};

/// C₀ = √(1/4π), the constant function: colour = ½ + C₀·h₀ for degree 0.
pub const C0: f64 = 0.282_094_791_773_878_14;

/// Evaluates the standard basis functions of degree ≤ 4 at the unit vector `d`.
pub fn standard(d: DVec3) -> [f64; 25] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    [
        C0,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * xy,
        -1.092_548_430_592_079_2 * yz,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * xz,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * xy * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
        2.503_342_941_796_704_5 * xy * (xx - yy),
        -1.770_130_769_779_930_4 * yz * (3.0 * xx - yy),
        0.946_174_695_757_560_1 * xy * (7.0 * zz - 1.0),
        -0.669_046_543_557_289_2 * yz * (7.0 * zz - 3.0),
        0.105_785_546_915_204_31 * (zz * (35.0 * zz - 30.0) + 3.0),
        -0.669_046_543_557_289_2 * xz * (7.0 * zz - 3.0),
        0.473_087_347_878_780_05 * (xx - yy) * (7.0 * zz - 1.0),
        -1.770_130_769_779_930_4 * xz * (xx - 3.0 * yy),
        0.625_835_735_449_176_1 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ]
}

/// Evaluates the 16 functions of [`ShBasis::Mvsplat`] at the unit vector `d`.
pub fn mvsplat(d: DVec3) -> [f64; 16] {
    let y = standard(DVec3::new(d.z, d.x, d.y));
    let mut out = [0.0; 16];
    out.copy_from_slice(&y[..16]);
    out[14] = 1.445_305_721_320_277 * d.z * (d.z * d.z - d.x * d.x);
    out
}

/// Evaluates e3nn's functions of degree ≤ 4 at `d` with the standard basis' normalisation:
/// [`standard`] at (z, x, y) without the Condon-Shortley sign.
pub fn e3nn(d: DVec3) -> [f64; 25] {
    let mut y = standard(DVec3::new(d.z, d.x, d.y));
    for (l, m, i) in degrees() {
        if (l + m) % 2 == 1 {
            y[i] = -y[i];
        }
    }
    y
}

/// Lists (l, m + l, index) of all coefficients of degree ≤ 4.
fn degrees() -> impl Iterator<Item = (usize, usize, usize)> {
    (0..=4usize).flat_map(|l| (0..=2 * l).map(move |m| (l, m, l * l + m)))
}

/// The basis of a [`Rotation`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RotationBasis {
    /// [`standard`].
    Standard,
    /// [`e3nn`].
    E3nn,
}

/// Block-diagonal matrix D(R) with Y(R d) = D(R)·Y(d): a function with coefficients h,
/// rotated by R, has coefficients D(R)·h.
#[derive(Clone, Debug)]
pub struct Rotation {
    /// Row-major (2l + 1)² blocks of degrees 0 to 4.
    blocks: [Vec<f64>; 5],
}

impl Rotation {
    /// Computes D of the proper rotation `r`, exact to rounding.
    pub fn new(r: DMat3, basis: RotationBasis) -> Self {
        let eval = match basis {
            RotationBasis::Standard => standard,
            RotationBasis::E3nn => e3nn,
        };
        let block = |l: usize| {
            let n = 2 * l + 1;
            let columns = |f: &dyn Fn(DVec3) -> [f64; 25]| -> Vec<f64> {
                let mut m = vec![0.0; n * n];
                for (j, d) in directions(n).into_iter().enumerate() {
                    let y = f(d);
                    for i in 0..n {
                        m[i * n + j] = y[l * l + i];
                    }
                }
                m
            };
            // D·Y = Y_R  ⇔  Yᵀ·Dᵀ = Y_Rᵀ; the columns are fixed directions in general position.
            let y = transpose(&columns(&eval), n);
            let turned = transpose(&columns(&|d| eval(r * d)), n);
            transpose(&solve(y, turned, n, n), n)
        };
        Self { blocks: std::array::from_fn(block) }
    }

    /// Returns the row-major (2l + 1) × (2l + 1) block of degree `l` ≤ 4.
    pub fn block(&self, l: usize) -> &[f64] {
        &self.blocks[l]
    }

    /// Returns the whole (degree + 1)² square matrix, row-major.
    pub fn matrix(&self, degree: usize) -> Vec<f64> {
        let d = (degree + 1) * (degree + 1);
        let mut m = vec![0.0; d * d];
        for l in 0..=degree {
            let n = 2 * l + 1;
            for i in 0..n {
                for j in 0..n {
                    m[(l * l + i) * d + l * l + j] = self.blocks[l][i * n + j];
                }
            }
        }
        m
    }
}

/// Computes the row-major 16×16 matrix M from coefficients of [`ShBasis::Mvsplat`] to those
/// of [`ShBasis::Standard`] of the same function: Σ (M h)_i Y_i = Σ h_j Ỹ_j. The map is
/// exact: MVSplat's function 14 is a cubic polynomial, hence of degree ≤ 3.
pub fn standard_from_mvsplat() -> Vec<f64> {
    const N: usize = 16;
    // Normal equations with more directions than coefficients; the residual is zero.
    let mut gram = vec![0.0; N * N];
    let mut rhs = vec![0.0; N * N];
    for d in directions(96) {
        let (s, m) = (standard(d), mvsplat(d));
        for i in 0..N {
            for j in 0..N {
                gram[i * N + j] += s[i] * s[j];
                rhs[i * N + j] += s[i] * m[j];
            }
        }
    }
    let mut m = solve(gram, rhs, N, N);
    for v in &mut m {
        if v.abs() < 1e-12 {
            *v = 0.0;
        }
    }
    m
}

/// Converts the coefficients `sets[P, D, 3]` from `basis` to the standard one, in place.
/// Coefficients 16 and up of [`ShBasis::Mvsplat`] become zero.
pub fn all_to_standard(sets: &mut [f32], coefficients: usize, basis: ShBasis) {
    if basis == ShBasis::Mvsplat {
        let m = standard_from_mvsplat();
        for set in sets.chunks_exact_mut(3 * coefficients) {
            apply_mvsplat_map(set, &m);
        }
    }
}

fn apply_mvsplat_map(sh: &mut [f32], m: &[f64]) {
    let d = sh.len() / 3;
    let used = d.min(16);
    let mut out = [[0.0f64; 3]; 16];
    for (i, row) in out.iter_mut().enumerate().take(used) {
        for j in 0..used {
            for (c, v) in row.iter_mut().enumerate() {
                *v += m[i * 16 + j] * f64::from(sh[3 * j + c]);
            }
        }
    }
    sh.fill(0.0);
    for (i, row) in out.iter().enumerate().take(used) {
        for (c, v) in row.iter().enumerate() {
            sh[3 * i + c] = *v as f32;
        }
    }
}

/// Returns `n` directions on the sphere in general position: a golden-angle spiral, tilted
/// so that it shares no symmetry with a basis function.
fn directions(n: usize) -> Vec<DVec3> {
    let tilt = DMat3::from_euler(glam::EulerRot::XYZ, 0.4, 1.1, 2.3);
    (0..n)
        .map(|i| {
            let z = 1.0 - 1.9 * (i as f64 + 0.5) / n as f64;
            let phi = 2.399_963_229_728_653 * i as f64;
            let r = (1.0 - z * z).sqrt();
            tilt * DVec3::new(r * phi.cos(), r * phi.sin(), z)
        })
        .collect()
}

fn transpose(m: &[f64], n: usize) -> Vec<f64> {
    (0..n * n).map(|i| m[(i % n) * n + i / n]).collect()
}

/// Solves A·X = B for A `[n, n]` and B `[n, k]` by Gaussian elimination with row pivots.
fn solve(mut a: Vec<f64>, mut b: Vec<f64>, n: usize, k: usize) -> Vec<f64> {
    for col in 0..n {
        let pivot = (col..n)
            .max_by(|&i, &j| a[i * n + col].abs().total_cmp(&a[j * n + col].abs()))
            .unwrap_or(col);
        for j in 0..n {
            a.swap(col * n + j, pivot * n + j);
        }
        for j in 0..k {
            b.swap(col * k + j, pivot * k + j);
        }
        for row in 0..n {
            if row == col {
                continue;
            }
            let f = a[row * n + col] / a[col * n + col];
            for j in col..n {
                a[row * n + j] -= f * a[col * n + j];
            }
            for j in 0..k {
                b[row * k + j] -= f * b[col * k + j];
            }
        }
    }
    for row in 0..n {
        for j in 0..k {
            b[row * k + j] /= a[row * n + row];
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rotation() -> DMat3 {
        DMat3::from_euler(glam::EulerRot::XYZ, 0.7, -1.3, 2.9)
    }

    #[test]
    fn basis_is_orthonormal() {
        // Midpoint rule in z and φ: exact enough for degree 8 products at this count.
        let (nz, np) = (400, 32);
        let mut gram = vec![0.0; 625];
        for i in 0..nz {
            let z = -1.0 + 2.0 * (i as f64 + 0.5) / nz as f64;
            for j in 0..np {
                let phi = std::f64::consts::TAU * j as f64 / np as f64;
                let r = (1.0 - z * z).sqrt();
                let y = standard(DVec3::new(r * phi.cos(), r * phi.sin(), z));
                for a in 0..25 {
                    for b in 0..25 {
                        gram[a * 25 + b] += y[a] * y[b];
                    }
                }
            }
        }
        let w = 4.0 * std::f64::consts::PI / (nz * np) as f64;
        for a in 0..25 {
            for b in 0..25 {
                let expected = if a == b { 1.0 } else { 0.0 };
                assert!((gram[a * 25 + b] * w - expected).abs() < 1e-3, "{a} {b}");
            }
        }
    }

    #[test]
    fn rotation_turns_the_functions() {
        let r = rotation();
        for (basis, eval) in [
            (RotationBasis::Standard, standard as fn(DVec3) -> [f64; 25]),
            (RotationBasis::E3nn, e3nn),
        ] {
            let m = Rotation::new(r, basis).matrix(4);
            for d in directions(40) {
                let (y, turned) = (eval(d), eval(r * d));
                for i in 0..25 {
                    let v: f64 = (0..25).map(|j| m[i * 25 + j] * y[j]).sum();
                    assert!((v - turned[i]).abs() < 1e-11, "{basis:?} {i}: {v} {}", turned[i]);
                }
            }
        }
    }

    #[test]
    fn e3nn_degree_one_is_xyz() {
        let d = DVec3::new(0.2, -0.5, 0.8).normalize();
        let y = e3nn(d);
        let c = 0.488_602_511_902_919_9;
        for (i, v) in d.to_array().into_iter().enumerate() {
            assert!((y[1 + i] - c * v).abs() < 1e-14, "{i}");
        }
    }

    #[test]
    fn mvsplat_basis_maps_exactly() {
        let m = standard_from_mvsplat();
        for d in directions(50) {
            let (s, q) = (standard(d), mvsplat(d));
            for j in 0..16 {
                let v: f64 = (0..16).map(|i| m[i * 16 + j] * s[i]).sum();
                assert!((v - q[j]).abs() < 1e-11, "function {j}: {v} {}", q[j]);
            }
        }
    }
}
