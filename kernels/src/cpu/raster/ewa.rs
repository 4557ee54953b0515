//! Elliptical weighted average of one splat: 3-D Gaussian to 2-D footprint (EWA
//! splatting, Zwicker et al. 2001; 3DGS section 4).
//!
//! cov2d = J·W·Σ·Wᵀ·Jᵀ + low-pass·I, J the Jacobian of the projection at the mean, W
//! the rotation from world to camera. Each lane is a splat.
//!
//! The conic is kept as its Cholesky factor, in units of log₂: with dx, dy the
//! distance of a pixel centre from the mean,
//! σ·log₂e = (sx·(dx + shear·dy))² + (sy·dy)²: never negative, no cancellation.
//!
//! Dropped splats: mean not in front of the near plane, opacity (after antialiasing) below
//! 1/255, no overlap with the picture, and every splat with a number that is or becomes NaN
//! or infinite, a zero quaternion included. A σ of zero is a point, which the low-pass
//! widens. The sign of σ does not matter. The alpha cap limits opacities above 1.

pub use crate::layout::View;

use crate::cpu::raster::covariance::{Covariance2d, Shape, covariance_cov6, covariance_quat, dot};
use crate::cpu::simd::{F32Vector, LANES, Mask, Simd, Vector};
use crate::layout::{
    ALPHA_MIN, ALPHA_MIN_LOG2, BLOCK, DISCRIMINANT_MIN_MVSPLAT, OPACITY_MAX, RADIUS_SIGMAS_MVSPLAT,
    SPAN_SLACK_PX, SUPPORT_SLACK, TILE_MVSPLAT,
};
use std::f32::consts::{LN_2, LOG2_E};

/// Four-byte fields of a [`Footprint`].
pub(crate) const FIELDS: usize = 16;

const _: () = assert!(size_of::<Footprint>() == 4 * FIELDS && FIELDS == LANES);
const _: () = assert!(TILE_MVSPLAT.is_multiple_of(BLOCK), "the tile cut falls on block edges");

/// A projected splat, one cache line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Footprint {
    /// Mean, px, with pixel centres at integers (the camera's convention minus 0.5): column 0 is
    /// at u = 0.
    pub u: f32,
    /// Mean, px, row 0 at v = 0.
    pub v: f32,
    /// √(A·log₂e / 2), 1/px, with A, B, C the conic: σ = (A dx² + C dy²)/2 + B dx dy.
    pub sx: f32,
    /// B / A.
    pub shear: f32,
    /// √((C − B²/A)·log₂e / 2), 1/px.
    pub sy: f32,
    /// log₂ of the opacity, after antialiasing.
    pub power: f32,
    /// Colour, at least 0.
    pub rgb: [f32; 3],
    /// Camera z of the mean, world units.
    pub z: f32,
    /// Half-width of the support (alpha ≥ 1/255), px.
    pub half_width: f32,
    /// Half-height of the support, px.
    pub half_height: f32,
    /// First pixel column that the splat can touch.
    pub x0: u32,
    /// First pixel row.
    pub y0: u32,
    /// One past the last pixel column; 0 for a dropped splat.
    pub x1: u32,
    /// One past the last pixel row.
    pub y1: u32,
}

impl Footprint {
    /// Borrows the fields in order, the last four as the bits of whole numbers.
    #[inline(always)]
    pub(crate) fn fields(&self) -> &[f32; FIELDS] {
        // SAFETY: sixteen fields of four bytes without padding (`repr(C)` and the
        // assertion above), and every pattern of 32 bits is an f32.
        unsafe { &*std::ptr::from_ref(self).cast() }
    }

    /// Borrows the fields mutably.
    #[inline(always)]
    pub(crate) fn fields_mut(&mut self) -> &mut [f32; FIELDS] {
        // SAFETY: as above; every pattern of 32 bits is a u32 as well.
        unsafe { &mut *std::ptr::from_mut(self).cast() }
    }

    /// Returns whether the splat is kept.
    pub fn visible(&self) -> bool {
        self.x1 > self.x0
    }

    /// Computes the inverse of the 2-D covariance with low-pass: A, B, C in 1/px².
    pub fn conic(&self) -> [f32; 3] {
        let a = 2.0 * LN_2 * self.sx * self.sx;
        let b = a * self.shear;
        [a, b, 2.0 * LN_2 * self.sy * self.sy + b * self.shear]
    }

    /// Computes the opacity after antialiasing.
    pub fn opacity(&self) -> f32 {
        self.power.exp2()
    }

