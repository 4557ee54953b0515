//! Gradient of view-dependent colour with respect to its direction: the basis
//! functions of [`crate::cpu::raster::sh`] with their slopes, as plain expressions that a
//! loop over 16 splats turns into vectors.
//!
//! Slopes are those of the polynomials as written there, off the unit sphere too; only
//! their part along the sphere counts, and that is the same for every such writing.

use crate::cpu::raster::sh::degree_max;
use crate::layout::{ShBasis, sh_coefficients};

/// Coefficients per channel that `basis` evaluates at `degree`.
pub(crate) fn used_coefficients(basis: ShBasis, degree: usize) -> usize {
    sh_coefficients(degree.min(degree_max(basis)))
}

/// Y_k(d) of `basis`, k < D, and Σ_k s_k ∇Y_k(d).
#[inline(always)]
pub(crate) fn values_and_slope<const D: usize>(
    basis: ShBasis,
    [x, y, z]: [f32; 3],
    s: &[f32; D],
) -> ([f32; D], [f32; 3]) {
    if basis == ShBasis::Standard {
        return standard(x, y, z, s);
    }
    let mut rest = *s;
    if D > 14 {
        rest[14] = 0.0;
    }
    let (mut values, [gz, gx, gy]) = standard(z, x, y, &rest);
    let mut slope = [gx, gy, gz];
    if D > 14 {
        values[14] = C3[4] * z * (z * z - x * x);
        slope[0] -= s[14] * C3[4] * 2.0 * x * z;
        slope[2] += s[14] * C3[4] * (3.0 * z * z - x * x);
    }
    (values, slope)
}

const C0: f32 = 0.282_094_8;
const C1: f32 = 0.488_602_52;
/// |m| = 2 and 1, m = 0, x² − y².
const C2: [f32; 3] = [1.092_548_5, 0.315_391_57, 0.546_274_24];
/// |m| = 3, xyz, |m| = 1, m = 0, z(x² − y²).
const C3: [f32; 5] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_34, 1.445_305_7];
/// |m| = 4 (xy), 3, 2 (xy), 1, 0, 2, 4.
const C4: [f32; 7] =
    [2.503_343, 1.770_130_8, 0.946_174_7, 0.669_046_5, 0.105_785_55, 0.473_087_34, 0.625_835_7];

