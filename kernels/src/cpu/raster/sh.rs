//! Colour of a splat seen from one direction: Σ_k sh_k·Y_k(d) in `f32`.
//!
//! The functions are those of [`crate::sh`], whose `f64` code is the reference (a unit test
//! compares the two). Input: a unit direction in world frame and coefficients `[D, 3]`, RGB
//! innermost. Output: RGB before gain, offset and clamp.

use crate::cpu::simd::{LANES, Mask, Simd, Vector};
use crate::layout::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};

/// Returns the highest degree that `basis` evaluates.
pub fn degree_max(basis: ShBasis) -> usize {
    match basis {
        ShBasis::Standard => 4,
        ShBasis::Mvsplat => 3,
    }
}

/// Evaluates the functions of `basis` up to `degree` at the unit vectors `d`; the rest is 0.
#[inline(always)]
pub fn basis<V: Vector>(basis: ShBasis, degree: usize, d: [V; 3]) -> [V; SH_COEFFICIENTS_MAX] {
    let [x, y, z] = d;
    match basis {
        ShBasis::Standard => standard(degree, d),
        ShBasis::Mvsplat => {
            let degree = degree.min(degree_max(ShBasis::Mvsplat));
            let mut out = standard(degree, [z, x, y]);
            if degree == 3 {
                out[14] = V::constant(1.445_305_7) * z * (z * z - x * x);
            }
            out
        }
    }
}

/// Real SH with the Condon-Shortley sign (3DGS) up to `degree`.
#[inline(always)]
fn standard<V: Vector>(degree: usize, [x, y, z]: [V; 3]) -> [V; SH_COEFFICIENTS_MAX] {
    let c = V::constant;
    let mut b = [c(0.0); SH_COEFFICIENTS_MAX];
    b[0] = c(0.282_094_8);
    if degree == 0 {
        return b;
    }
    b[1] = c(-0.488_602_52) * y;
    b[2] = c(0.488_602_52) * z;
    b[3] = c(-0.488_602_52) * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let difference = xx - yy;
    let two = c(2.0);
    let three = c(3.0);
    b[4] = c(1.092_548_5) * xy;
    b[5] = c(-1.092_548_5) * yz;
    b[6] = c(0.315_391_57) * (two * zz - xx - yy);
    b[7] = c(-1.092_548_5) * xz;
    b[8] = c(0.546_274_24) * difference;
    if degree == 2 {
        return b;
    }
    let left = three * xx - yy;
    let right = xx - three * yy;
    let rest = c(4.0) * zz - xx - yy;
    b[9] = c(-0.590_043_6) * y * left;
    b[10] = c(2.890_611_4) * xy * z;
    b[11] = c(-0.457_045_8) * y * rest;
    b[12] = c(0.373_176_34) * z * (two * zz - three * xx - three * yy);
    b[13] = c(-0.457_045_8) * x * rest;
    b[14] = c(1.445_305_7) * z * difference;
    b[15] = c(-0.590_043_6) * x * right;
    if degree == 3 {
        return b;
    }
    let seven = c(7.0) * zz;
    b[16] = c(2.503_343) * xy * difference;
    b[17] = c(-1.770_130_8) * yz * left;
    b[18] = c(0.946_174_7) * xy * (seven - c(1.0));
    b[19] = c(-0.669_046_5) * yz * (seven - three);
    b[20] = c(0.105_785_55) * (zz * (c(35.0) * zz - c(30.0)) + three);
    b[21] = c(-0.669_046_5) * xz * (seven - three);
    b[22] = c(0.473_087_34) * difference * (seven - c(1.0));
    b[23] = c(-1.770_130_8) * xz * right;
    b[24] = c(0.625_835_7) * (xx * right - yy * left);
    b
}

/// Computes Σ_k sh_k·Y_k(d) per colour channel. `sh` is one set `[D, 3]`; coefficients above
/// `degree`, or past the end of `sh`, count as 0.
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

/// The SH functions that a render evaluates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShFunctions {
    pub basis: ShBasis,
    /// Highest degree.
    pub degree: usize,
}