    /// Computes the interval of columns in which rows `y0..=y1` (pixel centres) can intersect
    /// the support; `None` if they cannot.
    pub fn span(&self, y0: f32, y1: f32) -> Option<(f32, f32)> {
        let low = (y0 - self.v).max(-self.half_height);
        let high = (y1 - self.v).min(self.half_height);
        if low > high {
            return None;
        }
        let reach = support(self.power);
        // The ellipse is convex: its right edge over the rows is farthest at the
        // rightmost point's row, or at the end nearest to it; the left mirrors it.
        let tip = -self.shear * self.half_height * self.half_height / self.half_width;
        let edge = |dy: f32| (reach - self.sy * self.sy * dy * dy).max(0.0).sqrt() / self.sx;
        let right = tip.max(low).min(high);
        let left = (-tip).max(low).min(high);
        Some((
            self.u - self.shear * left - edge(left) - SPAN_SLACK_PX,
            self.u - self.shear * right + edge(right) + SPAN_SLACK_PX,
        ))
    }
}

/// Computes log₂(255·opacity) from `power` = log₂ opacity, with slack: an alpha whose
/// exponent is lower by this much is below 1/255.
fn support(power: f32) -> f32 {
    let reach = power - ALPHA_MIN_LOG2;
    reach + SUPPORT_SLACK * (1.0 + reach)
}

/// Computes [`support`] of sixteen splats.
#[inline(always)]
pub(crate) fn support_lanes<S: Simd>(s: S, power: S::F) -> S::F {
    let reach = power - s.splat(ALPHA_MIN_LOG2);
    s.splat(SUPPORT_SLACK).fma(s.splat(1.0) + reach, reach)
}

impl View {
    /// Transforms world points to the camera, as Rᵀ(p − t).
    #[inline(always)]
    fn to_camera<S: Simd>(&self, s: S, p: [S::F; 3]) -> [S::F; 3] {
        let e = self.eye;
        let d = [p[0] - s.splat(e[0]), p[1] - s.splat(e[1]), p[2] - s.splat(e[2])];
        let [a, b, c] = self.rows;
        [dot_const(s, a, d), dot_const(s, b, d), dot_const(s, c, d)]
    }

    /// Computes the rows of J·W at points in camera coordinates, px per world unit; `slopes`
    /// are x/z and y/z.
    #[inline(always)]
    fn jacobian_in_world<S: Simd>(&self, s: S, slopes: [S::F; 2], z: S::F) -> [[S::F; 3]; 2] {
        let inverse = s.splat(1.0) / z;
        let away = self.rows[2];
        let mut j = [[z; 3]; 2];
        for i in 0..2 {
            let (low, high) = self.limit[i];
            let slope = slopes[i].max(s.splat(low)).min(s.splat(high));
            let f = s.splat(self.focal[i]) * inverse;
            for c in 0..3 {
                j[i][c] = f * slope.fnma(s.splat(away[c]), s.splat(self.rows[i][c]));
            }
        }
        j
    }

    /// Computes sixteen footprints with colours 0, and the kept lanes. Vector k holds field k
    /// of [`Footprint`], zeros in the lanes of dropped splats.
    #[inline(always)]
    pub(crate) fn project<S: Simd>(
        &self,
        s: S,
        mean: [S::F; 3],
        shape: Shape<S>,
        opacity: S::F,
    ) -> ([S::F; FIELDS], S::M) {
        let p = self.to_camera(s, mean);
        // A splat whose squared distance overflows has no colour.
        let within = dot(p, p).lt(s.splat(f32::INFINITY));
        let front = s.splat(self.near).lt(p[2]) & within;
        let slopes = [p[0] / p[2], p[1] / p[2]];
        let j = self.jacobian_in_world(s, slopes, p[2]);
        let (covariance, shaped) = match shape {
            Shape::Quat(quat, scale) => covariance_quat(s, j, quat, scale),
            Shape::Cov6(cov6) => (covariance_cov6(s, j, cov6), front),
        };
        self.footprint(s, p, slopes, covariance, opacity, front & shaped)
    }

