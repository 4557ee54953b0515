//! Colour of a splat seen from one direction: Σ_k sh_k·Y_k(d) in `f32`.
//!
//! The functions are those of [`crate::sh`], whose `f64` text is the reference
//! (a unit test holds the two together). In: a unit direction in world frame and
//! coefficients `[D, 3]`, RGB innermost. Out: RGB before gain, offset and clamp.

use crate::abi::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};
use crate::cpu::simd::{LANES, Mask, Simd, Vector};
use std::ops::{Add, Mul, Sub};

/// Highest degree that `basis` evaluates.
pub fn degree_max(basis: ShBasis) -> usize {
    match basis {
        ShBasis::Standard => 4,
        ShBasis::Mvsplat => 3,
    }
}

/// Basis functions of `basis` up to `degree` at the unit vector `d`; the rest is 0.
pub fn basis(basis: ShBasis, degree: usize, d: [f32; 3]) -> [f32; SH_COEFFICIENTS_MAX] {
    functions(One, basis, degree, d)
}

/// One text for one direction and for lanes of them.
#[inline(always)]
fn functions<T: Number, K: Constants<T>>(
    k: K,
    basis: ShBasis,
    degree: usize,
    d: [T; 3],
) -> [T; SH_COEFFICIENTS_MAX] {
    let [x, y, z] = d;
    match basis {
        ShBasis::Standard => standard(k, degree, d),
        ShBasis::Mvsplat => {
            let degree = degree.min(degree_max(ShBasis::Mvsplat));
            let mut out = standard(k, degree, [z, x, y]);
            if degree == 3 {
                out[14] = k.of(1.445_305_7) * z * (z * z - x * x);
            }
            out
        }
    }
}

/// What [`functions`] needs of its numbers.
trait Number: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {}
impl<T: Copy + Add<Output = T> + Sub<Output = T> + Mul<Output = T>> Number for T {}

/// What makes constants among them.
trait Constants<T>: Copy {
    fn of(self, v: f32) -> T;
}

#[derive(Clone, Copy)]
struct One;

impl Constants<f32> for One {
    #[inline(always)]
    fn of(self, v: f32) -> f32 {
        v
    }
}

#[derive(Clone, Copy)]
struct Sixteen<S>(S);

impl<S: Simd> Constants<S::F> for Sixteen<S> {
    #[inline(always)]
    fn of(self, v: f32) -> S::F {
        self.0.splat(v)
    }
}

