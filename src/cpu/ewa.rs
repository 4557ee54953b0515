//! Elliptical weighted average of one splat: 3-D Gaussian to 2-D footprint (EWA
//! splatting, Zwicker et al. 2001; 3DGS section 4).
//!
//! cov2d = J·W·Σ·Wᵀ·Jᵀ + low-pass·I, J the Jacobian of the projection at the mean, W
//! the rotation from world to camera. From quaternion and σ we keep M = J·W·R·S
//! (2×3) and take det(MMᵀ) = ‖m₁ × m₂‖² (Cauchy-Binet), which no needle cancels.
//!
//! The conic is kept as its Cholesky factor, in units of log₂: with dx, dy the
//! distance of a pixel centre from the mean,
//! σ·log₂e = (sx·(dx + shear·dy))² + (sy·dy)²: never negative, no cancellation.
//!
//! Which splats are dropped: mean not in front of the near plane, opacity (after
//! antialiasing) below 1/255, no overlap with the picture, and every splat with a
//! number that is or becomes NaN or infinite, a zero quaternion included. A σ of
//! zero is a point, drawn as wide as the low-pass makes it; the sign of σ does not
//! matter; an opacity above 1 acts through the alpha cap.

use crate::abi::{
    ALPHA_MIN, ALPHA_MIN_LOG2, BLOCK, Convention, DISCRIMINANT_MIN_MVSPLAT, JACOBIAN_LIMIT_MVSPLAT,
    JACOBIAN_MARGIN_STANDARD, NEAR_MVSPLAT, RADIUS_SIGMAS_MVSPLAT, RasterOptions, TILE_MVSPLAT,
    Z_EPSILON_MVSPLAT,
};
use crate::camera::{Camera, Intrinsics};
use std::f32::consts::{LN_2, LOG2_E};

/// Relative and absolute widening of a support, in log₂ of alpha: pixels on its
/// rim are found whatever the rounding, and the per-pixel test decides.
const SUPPORT_SLACK: f32 = 1e-4;
/// Widening of a row's interval, px, for the rounding of pixel positions.
const SPAN_SLACK_PX: f32 = 1e-3;

const _: () = assert!(TILE_MVSPLAT.is_multiple_of(BLOCK), "the tile cut falls on block edges");

/// A projected splat, one cache line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Footprint {
    /// Mean, px, where pixel *centres* are integers: column 0 is at u = 0.
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
    /// Whether the splat was kept.
    pub fn visible(&self) -> bool {
        self.x1 > self.x0
    }

    /// Inverse of the 2-D covariance, low-pass included: A, B, C in 1/px².
    pub fn conic(&self) -> [f32; 3] {
        let a = 2.0 * LN_2 * self.sx * self.sx;
        let b = a * self.shear;
        [a, b, 2.0 * LN_2 * self.sy * self.sy + b * self.shear]
    }

    /// Opacity after antialiasing.
    pub fn opacity(&self) -> f32 {
        self.power.exp2()
    }

    /// Pixel columns, as a real interval, in which rows `y0..=y1` (pixel centres)
    /// can meet the support; `None` where they cannot.
    #[inline]
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

    fn is_finite(&self) -> bool {
        // A sum is finite only if no term is NaN or infinite, bar overflow of huge
        // finite terms, which is dropped alike.
        (self.u + self.v + self.sx + self.shear + self.sy + self.power + self.z).is_finite()
            && (self.half_width + self.half_height).is_finite()
    }
}

/// log₂(255·opacity) from `power` = log₂ opacity, with slack: where the exponent of
/// an alpha has fallen by this much, it is below 1/255.
fn support(power: f32) -> f32 {
    let reach = power - ALPHA_MIN_LOG2;
    reach + SUPPORT_SLACK * (1.0 + reach)
}

/// A camera and the options of a call, as projection needs them.
#[derive(Clone, Debug)]
pub struct View {
    /// Rows of the rotation from world to camera.
    pub(crate) rows: [[f32; 3]; 3],
    /// The eye, world.
    pub(crate) eye: [f32; 3],
    pub(crate) focal: [f32; 2],
    /// Pixel position of the axis, centres at integers.
    centre: [f32; 2],
    /// Intervals to which x/z and y/z are clamped inside J.
    pub(crate) limit: [(f32, f32); 2],
    near: f32,
    pub(crate) z_epsilon: f32,
    lowpass: f32,
    pub(crate) antialiased: bool,
    tile_cut: bool,
    size: [usize; 2],
}