    #[inline(always)]
    fn footprint<S: Simd>(
        &self,
        s: S,
        p: [S::F; 3],
        slopes: [S::F; 2],
        c: Covariance2d<S>,
        opacity: S::F,
        kept: S::M,
    ) -> ([S::F; FIELDS], S::M) {
        let (zero, lowpass) = (s.splat(0.0), s.splat(self.lowpass));
        let (xx, yy) = (c.xx + lowpass, c.yy + lowpass);
        let det = lowpass.fma(c.xx + c.yy + lowpass, c.det);
        let mut opacity = opacity;
        if self.antialiased {
            opacity = opacity * zero.max(c.det / det).sqrt();
        }
        let infinity = s.splat(f32::INFINITY);
        // Comparisons are false for NaN.
        let mut kept = kept & s.splat(ALPHA_MIN).le(opacity) & opacity.lt(infinity);
        kept = kept & zero.lt(det) & det.lt(infinity) & zero.lt(xx) & zero.lt(yy);
        let power = s.splat(OPACITY_MAX).min(opacity).log2();
        let reach = s.splat(2.0 * LN_2) * support_lanes(s, power);
        let [mut u, mut v] = slopes;
        if self.z_epsilon != 0.0 {
            let z = p[2] + s.splat(self.z_epsilon);
            (u, v) = (p[0] / z, p[1] / z);
        }
        u = s.splat(self.focal[0]).fma(u, s.splat(self.centre[0]));
        v = s.splat(self.focal[1]).fma(v, s.splat(self.centre[1]));
        let inverse = s.splat(1.0) / yy;
        let sx = (s.splat(0.5 * LOG2_E) * (yy / det)).sqrt();
        let shear = -c.xy * inverse;
        let sy = (s.splat(0.5 * LOG2_E) * inverse).sqrt();
        let (half_width, half_height) = ((reach * xx).sqrt(), (reach * yy).sqrt());
        // The sum is finite only if no term is NaN or infinite. Overflow of huge finite
        // terms drops the splat, too.
        let sum = u + v + sx + shear + sy + p[2] + half_width + half_height;
        kept = kept & sum.abs().lt(infinity);
        let radius = if self.tile_cut { Some(radius_mvsplat(s, xx, yy, det)) } else { None };
        let (x0, x1) = self.extent(s, 0, u, half_width, radius);
        let (y0, y1) = self.extent(s, 1, v, half_height, radius);
        kept = kept & x0.lt(x1) & y0.lt(y1);
        let mut fields = [
            u,
            v,
            sx,
            shear,
            sy,
            power,
            zero,
            zero,
            zero,
            p[2],
            half_width,
            half_height,
            x0,
            y0,
            x1,
            y1,
        ];
        for field in &mut fields[FIELDS - 4..] {
            *field = S::F::from_bits(field.to_int());
        }
        for field in &mut fields {
            *field = kept.select_or_zero(*field);
        }
        (fields, kept)
    }

    /// Computes the pixels [first, past the last) along one axis that the support intersects
    /// and, with a radius, that the tile cut keeps: whole numbers from 0 to the side.
    #[inline(always)]
    fn extent<S: Simd>(
        &self,
        s: S,
        axis: usize,
        mean: S::F,
        half: S::F,
        radius: Option<S::F>,
    ) -> (S::F, S::F) {
        let zero = s.splat(0.0);
        let side = s.splat(self.size[axis] as f32);
        let half = half + s.splat(SPAN_SLACK_PX);
        let mut first = zero.max((mean - half).ceil());
        let mut past = side.min((mean + half).floor() + s.splat(1.0));
        if let Some(r) = radius {
            const TILE_PX: f32 = TILE_MVSPLAT as f32;
            // The original truncates towards zero; the clamp below gives 0 for either.
            let tile = s.splat(1.0 / TILE_PX);
            let from = ((mean - r) * tile).floor();
            let to = ((mean + r + s.splat(TILE_PX - 1.0)) * tile).floor();
            first = first.max(from * s.splat(TILE_PX));
            past = past.min(to * s.splat(TILE_PX));
        }
        (side.min(first), zero.max(past))
    }
}

/// Computes ⌈3·√λ_max⌉ of the covariance with low-pass, px (INRIA).
#[inline(always)]
fn radius_mvsplat<S: Simd>(s: S, xx: S::F, yy: S::F, det: S::F) -> S::F {
    let mid = s.splat(0.5) * (xx + yy);
    let discriminant = s.splat(DISCRIMINANT_MIN_MVSPLAT).max(mid.fma(mid, -det));
    (s.splat(RADIUS_SIGMAS_MVSPLAT) * (mid + discriminant.sqrt()).sqrt()).ceil()
}

#[inline(always)]
fn dot_const<S: Simd>(s: S, a: [f32; 3], b: [S::F; 3]) -> S::F {
    dot([s.splat(a[0]), s.splat(a[1]), s.splat(a[2])], b)
}
