//! Colour of a splat seen from one direction: Σ_k sh_k·Y_k(d) in `f32`.
//!
//! The functions are those of [`crate::sh`], whose `f64` text is the reference
//! (a unit test holds the two together). In: a unit direction in world frame and
//! coefficients `[D, 3]`, RGB innermost. Out: RGB before gain, offset and clamp.

use crate::abi::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};

/// Highest degree that `basis` evaluates.
pub fn degree_max(basis: ShBasis) -> usize {
    match basis {
        ShBasis::Standard => 4,
        ShBasis::Mvsplat => 3,
    }
}

/// Basis functions of `basis` up to `degree` at the unit vector `d`; the rest is 0.
pub fn basis(basis: ShBasis, degree: usize, d: [f32; 3]) -> [f32; SH_COEFFICIENTS_MAX] {
    match basis {
        ShBasis::Standard => standard(degree, d),
        ShBasis::Mvsplat => {
            let [x, y, z] = d;
            let degree = degree.min(degree_max(ShBasis::Mvsplat));
            let mut out = standard(degree, [z, x, y]);
            if degree == 3 {
                out[14] = 1.445_305_7 * z * (z * z - x * x);
            }
            out
        }
    }
}

fn standard(degree: usize, [x, y, z]: [f32; 3]) -> [f32; SH_COEFFICIENTS_MAX] {
    let mut b = [0.0; SH_COEFFICIENTS_MAX];
    b[0] = 0.282_094_8;
    if degree == 0 {
        return b;
    }
    b[1] = -0.488_602_52 * y;
    b[2] = 0.488_602_52 * z;
    b[3] = -0.488_602_52 * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    b[4] = 1.092_548_5 * xy;
    b[5] = -1.092_548_5 * yz;
    b[6] = 0.315_391_57 * (2.0 * zz - xx - yy);
    b[7] = -1.092_548_5 * xz;
    b[8] = 0.546_274_24 * (xx - yy);
    if degree == 2 {
        return b;
    }
    b[9] = -0.590_043_6 * y * (3.0 * xx - yy);
    b[10] = 2.890_611_4 * xy * z;
    b[11] = -0.457_045_8 * y * (4.0 * zz - xx - yy);
    b[12] = 0.373_176_34 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    b[13] = -0.457_045_8 * x * (4.0 * zz - xx - yy);
    b[14] = 1.445_305_7 * z * (xx - yy);
    b[15] = -0.590_043_6 * x * (xx - 3.0 * yy);
    if degree == 3 {
        return b;
    }
    b[16] = 2.503_343 * xy * (xx - yy);
    b[17] = -1.770_130_8 * yz * (3.0 * xx - yy);
    b[18] = 0.946_174_7 * xy * (7.0 * zz - 1.0);
    b[19] = -0.669_046_5 * yz * (7.0 * zz - 3.0);
    b[20] = 0.105_785_55 * (zz * (35.0 * zz - 30.0) + 3.0);
    b[21] = -0.669_046_5 * xz * (7.0 * zz - 3.0);
    b[22] = 0.473_087_34 * (xx - yy) * (7.0 * zz - 1.0);
    b[23] = -1.770_130_8 * xz * (xx - 3.0 * yy);
    b[24] = 0.625_835_7 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
    b
}

/// Σ_k sh_k·Y_k(d) per colour channel. `sh` is one set `[D, 3]`; coefficients
/// above `degree`, or above what it holds, count as 0.
pub fn radiance(kind: ShBasis, degree: usize, d: [f32; 3], sh: &[f32]) -> [f32; 3] {
    let b = basis(kind, degree, d);
    let used = sh_coefficients(degree.min(degree_max(kind)));
    let mut rgb = [0.0f32; 3];
    for (c, y) in sh.chunks_exact(3).zip(&b[..used]) {
        for (sum, c) in rgb.iter_mut().zip(c) {
            *sum += c * y;
        }
    }
    rgb
}

/// `v` / ‖v‖, or the zero vector where that has no direction.
pub fn direction(v: [f32; 3]) -> [f32; 3] {
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    if norm > 0.0 && norm.is_finite() { v.map(|x| x / norm) } else { [0.0; 3] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn directions() -> impl Iterator<Item = DVec3> {
        (0..60).map(|i| {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 60.0;
            let (s, c) = (2.399_963 * f64::from(i)).sin_cos();
            let r = (1.0 - z * z).sqrt();
            DVec3::new(r * c, r * s, z)
        })
    }

    #[test]
    fn functions_are_those_of_the_reference() {
        for d in directions() {
            let d32 = d.to_array().map(|v| v as f32);
            let d = DVec3::from_array(d32.map(f64::from));
            for degree in 0..=4 {
                let n = sh_coefficients(degree);
                let got = basis(ShBasis::Standard, degree, d32);
                for (k, y) in crate::sh::standard(d).into_iter().enumerate() {
                    let y = if k < n { y } else { 0.0 };
                    assert!((f64::from(got[k]) - y).abs() < 1e-6, "standard {degree} {k}");
                }
                let got = basis(ShBasis::Mvsplat, degree, d32);
                for (k, y) in crate::sh::mvsplat(d).into_iter().enumerate() {
                    let y = if k < n { y } else { 0.0 };
                    assert!((f64::from(got[k]) - y).abs() < 1e-6, "mvsplat {degree} {k}");
                }
                assert!(got[16..].iter().all(|&v| v == 0.0));
            }
        }
    }

    #[test]
    fn radiance_ignores_what_lies_above_the_degree() {
        let sh: Vec<f32> = (0..75).map(|i| (i as f32 * 0.7).sin()).collect();
        let d = direction([0.3, -0.5, 0.9]);
        for degree in 0..=4 {
            let all = radiance(ShBasis::Standard, degree, d, &sh);
            let cut = radiance(ShBasis::Standard, degree, d, &sh[..3 * sh_coefficients(degree)]);
            assert_eq!(all, cut);
        }
        let (three, four) =
            (radiance(ShBasis::Mvsplat, 3, d, &sh), radiance(ShBasis::Mvsplat, 4, d, &sh));
        assert_eq!(three, four);
        assert_ne!(three, radiance(ShBasis::Mvsplat, 2, d, &sh));
    }
}