impl View {
    /// What `camera` and `options` mean for projection.
    pub fn new(camera: &Camera, options: &RasterOptions) -> Self {
        let k = &camera.intrinsics;
        let size = [k.width, k.height];
        let sides = [k.width as f32, k.height as f32];
        let rotation = camera.rotation();
        let standard = options.convention == Convention::Standard;
        let (focal, centre, limit) = if standard {
            let focal = [k.fx, k.fy];
            let principal = [k.cx, k.cy];
            let limit = std::array::from_fn(|i| {
                let margin = JACOBIAN_MARGIN_STANDARD * 0.5 * sides[i] / focal[i];
                let (low, high) = (principal[i] / focal[i], (sides[i] - principal[i]) / focal[i]);
                (-low - margin, high + margin)
            });
            (focal, principal.map(|c| c - 0.5), limit)
        } else {
            let tan = tan_half_fov(k);
            let focal = std::array::from_fn(|i| 0.5 * sides[i] / tan[i]);
            let limit = tan.map(|t| (-JACOBIAN_LIMIT_MVSPLAT * t, JACOBIAN_LIMIT_MVSPLAT * t));
            (focal, sides.map(|s| 0.5 * s - 0.5), limit)
        };
        let near = if standard { options.near } else { NEAR_MVSPLAT * options.near };
        Self {
            rows: std::array::from_fn(|i| rotation.col(i).to_array()),
            eye: camera.position().to_array(),
            focal,
            centre,
            limit,
            // z = 0 projects nowhere, whatever the caller's near plane.
            near: near.max(f32::MIN_POSITIVE),
            z_epsilon: if standard { 0.0 } else { Z_EPSILON_MVSPLAT * options.near },
            lowpass: options.lowpass,
            antialiased: standard && options.antialiased,
            tile_cut: !standard,
            size,
        }
    }

    /// World to camera, as Rᵀ(p − t).
    #[inline(always)]
    pub(crate) fn to_camera(&self, p: [f32; 3]) -> [f32; 3] {
        let d = [p[0] - self.eye[0], p[1] - self.eye[1], p[2] - self.eye[2]];
        self.rows.map(|r| dot(r, d))
    }

    /// Rows of J·W at a point in camera coordinates, px per world unit.
    fn jacobian_in_world(&self, p: [f32; 3]) -> [[f32; 3]; 2] {
        let [x, y, z] = self.rows;
        std::array::from_fn(|i| {
            let (low, high) = self.limit[i];
            let slope = (p[i] / p[2]).max(low).min(high);
            let f = self.focal[i] / p[2];
            let axis = if i == 0 { x } else { y };
            std::array::from_fn(|c| f * (axis[c] - slope * z[c]))
        })
    }

    /// The footprint of a splat given by quaternion (wxyz, any length) and σ; its
    /// colour stays 0. `None` where the splat is dropped.
    pub fn project_quat(
        &self,
        mean: [f32; 3],
        quat: [f32; 4],
        scale: [f32; 3],
        opacity: f32,
    ) -> Option<Footprint> {
        let p = self.in_front(mean)?;
        let r = rotation(quat)?;
        let j = self.jacobian_in_world(p);
        // M = J·W·R·S: row i, column k.
        let m: [[f32; 3]; 2] = std::array::from_fn(|i| {
            std::array::from_fn(|k| dot(j[i], [r[0][k], r[1][k], r[2][k]]) * scale[k])
        });
        let n = cross(m[0], m[1]);
        let covariance = Covariance2d {
            xx: dot(m[0], m[0]),
            xy: dot(m[0], m[1]),
            yy: dot(m[1], m[1]),
            det: dot(n, n),
        };
        self.footprint(p, covariance, opacity)
    }

    /// The same from a world covariance `cov6` = (00, 01, 02, 11, 12, 22).
    pub fn project_cov6(&self, mean: [f32; 3], cov6: [f32; 6], opacity: f32) -> Option<Footprint> {
        let p = self.in_front(mean)?;
        let j = self.jacobian_in_world(p).map(|r| r.map(f64::from));
        let [a, b, c, d, e, f] = cov6.map(f64::from);
        let apply = |v: [f64; 3]| {
            [
                a * v[0] + b * v[1] + c * v[2],
                b * v[0] + d * v[1] + e * v[2],
                c * v[0] + e * v[1] + f * v[2],
            ]
        };
        let inner = |u: [f64; 3], v: [f64; 3]| u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
        let (sx, sy) = (apply(j[0]), apply(j[1]));
        let (xx, xy, yy) = (inner(j[0], sx), inner(j[0], sy), inner(j[1], sy));
        let covariance = Covariance2d {
            xx: xx as f32,
            xy: xy as f32,
            yy: yy as f32,
            det: (xx * yy - xy * xy) as f32,
        };
        self.footprint(p, covariance, opacity)
    }

    fn in_front(&self, mean: [f32; 3]) -> Option<[f32; 3]> {
        let p = self.to_camera(mean);
        (p[2] > self.near).then_some(p)
    }

