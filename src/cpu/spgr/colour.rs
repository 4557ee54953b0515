//! Spherical harmonics on lanes: the functions of [`crate::cpu::sh`] with a vector of
//! directions, and the parents' coefficients turned into vectors.

use super::view::{V3, dot, kept, scaled};
use crate::abi::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};
use crate::cpu::lanes::{Lanes, Machine, WIDTH_MAX};
use crate::cpu::sh::degree_max;

/// Coefficients of a vector of parents, `[D·3]`, RGB innermost.
pub(super) struct Coefficients<T> {
    tile: Box<[[T; WIDTH_MAX]; 3 * SH_COEFFICIENTS_MAX]>,
    basis: ShBasis,
    degree: usize,
}

impl<T: crate::cpu::real::Real> Coefficients<T> {
    /// For functions up to `degree`, as far as `basis` has them.
    pub(super) fn new(basis: ShBasis, degree: usize) -> Self {
        let tile = Box::new([[T::default(); WIDTH_MAX]; 3 * SH_COEFFICIENTS_MAX]);
        Self { tile, basis, degree: degree.min(degree_max(basis)) }
    }

    /// Reads `count` sets of `set` numbers, `[D, 3]` each, into the lanes.
    #[inline(always)]
    pub(super) fn load<M: Machine<Scalar = T>>(
        &mut self,
        _: M,
        sh: &[T],
        (first, count, set): (usize, usize, usize),
    ) {
        let used = 3 * sh_coefficients(self.degree);
        for lane in 0..M::WIDTH {
            let at = (first + lane.min(count - 1)) * set;
            for (tile, &v) in self.tile.iter_mut().zip(&sh[at..at + used]) {
                tile[lane] = v;
            }
        }
    }

    /// Σ_k sh_k·Y_k along `v`, any length; a vector without direction counts as 0.
    #[inline(always)]
    pub(super) fn radiance<M: Machine<Scalar = T>>(&self, m: M, v: V3<M::V>) -> V3<M::V> {
        let (zero, one) = (m.of(0.0), m.of(1.0));
        let norm = dot(v, v).sqrt();
        let sound = kept(norm.lt(m.of(f64::INFINITY)), norm);
        let inverse = kept(zero.lt(sound), one / norm);
        let d = scaled(v, inverse);
        let mut y = [zero; SH_COEFFICIENTS_MAX];
        match self.basis {
            ShBasis::Standard => standard(self.degree, d, &mut y),
            ShBasis::Mvsplat => {
                standard(self.degree, [d[2], d[0], d[1]], &mut y);
                if self.degree == 3 {
                    y[14] = m.of(1.445_305_7) * d[2] * (d[2] * d[2] - d[0] * d[0]);
                }
            }
        }
        let mut rgb = [zero; 3];
        for (y, sh) in y.iter().zip(self.tile.chunks_exact(3)).take(sh_coefficients(self.degree)) {
            for (rgb, sh) in rgb.iter_mut().zip(sh) {
                *rgb = m.load(sh).fma(*y, *rgb);
            }
        }
        rgb
    }
}

/// Real SH with the Condon-Shortley sign (3DGS) up to `degree`.
#[inline(always)]
fn standard<V: Lanes>(degree: usize, [x, y, z]: V3<V>, b: &mut [V; SH_COEFFICIENTS_MAX]) {
    let c = |v: f64| x.of(v);
    b[0] = c(0.282_094_8);
    if degree == 0 {
        return;
    }
    b[1] = c(-0.488_602_52) * y;
    b[2] = c(0.488_602_52) * z;
    b[3] = c(-0.488_602_52) * x;
    if degree == 1 {
        return;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (difference, two, three) = (xx - yy, c(2.0), c(3.0));
    b[4] = c(1.092_548_5) * xy;
    b[5] = c(-1.092_548_5) * yz;
    b[6] = c(0.315_391_57) * (two * zz - xx - yy);
    b[7] = c(-1.092_548_5) * xz;
    b[8] = c(0.546_274_24) * difference;
    if degree == 2 {
        return;
    }
    let (left, right) = (three * xx - yy, xx - three * yy);
    let rest = c(4.0) * zz - xx - yy;
    b[9] = c(-0.590_043_6) * y * left;
    b[10] = c(2.890_611_4) * xy * z;
    b[11] = c(-0.457_045_8) * y * rest;
    b[12] = c(0.373_176_34) * z * (two * zz - three * xx - three * yy);
    b[13] = c(-0.457_045_8) * x * rest;
    b[14] = c(1.445_305_7) * z * difference;
    b[15] = c(-0.590_043_6) * x * right;
    if degree == 3 {
        return;
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
}