#[inline(always)]
fn standard<T: Number, K: Constants<T>>(
    k: K,
    degree: usize,
    [x, y, z]: [T; 3],
) -> [T; SH_COEFFICIENTS_MAX] {
    let mut b = [k.of(0.0); SH_COEFFICIENTS_MAX];
    b[0] = k.of(0.282_094_8);
    if degree == 0 {
        return b;
    }
    b[1] = k.of(-0.488_602_52) * y;
    b[2] = k.of(0.488_602_52) * z;
    b[3] = k.of(-0.488_602_52) * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    b[4] = k.of(1.092_548_5) * xy;
    b[5] = k.of(-1.092_548_5) * yz;
    b[6] = k.of(0.315_391_57) * (k.of(2.0) * zz - xx - yy);
    b[7] = k.of(-1.092_548_5) * xz;
    b[8] = k.of(0.546_274_24) * (xx - yy);
    if degree == 2 {
        return b;
    }
    b[9] = k.of(-0.590_043_6) * y * (k.of(3.0) * xx - yy);
    b[10] = k.of(2.890_611_4) * xy * z;
    b[11] = k.of(-0.457_045_8) * y * (k.of(4.0) * zz - xx - yy);
    b[12] = k.of(0.373_176_34) * z * (k.of(2.0) * zz - k.of(3.0) * xx - k.of(3.0) * yy);
    b[13] = k.of(-0.457_045_8) * x * (k.of(4.0) * zz - xx - yy);
    b[14] = k.of(1.445_305_7) * z * (xx - yy);
    b[15] = k.of(-0.590_043_6) * x * (xx - k.of(3.0) * yy);
    if degree == 3 {
        return b;
    }
    b[16] = k.of(2.503_343) * xy * (xx - yy);
    b[17] = k.of(-1.770_130_8) * yz * (k.of(3.0) * xx - yy);
    b[18] = k.of(0.946_174_7) * xy * (k.of(7.0) * zz - k.of(1.0));
    b[19] = k.of(-0.669_046_5) * yz * (k.of(7.0) * zz - k.of(3.0));
    b[20] = k.of(0.105_785_55) * (zz * (k.of(35.0) * zz - k.of(30.0)) + k.of(3.0));
    b[21] = k.of(-0.669_046_5) * xz * (k.of(7.0) * zz - k.of(3.0));
    b[22] = k.of(0.473_087_34) * (xx - yy) * (k.of(7.0) * zz - k.of(1.0));
    b[23] = k.of(-1.770_130_8) * xz * (xx - k.of(3.0) * yy);
    b[24] = k.of(0.625_835_7) * (xx * (xx - k.of(3.0) * yy) - yy * (k.of(3.0) * xx - yy));
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

/// [`radiance`] of sixteen sets along sixteen unit vectors: set l starts at `at[l]`
/// of `sh`, and holds at least the coefficients of `degree`.
#[inline(always)]
pub(crate) fn radiance_lanes<S: Simd>(
    s: S,
    (kind, degree): (ShBasis, usize),
    d: [S::F; 3],
    sh: &[f32],
    at: &[usize; LANES],
) -> [S::F; 3] {
    let degree = degree.min(degree_max(kind));
    let used = sh_coefficients(degree);
    let b = functions(Sixteen(s), kind, degree, d);
    let mut rgb = [s.splat(0.0); 3];
    // Four coefficients are twelve floats, three transposed quads.
    let mut c = 0;
    while c + 4 <= used {
        let [r0, g0, b0, r1] = s.gather4(sh, at, 3 * c);
        let [g1, b1, r2, g2] = s.gather4(sh, at, 3 * c + 4);
        let [b2, r3, g3, b3] = s.gather4(sh, at, 3 * c + 8);
        let (y0, y1, y2, y3) = (b[c], b[c + 1], b[c + 2], b[c + 3]);
        rgb[0] = r3.fma(y3, r2.fma(y2, r1.fma(y1, r0.fma(y0, rgb[0]))));
        rgb[1] = g3.fma(y3, g2.fma(y2, g1.fma(y1, g0.fma(y0, rgb[1]))));
        rgb[2] = b3.fma(y3, b2.fma(y2, b1.fma(y1, b0.fma(y0, rgb[2]))));
        c += 4;
    }
    // (degree + 1)² leaves one or none.
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

/// [`direction`] of sixteen vectors.
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

/// `v` / ‖v‖, or the zero vector where that has no direction.
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

    struct Lanes<'a>(ShBasis, usize, &'a [[f32; 3]; LANES], &'a [f32], &'a [usize; LANES]);

    impl Kernel for Lanes<'_> {
        type Output = [[f32; LANES]; 3];

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Self::Output {
            let mut columns = [[0.0; LANES]; 3];
            for (l, v) in self.2.iter().enumerate() {
                for c in 0..3 {
                    columns[c][l] = v[c];
                }
            }
            let d = direction_lanes(s, columns.map(|c| s.load(&c)));
            for (to, v) in
                columns.iter_mut().zip(radiance_lanes(s, (self.0, self.1), d, self.3, self.4))
            {
                s.store(v, to);
            }
            columns
        }
    }

    /// Sixteen at a time give what one at a time does, in every level, for sets of
    /// any degree stored and evaluated, the last set of the slice included.
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
                    for &level in SimdLevel::available() {
                        let got = level.run(Lanes(kind, degree, &vectors, &sh, &at));
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