    fn footprint(&self, p: [f32; 3], c: Covariance2d, opacity: f32) -> Option<Footprint> {
        let xx = c.xx + self.lowpass;
        let yy = c.yy + self.lowpass;
        let det = c.det + self.lowpass * (c.xx + c.yy) + self.lowpass * self.lowpass;
        let mut opacity = opacity;
        if self.antialiased {
            opacity *= (c.det / det).max(0.0).sqrt();
        }
        // Written so that NaN fails each test.
        if !(opacity >= ALPHA_MIN && det > 0.0 && det.is_finite() && xx > 0.0 && yy > 0.0) {
            return None;
        }
        let power = opacity.log2();
        let reach = 2.0 * LN_2 * support(power);
        let z = p[2] + self.z_epsilon;
        let mut f = Footprint {
            u: self.focal[0] * p[0] / z + self.centre[0],
            v: self.focal[1] * p[1] / z + self.centre[1],
            sx: (0.5 * LOG2_E * (yy / det)).sqrt(),
            shear: -c.xy / yy,
            sy: (0.5 * LOG2_E / yy).sqrt(),
            power,
            z: p[2],
            half_width: (reach * xx).sqrt(),
            half_height: (reach * yy).sqrt(),
            ..Footprint::default()
        };
        let radius = self.tile_cut.then(|| radius_mvsplat(xx, yy, det));
        let (x0, x1) = self.extent(0, f.u, f.half_width, radius);
        let (y0, y1) = self.extent(1, f.v, f.half_height, radius);
        if !f.is_finite() || x0 >= x1 || y0 >= y1 {
            return None;
        }
        (f.x0, f.x1, f.y0, f.y1) = (x0, x1, y0, y1);
        Some(f)
    }

    /// Pixels [first, past the last) along one axis that the support meets and,
    /// with a radius, that the tile cut leaves.
    fn extent(&self, axis: usize, mean: f32, half: f32, radius: Option<f32>) -> (u32, u32) {
        let side = self.size[axis];
        let half = half + SPAN_SLACK_PX;
        let first = (mean - half).ceil().max(0.0) as usize;
        let past = ((mean + half).floor() + 1.0).max(0.0) as usize;
        let (mut first, mut past) = (first, past.min(side));
        if let Some(r) = radius {
            const TILE_PX: f32 = TILE_MVSPLAT as f32;
            // `as` truncates towards zero as the original's cast does; below 0 is 0.
            let from = ((mean - r) / TILE_PX) as usize;
            let to = ((mean + r + (TILE_PX - 1.0)) / TILE_PX) as usize;
            first = first.max(from.saturating_mul(TILE_MVSPLAT));
            past = past.min(to.saturating_mul(TILE_MVSPLAT));
        }
        (first.min(side) as u32, past as u32)
    }
}

/// J·Σ·Jᵀ before the low-pass, px² (det: px⁴).
struct Covariance2d {
    xx: f32,
    xy: f32,
    yy: f32,
    det: f32,
}

/// ⌈3·√λ_max⌉ of the covariance with low-pass, px (INRIA).
fn radius_mvsplat(xx: f32, yy: f32, det: f32) -> f32 {
    let mid = 0.5 * (xx + yy);
    let largest = mid + (mid * mid - det).max(DISCRIMINANT_MIN_MVSPLAT).sqrt();
    (RADIUS_SIGMAS_MVSPLAT * largest.sqrt()).ceil()
}

/// tan of half the angle between the rays through the middles of opposite picture
/// edges, horizontally and vertically, as MVSplat derives its frustum.
fn tan_half_fov(k: &Intrinsics) -> [f32; 2] {
    let (w, h) = (k.width as f64, k.height as f64);
    let ray = |u: f64, v: f64| {
        glam::DVec3::new(
            (u - f64::from(k.cx)) / f64::from(k.fx),
            (v - f64::from(k.cy)) / f64::from(k.fy),
            1.0,
        )
    };
    let half =
        |a: glam::DVec3, b: glam::DVec3| (0.5 * a.cross(b).length().atan2(a.dot(b))).tan() as f32;
    [half(ray(0.0, 0.5 * h), ray(w, 0.5 * h)), half(ray(0.5 * w, 0.0), ray(0.5 * w, h))]
}

/// Rotation matrix, row-major, of a quaternion wxyz of any length above 1e-19.
fn rotation(q: [f32; 4]) -> Option<[[f32; 3]; 3]> {
    let norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    if !(norm2 >= f32::MIN_POSITIVE && norm2.is_finite()) {
        return None;
    }
    let s = 2.0 / norm2;
    let [w, x, y, z] = q;
    Some([
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ])
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