/// Computes [`radiance`] of sixteen sets along sixteen unit vectors. Set l starts at `at[l]`
/// of `sh` and holds at least the coefficients of `degree`.
#[inline(always)]
pub(crate) fn radiance_lanes<S: Simd>(
    s: S,
    functions: ShFunctions,
    d: [S::F; 3],
    sh: &[f32],
    at: &[usize; LANES],
) -> [S::F; 3] {
    let ShFunctions { basis: kind, degree } = functions;
    let degree = degree.min(degree_max(kind));
    let used = sh_coefficients(degree);
    let b = basis(kind, degree, d);
    let mut rgb = [s.splat(0.0); 3];
    // Four coefficients are twelve floats: three gathers of four.
    let mut c = 0;
    while c + 4 <= used {
        let [r0, g0, b0, r1] = s.gather4(sh, at, 3 * c);
        let [g1, b1, r2, g2] = s.gather4(sh, at, 3 * c + 4);
        let [b2, r3, g3, b3] = s.gather4(sh, at, 3 * c + 8);
        let y0 = b[c];
        let y1 = b[c + 1];
        let y2 = b[c + 2];
        let y3 = b[c + 3];
        rgb[0] = r3.fma(y3, r2.fma(y2, r1.fma(y1, r0.fma(y0, rgb[0]))));
        rgb[1] = g3.fma(y3, g2.fma(y2, g1.fma(y1, g0.fma(y0, rgb[1]))));
        rgb[2] = b3.fma(y3, b2.fma(y2, b1.fma(y1, b0.fma(y0, rgb[2]))));
        c += 4;
    }
    // (degree + 1)² modulo 4 is 0 or 1.
    if c < used {
        let mut last = [[0.0; LANES]; 3];
        for (l, &at) in at.iter().enumerate() {
            let set = sh.get(at + 3 * c..at + 3 * c + 3).unwrap_or(&[0.0; 3]);
            for (lanes, v) in last.iter_mut().zip(set) {
                lanes[l] = *v;
            }
        }
        rgb[0] = s.load(&last[0]).fma(b[c], rgb[0]);
        rgb[1] = s.load(&last[1]).fma(b[c], rgb[1]);
        rgb[2] = s.load(&last[2]).fma(b[c], rgb[2]);
    }
    rgb
}

/// Computes [`direction`] of sixteen vectors.
#[inline(always)]
pub(crate) fn direction_lanes<S: Simd>(s: S, v: [S::F; 3]) -> [S::F; 3] {
    let norm = v[0].fma(v[0], v[1].fma(v[1], v[2] * v[2])).sqrt();
    let good = s.splat(0.0).lt(norm) & norm.lt(s.splat(f32::INFINITY));
    let inverse = good.select_or_zero(s.splat(1.0) / norm);
    [
        good.select_or_zero(v[0] * inverse),
        good.select_or_zero(v[1] * inverse),
        good.select_or_zero(v[2] * inverse),
    ]
}

/// Returns `v` / ‖v‖, or the zero vector if `v` has no direction.
pub fn direction(v: [f32; 3]) -> [f32; 3] {
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    if norm > 0.0 && norm.is_finite() { v.map(|x| x / norm) } else { [0.0; 3] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::simd::{Kernel, SimdLevel};
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

    struct Lanes<'a>(ShFunctions, &'a [[f32; 3]; LANES], &'a [f32], &'a [usize; LANES]);

    impl Kernel for Lanes<'_> {
        type Output = [[f32; LANES]; 3];

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Self::Output {
            let mut columns = [[0.0; LANES]; 3];
            for (l, v) in self.1.iter().enumerate() {
                for c in 0..3 {
                    columns[c][l] = v[c];
                }
            }
            let d = direction_lanes(s, columns.map(|c| s.load(&c)));
            for (to, v) in columns.iter_mut().zip(radiance_lanes(s, self.0, d, self.2, self.3)) {
                s.store(v, to);
            }
            columns
        }
    }

    /// Sixteen at a time equal one at a time at every level, for sets of any degree stored
    /// and evaluated, the last set of the slice included.
    #[test]
    fn lanes_are_the_single_one() {
        let vectors: [[f32; 3]; LANES] = std::array::from_fn(|l| match l {
            3 => [0.0; 3],
            5 => [f32::MAX; 3],
            _ => [(l as f32).sin(), (l as f32 * 2.3).cos(), 3.0 - l as f32 * 0.4],
        });
        for stored in 0..=4 {
            let set = 3 * sh_coefficients(stored);
            let sh: Vec<f32> = (0..9 * set).map(|i| (i as f32 * 0.7).sin()).collect();
            let at = std::array::from_fn(|l| (l * 5 % 9) * set);
            for degree in 0..=stored {
                for kind in [ShBasis::Standard, ShBasis::Mvsplat] {
                    let functions = ShFunctions { basis: kind, degree };
                    for &level in SimdLevel::available() {
                        let got = level.run(Lanes(functions, &vectors, &sh, &at));
                        for l in 0..LANES {
                            let set = &sh[at[l]..at[l] + set];
                            let expected = radiance(kind, degree, direction(vectors[l]), set);
                            for c in 0..3 {
                                let (a, b) = (got[c][l], expected[c]);
                                assert!(
                                    (a - b).abs() < 2e-6,
                                    "{level:?} {stored} {degree} {a} {b}"
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}
