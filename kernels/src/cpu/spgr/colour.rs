//! Spherical harmonics of a vector of parents: the functions of [`crate::cpu::raster::sh`] at a
//! vector of directions, and the parents' coefficients as vectors.
//!
//! The direction of an evaluation is never detached from the graph.

use super::view::{V3, dot, scaled};
use crate::cpu::raster::sh::{basis, degree_max};
use crate::cpu::simd::{LANES, Mask, Real, Vector};
use crate::layout::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};

/// Coefficients of a vector of parents, `[D·3]`, RGB innermost.
pub(super) struct Coefficients<T> {
    tile: Box<[[T; LANES]; 3 * SH_COEFFICIENTS_MAX]>,
    basis: ShBasis,
    degree: usize,
}

impl<T: Real> Coefficients<T> {
    /// Allocates functions up to `degree`, as far as `basis` has them.
    pub(super) fn new(basis: ShBasis, degree: usize) -> Self {
        let tile = Box::new([[T::default(); LANES]; 3 * SH_COEFFICIENTS_MAX]);
        Self { tile, basis, degree: degree.min(degree_max(basis)) }
    }

    /// Reads `count` sets of `set` numbers, `[D, 3]` each, into the lanes.
    #[inline(always)]
    pub(super) fn load<V: Vector<Element = T>>(
        &mut self,
        sh: &[T],
        (first, count, set): (usize, usize, usize),
    ) {
        let used = 3 * sh_coefficients(self.degree);
        for lane in 0..V::LANES {
            let at = (first + lane.min(count - 1)) * set;
            for (tile, &v) in self.tile.iter_mut().zip(&sh[at..at + used]) {
                tile[lane] = v;
            }
        }
    }

    /// Computes Σ_k sh_k·Y_k along `v` of any length; a vector without direction counts as 0.
    #[inline(always)]
    pub(super) fn radiance<V: Vector<Element = T>>(&self, v: V3<V>) -> V3<V> {
        let (zero, one) = (V::constant(0.0), V::constant(1.0));
        let norm = dot(v, v).sqrt();
        let sound = norm.lt(V::constant(f64::INFINITY)).select_or_zero(norm);
        let inverse = zero.lt(sound).select_or_zero(one / norm);
        let d = scaled(v, inverse);
        let y = basis(self.basis, self.degree, d);
        let mut rgb = [zero; 3];
        for (y, sh) in y.iter().zip(self.tile.chunks_exact(3)).take(sh_coefficients(self.degree)) {
            for (rgb, sh) in rgb.iter_mut().zip(sh) {
                *rgb = V::load(sh).fma(*y, *rgb);
            }
        }
        rgb
    }
}