#[inline(always)]
fn standard<const D: usize>(x: f32, y: f32, z: f32, s: &[f32; D]) -> ([f32; D], [f32; 3]) {
    let mut v = [0.0; D];
    let mut g = [0.0f32; 3];
    v[0] = C0;
    if D > 1 {
        (v[1], v[2], v[3]) = (-C1 * y, C1 * z, -C1 * x);
        g = [-C1 * s[3], -C1 * s[1], C1 * s[2]];
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if D > 4 {
        let [a, b, e] = C2;
        v[4] = a * x * y;
        v[5] = -a * y * z;
        v[6] = b * (2.0 * zz - xx - yy);
        v[7] = -a * x * z;
        v[8] = e * (xx - yy);
        let s4 = a * s[4];
        let s5 = a * s[5];
        let s6 = 2.0 * b * s[6];
        let (s7, s8) = (a * s[7], 2.0 * e * s[8]);
        g[0] += s4 * y - s6 * x - s7 * z + s8 * x;
        g[1] += s4 * x - s5 * z - s6 * y - s8 * y;
        g[2] += 2.0 * s6 * z - s5 * y - s7 * x;
    }
    if D > 9 {
        let [f, c, h, i, j] = C3;
        let (p, q) = (3.0 * xx - yy, xx - 3.0 * yy);
        let w = 4.0 * zz - xx - yy;
        v[9] = -f * y * p;
        v[10] = c * x * y * z;
        v[11] = -h * y * w;
        v[12] = i * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        v[13] = -h * x * w;
        v[14] = j * z * (xx - yy);
        v[15] = -f * x * q;
        let (s9, s10, s11, s12) = (f * s[9], c * s[10], h * s[11], i * s[12]);
        let (s13, s14, s15) = (h * s[13], j * s[14], f * s[15]);
        let xy = x * y;
        let d = 3.0 * (xx - yy);
        g[0] += s10 * y * z + 2.0 * xy * s11 - 6.0 * x * z * s12 - s13 * (w - 2.0 * xx)
            + 2.0 * x * z * s14
            - s15 * d
            - 6.0 * xy * s9;
        g[1] += s10 * x * z - s9 * d - s11 * (w - 2.0 * yy) - 6.0 * y * z * s12 + 2.0 * xy * s13
            - 2.0 * y * z * s14
            + 6.0 * xy * s15;
        g[2] += s10 * xy - 8.0 * z * (s11 * y + s13 * x)
            + s12 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            + s14 * (xx - yy);
    }
    if D > 16 {
        let (p, q) = (3.0 * xx - yy, xx - 3.0 * yy);
        let xy = x * y;
        let d = 3.0 * (xx - yy);
        let (a, b) = (7.0 * zz - 1.0, 7.0 * zz - 3.0);
        let e = 21.0 * zz - 3.0;
        v[16] = C4[0] * xy * (xx - yy);
        v[17] = -C4[1] * y * z * p;
        v[18] = C4[2] * xy * a;
        v[19] = -C4[3] * y * z * b;
        v[20] = C4[4] * (zz * (35.0 * zz - 30.0) + 3.0);
        v[21] = -C4[3] * x * z * b;
        v[22] = C4[5] * (xx - yy) * a;
        v[23] = -C4[1] * x * z * q;
        v[24] = C4[6] * (xx * q - yy * p);
        let (t16, t17, t18) = (C4[0] * s[16], C4[1] * s[17], C4[2] * s[18]);
        let (t19, t20, t21) = (C4[3] * s[19], C4[4] * s[20], C4[3] * s[21]);
        let t22 = C4[5] * s[22];
        let t23 = C4[1] * s[23];
        let t24 = 4.0 * C4[6] * s[24];
        let xyz = 6.0 * xy * z;
        g[0] += t16 * y * p - t17 * xyz + t18 * y * a - t21 * z * b + 2.0 * t22 * x * a
            - t23 * z * d
            + t24 * x * q;
        g[1] += t16 * x * q - t17 * z * d + t18 * x * a - t19 * z * b - 2.0 * t22 * y * a
            + t23 * xyz
            - t24 * y * p;
        g[2] += 14.0 * z * (t18 * xy + t22 * (xx - yy)) - t17 * y * p - t19 * y * e
            + t20 * z * (140.0 * zz - 60.0)
            - t21 * x * e
            - t23 * x * q;
    }
    (v, g)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    type Functions = fn(DVec3) -> Vec<f64>;

    fn check<const D: usize>(basis: ShBasis, functions: Functions) {
        for i in 0..40 {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 40.0;
            let (sin, cos) = (2.399_963 * f64::from(i)).sin_cos();
            let d = DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
            let s: [f32; D] = std::array::from_fn(|k| ((k * 7 + i as usize) as f32).sin());
            let (values, slope) = values_and_slope(basis, d.to_array().map(|v| v as f32), &s);
            for (k, y) in functions(d).into_iter().take(D).enumerate() {
                assert!((f64::from(values[k]) - y).abs() < 2e-6, "{basis:?} {D} {k}");
            }
            let sum = |d: DVec3| -> f64 {
                functions(d.normalize()).iter().zip(&s).map(|(y, s)| y * f64::from(*s)).sum()
            };
            let g = DVec3::from_array(slope.map(f64::from));
            let along = g - d * d.dot(g);
            for axis in 0..3 {
                let mut h = DVec3::ZERO;
                h[axis] = 1e-5;
                let expected = (sum(d + h) - sum(d - h)) / 2e-5;
                assert!((along[axis] - expected).abs() < 2e-5, "{basis:?} {D} {axis}");
            }
        }
    }

    #[test]
    fn values_and_slopes_are_those_of_the_reference() {
        let standard: Functions = |d| crate::sh::standard(d).to_vec();
        let mvsplat: Functions = |d| crate::sh::mvsplat(d).to_vec();
        check::<1>(ShBasis::Standard, standard);
        check::<4>(ShBasis::Standard, standard);
        check::<9>(ShBasis::Standard, standard);
        check::<16>(ShBasis::Standard, standard);
        check::<25>(ShBasis::Standard, standard);
        check::<9>(ShBasis::Mvsplat, mvsplat);
        check::<16>(ShBasis::Mvsplat, mvsplat);
    }
}
