//! Lens distortion: the models of pose files, and their removal.
//!
//! A point (x, y) at z = 1 in camera coordinates projects to fx·x' + cx, fy·y' + cy. With
//! r² = x² + y², (x', y') is (OpenCV's and COLMAP's formulas)
//!
//! * Brown: x' = x·(1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)
//!   + 2 p1 x y + p2 (r² + 2x²), and y' alike with p1, p2 exchanged;
//! * Fisheye: (x', y') = (x, y)·θ_d/r, θ = atan r, θ_d = θ(1 + k1 θ² + … + k4 θ⁸);
//! * ThinPrismFisheye: (u, v) = (x, y)·θ/r with ρ² = u² + v², then x' = u(1 + k1 ρ² + … + k4 ρ⁸)
//!   + 2 p1 u v + p2 (ρ² + 2u²) + s1 ρ², and y' alike with p1, p2 exchanged and s2 (J. Weng et al. 1992);
//! * RadTanThinPrismFisheye: (a, b) = (u, v)(1 + k1 ρ² + … + k6 ρ¹²), R² = a² + b², then
//!   x' = a + 2 p2 a b + p1 (R² + 2a²) + s1 R² + s2 R⁴, and y' alike with p1, p2 exchanged and s3, s4
//!   (Project Aria, "Camera intrinsic models", Fisheye624);
//! * Fov: (x', y') = (x, y)·atan(2 r tan(ω/2))/(r ω) (F. Devernay and O. Faugeras 2001);
//! * Division: (x', y') = (x, y)·2/(1 + √(1 − 4 k r²)) (A. Fitzgibbon 2001);
//! * Equirectangular: x' = atan2(x, z), y' = atan(y/√(x² + z²)): longitude and latitude.
//!
//! Fisheye lenses and panoramas project directions beside and behind the camera as well
//! ([`Distortion::project`]); pinhole views of them are cut out in `views.rs`.
//!
//! The undistorted picture has the stored size and principal point. Both focal lengths are
//! multiplied by the smallest factor for which every pixel lies inside the photograph: the
//! picture has no black border and keeps its aspect. Sampling is bicubic (a = −½), clamped
//! at the photograph's edge.

use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DVec2, DVec3, Vec2};
use rayon::prelude::*;
use std::f64::consts::PI;
use subsplat_kernels::camera::Intrinsics;

/// A model of lens distortion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Distortion {
    /// A pinhole.
    #[default]
    None,
    /// Radial (rational) and tangential: COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and
    /// FULL_OPENCV.
    Brown {
        /// k1, k2, k3 of the numerator, k4, k5, k6 of the denominator.
        k: [f64; 6],
        /// p1, p2.
        p: [f64; 2],
    },
    /// Equidistant with a polynomial: COLMAP's OPENCV_FISHEYE.
    Fisheye {
        /// k1 to k4.
        k: [f64; 4],
    },
    /// Fisheye with tangential distortion and a thin prism: COLMAP's THIN_PRISM_FISHEYE.
    ThinPrismFisheye {
        /// k1 to k4.
        k: [f64; 4],
        /// p1, p2.
        p: [f64; 2],
        /// s1, s2.
        s: [f64; 2],
    },
    /// The same with more terms: COLMAP's RAD_TAN_THIN_PRISM_FISHEYE.
    RadTanThinPrismFisheye {
        /// k1 to k6.
        k: [f64; 6],
        /// p1, p2.
        p: [f64; 2],
        /// s1 to s4.
        s: [f64; 4],
    },
    /// COLMAP's FOV.
    Fov {
        /// Angle ω, radians.
        omega: f64,
    },
    /// COLMAP's SIMPLE_DIVISION and DIVISION.
    Division {
        /// k.
        k: f64,
    },
    /// A panorama of 360° by 180°, or a part of one. The focal length is px per radian, the principal point lies
    /// straight ahead.
    Equirectangular,
}

impl Distortion {
    /// Makes [`Distortion::Brown`], or `None` if every coefficient is zero.
    pub fn brown(k: [f64; 6], p: [f64; 2]) -> Self {
        if k == [0.0; 6] && p == [0.0; 2] { Self::None } else { Self::Brown { k, p } }
    }

    /// Makes [`Distortion::Fisheye`], with zero coefficients too.
    pub fn fisheye(k: [f64; 4]) -> Self {
        Self::Fisheye { k }
    }

    /// Checks that the coefficients are finite; an error lists them.
    pub(in crate::files) fn check(&self) -> Result<(), String> {
        let finite = match self {
            Self::None => true,
            Self::Brown { k, p } => k.iter().chain(p).all(|v| v.is_finite()),
            Self::Fisheye { k } => k.iter().all(|v| v.is_finite()),
            Self::ThinPrismFisheye { k, p, s } => k.iter().chain(p).chain(s).all(|v| v.is_finite()),
            Self::RadTanThinPrismFisheye { k, p, s } => {
                k.iter().chain(p).chain(s).all(|v| v.is_finite())
            }
            Self::Fov { omega } => omega.abs() < PI,
            Self::Division { k } => k.is_finite(),
            Self::Equirectangular => true,
        };
        if finite { Ok(()) } else { Err(format!("{self:?}")) }
    }

    /// Maps a ray (x, y, 1) to its distorted position on the plane z = 1.
    pub fn distort(&self, ray: Vec2) -> Vec2 {
        self.distort_f64(ray.as_dvec2()).as_vec2()
    }

    fn distort_f64(&self, ray: DVec2) -> DVec2 {
        let r2 = ray.length_squared();
        match *self {
            Self::None => ray,
            Self::Brown { p, .. } => ray * self.radial(r2) + tangential(ray, p),
            Self::Fisheye { .. } | Self::Fov { .. } | Self::Division { .. } => {
                ray * self.radial(r2)
            }
            Self::ThinPrismFisheye { .. } | Self::RadTanThinPrismFisheye { .. } => {
                let r = r2.sqrt();
                self.bent(ray * if r < 1e-9 { 1.0 } else { r.atan() / r })
            }
            Self::Equirectangular => longitude_latitude(ray.extend(1.0)),
        }
    }

    /// Projects a direction of the lens's axes, of any length, to its distorted position on the plane z = 1.
    /// Fisheye lenses see directions of up to 180° from their axis, panoramas all, other lenses those in front.
    /// `None` where the lens does not see the direction.
    pub fn project(&self, direction: DVec3) -> Option<DVec2> {
        let DVec3 { x, y, z } = direction;
        let theta = || {
            let r = x.hypot(y);
            let theta = r.atan2(z);
            // Straight behind, no direction in the picture is right.
            let scale = if r < 1e-9 * z.abs() { 1.0 / z } else { theta / r };
            (r > 0.0 || z > 0.0).then_some(DVec2::new(x, y) * scale)
        };
        match *self {
            Self::Equirectangular => Some(longitude_latitude(direction)),
            Self::Fisheye { k } => {
                let uv = theta()?;
                let t2 = uv.length_squared();
                Some(uv * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))))
            }
            Self::ThinPrismFisheye { .. } | Self::RadTanThinPrismFisheye { .. } => {
                Some(self.bent(theta()?))
            }
            _ if z > 0.0 => Some(self.distort_f64(DVec2::new(x, y) / z)),
            _ => None,
        }
    }

    /// Applies the terms of the thin-prism models to a direction (u, v) of length θ.
    fn bent(&self, uv: DVec2) -> DVec2 {
        let t2 = uv.length_squared();
        match *self {
            Self::ThinPrismFisheye { k, p, s } => {
                let radial = 1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])));
                uv * radial + tangential(uv, p) + DVec2::from(s) * t2
            }
            Self::RadTanThinPrismFisheye { k, p, s } => {
                let radial = k.iter().rev().fold(0.0, |sum, k| (sum + k) * t2);
                let ab = uv * (1.0 + radial);
                let r2 = ab.length_squared();
                let prism = DVec2::new(r2 * (s[0] + r2 * s[1]), r2 * (s[2] + r2 * s[3]));
                ab + tangential(ab, [p[1], p[0]]) + prism
            }
            _ => uv,
        }
    }

    /// Returns r'/r of the radial part.
    fn radial(&self, r2: f64) -> f64 {
        match *self {
            Self::None => 1.0,
            Self::Brown { k, .. } => {
                let top = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
                let bottom = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
                top / bottom
            }
            Self::Fisheye { k } => {
                let r = r2.sqrt();
                if r < 1e-9 {
                    return 1.0;
                }
                let theta = r.atan();
                let t2 = theta * theta;
                theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
            }
            Self::ThinPrismFisheye { k, .. } => Self::Fisheye { k }.radial(r2),
            Self::RadTanThinPrismFisheye { k, .. } => {
                let r = r2.sqrt();
                if r < 1e-9 {
                    return 1.0;
                }
                let t2 = r.atan().powi(2);
                r.atan() * (1.0 + k.iter().rev().fold(0.0, |sum, k| (sum + k) * t2)) / r
            }
            Self::Fov { omega } => {
                let r = r2.sqrt();
                let slope = 2.0 * (0.5 * omega).tan();
                // The limit of a small angle is a pinhole.
                if omega.abs() < 1e-6 {
                    1.0
                } else if r * slope.abs() < 1e-6 {
                    slope / omega
                } else {
                    (r * slope).atan() / (r * omega)
                }
            }
            // A root of a negative number is NaN: the lens does not see the ray.
            Self::Division { k } => 2.0 / (1.0 + (1.0 - 4.0 * k * r2).sqrt()),
            Self::Equirectangular => 1.0,
        }
    }

    /// Returns the largest radius at z = 1, up to `limit`, below which r' grows. Beyond it the
    /// polynomial folds back and no longer describes the lens.
    fn monotone_radius(&self, limit: f64) -> f64 {
        const STEPS: usize = 512;
        let mut last = 0.0;
        for i in 1..=STEPS {
            let r = limit * i as f64 / STEPS as f64;
            let distorted = r * self.radial(r * r);
            if distorted.is_nan() || distorted <= last {
                return limit * (i - 1) as f64 / STEPS as f64;
            }
            last = distorted;
        }
        limit
    }
}

/// Tangential distortion of OpenCV at a point.
fn tangential(at: DVec2, p: [f64; 2]) -> DVec2 {
    let DVec2 { x, y } = at;
    let (r2, xy) = (at.length_squared(), 2.0 * x * y);
    DVec2::new(p[0] * xy + p[1] * (r2 + 2.0 * x * x), p[1] * xy + p[0] * (r2 + 2.0 * y * y))
}

/// Longitude, to the right, and latitude, down, of a direction, radians.
fn longitude_latitude(direction: DVec3) -> DVec2 {
    let DVec3 { x, y, z } = direction;
    DVec2::new(x.atan2(z), y.atan2(x.hypot(z)))
}

/// Range of the focal factor. Below ½, the middle would have a quarter of its pixels; above
/// 4, a sixteenth of the picture would remain.
const FOCAL_FACTORS: [f64; 2] = [0.5, 4.0];

/// Computes the pinhole of the undistorted picture (see the module's documentation).
///
/// # Errors
/// The distortion, where four times the focal length still leaves a black border.
pub fn pinhole(k: &Intrinsics, distortion: &Distortion) -> Result<Intrinsics, String> {
    if *distortion == Distortion::None {
        return Ok(*k);
    }
    let [mut low, mut high] = FOCAL_FACTORS;
    let corner = border(k).map(|px| ray(k, px).length()).fold(0.0, f64::max);
    let fold = distortion.monotone_radius(corner / low);
    let covered = |factor: f64| {
        border(k).all(|px| {
            let r = ray(k, px) / factor;
            let seen = distortion.distort_f64(r);
            let u = f64::from(k.fx) * seen.x + f64::from(k.cx);
            let v = f64::from(k.fy) * seen.y + f64::from(k.cy);
            // A NaN fails every comparison.
            r.length() <= fold
                && (0.0..=k.width as f64).contains(&u)
                && (0.0..=k.height as f64).contains(&v)
        })
    };
    if !covered(high) {
        return Err(format!("{distortion:?}, which leaves no rectangle inside the picture"));
    }
    if covered(low) {
        high = low;
    }
    // 30 bisections: a millionth of a pixel.
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if covered(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    Ok(Intrinsics {
        fx: (f64::from(k.fx) * high) as f32,
        fy: (f64::from(k.fy) * high) as f32,
        ..*k
    })
}

/// Iterates over the centres of the pixels along the picture's edge.
pub(super) fn border(k: &Intrinsics) -> impl Iterator<Item = DVec2> {
    let (w, h) = (k.width, k.height);
    let rows = (0..w).flat_map(move |x| [(x, 0), (x, h - 1)]);
    let columns = (0..h).flat_map(move |y| [(0, y), (w - 1, y)]);
    rows.chain(columns).map(|(x, y)| DVec2::new(x as f64 + 0.5, y as f64 + 0.5))
}

/// The ray (x, y, 1) of a pixel position, without its z.
pub(super) fn ray(k: &Intrinsics, px: DVec2) -> DVec2 {
    DVec2::new(
        (px.x - f64::from(k.cx)) / f64::from(k.fx),
        (px.y - f64::from(k.cy)) / f64::from(k.fy),
    )
}

/// Resamples the photograph of a lens with `distortion` and intrinsics `from` to the pinhole
/// `to`.
pub fn undistort(photo: &Rgb, from: &Intrinsics, distortion: &Distortion, to: &Intrinsics) -> Rgb {
    resample(photo, to, Edge::Clamped, |px| Some(source(px, from, distortion, to)))
}

/// [`undistort`] of a photograph with a mask of its pixels. A pixel has the mask of the photograph's pixel at
/// its place. What is masked does not mix into pixels that count: the interpolation reads the colours around
/// instead ([`Mask::filled`]).
pub fn undistort_masked(
    photo: &Rgb,
    mask: &Mask,
    from: &Intrinsics,
    distortion: &Distortion,
    to: &Intrinsics,
) -> (Rgb, Option<Mask>) {
    let source = |px| Some(source(px, from, distortion, to));
    resample_masked(photo, mask, to, Edge::Clamped, source)
}

/// Pixels beside the left and the right edge of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Edge {
    /// Those of the edge.
    Clamped,
    /// Those of the other edge: a panorama.
    Wrapped,
}

/// Samples `photo` at the places that `source` gives for the pixels of a picture of the size of `to`; black where
/// there is none.
pub(super) fn resample(
    photo: &Rgb,
    to: &Intrinsics,
    edge: Edge,
    source: impl Fn(DVec2) -> Option<[f64; 2]> + Sync,
) -> Rgb {
    let mut out = Rgb::black(to.width, to.height);
    if out.data.is_empty() || photo.data.is_empty() {
        return out;
    }
    out.data.par_chunks_mut(3 * to.width).enumerate().for_each(|(y, line)| {
        for (x, pixel) in line.chunks_exact_mut(3).enumerate() {
            let px = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            if let Some([u, v]) = source(px) {
                pixel.copy_from_slice(&sample(photo, u as f32, v as f32, edge));
            }
        }
    });
    out
}

/// [`resample`] with a mask, as [`undistort_masked`].
pub(super) fn resample_masked(
    photo: &Rgb,
    mask: &Mask,
    to: &Intrinsics,
    edge: Edge,
    source: impl Fn(DVec2) -> Option<[f64; 2]> + Sync,
) -> (Rgb, Option<Mask>) {
    let mut out = resample(photo, to, edge, &source);
    if !mask.fits(photo) {
        return (out, None);
    }
    let at = |i: usize| {
        let px = DVec2::new((i % to.width) as f64 + 0.5, (i / to.width) as f64 + 0.5);
        let Some([u, v]) = source(px) else { return false };
        // `as` saturates: any position gives a valid index.
        let (x, y) = ((u as usize).min(mask.width() - 1), (v as usize).min(mask.height() - 1));
        mask.kept()[y * mask.width() + x]
    };
    let kept: Vec<bool> = (0..to.width * to.height).into_par_iter().map(at).collect();
    let clean = resample(&mask.filled(photo), to, edge, &source);
    let pixels = out.data.chunks_exact_mut(3).zip(clean.data.chunks_exact(3));
    for ((pixel, clean), _) in pixels.zip(&kept).filter(|(_, kept)| **kept) {
        pixel.copy_from_slice(clean);
    }
    (out, Mask::new(to.width, to.height, kept))
}

/// Position in the photograph that pixel position `px` of the pinhole `to` shows, px.
fn source(px: DVec2, from: &Intrinsics, distortion: &Distortion, to: &Intrinsics) -> [f64; 2] {
    let seen = distortion.distort_f64(ray(to, px));
    [
        f64::from(from.fx) * seen.x + f64::from(from.cx),
        f64::from(from.fy) * seen.y + f64::from(from.cy),
    ]
}

/// Computes the weights of the neighbours at −1, 0, 1, 2 of a position `t` in [0, 1) (cubic
/// convolution, a = −½).
fn cubic(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        -0.5 * t + t2 - 0.5 * t3,
        1.0 - 2.5 * t2 + 1.5 * t3,
        0.5 * t + 2.0 * t2 - 1.5 * t3,
        -0.5 * t2 + 0.5 * t3,
    ]
}

/// Samples bicubically at pixel position (u, v), clamped at the upper and the lower edge.
fn sample(photo: &Rgb, u: f32, v: f32, edge: Edge) -> [u8; 3] {
    let (u, v) = (u - 0.5, v - 0.5);
    let (x0, y0) = (u.floor(), v.floor());
    let (wx, wy) = (cubic(u - x0), cubic(v - y0));
    // `as` saturates: any position gives a valid index.
    let at = |i: f32, n: usize| (i.max(0.0) as usize).min(n - 1);
    let column = |i: f32| match edge {
        Edge::Clamped => at(i, photo.width),
        Edge::Wrapped => at(i.rem_euclid(photo.width as f32), photo.width),
    };
    let mut sum = [0.0f32; 3];
    for (j, wy) in wy.into_iter().enumerate() {
        let row = at(y0 + j as f32 - 1.0, photo.height) * photo.width;
        for (i, wx) in wx.into_iter().enumerate() {
            let p = 3 * (row + column(x0 + i as f32 - 1.0));
            for (s, v) in sum.iter_mut().zip(&photo.data[p..p + 3]) {
                *s += wx * wy * f32::from(*v);
            }
        }
    }
    sum.map(|s| (s + 0.5) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics =
        Intrinsics { fx: 200.0, fy: 210.0, cx: 155.0, cy: 122.0, width: 320, height: 240 };

    fn lenses() -> Vec<Distortion> {
        vec![
            Distortion::brown([-0.2, 0.05, 0.0, 0.0, 0.0, 0.0], [0.001, -0.002]),
            Distortion::brown([0.15, 0.0, 0.01, 0.0, 0.0, 0.0], [0.0, 0.0]),
            Distortion::brown([0.3, 0.1, 0.0, 0.5, 0.05, 0.0], [0.0, 0.0]),
            Distortion::fisheye([0.02, -0.01, 0.0, 0.0]),
            Distortion::Fov { omega: 0.9 },
            Distortion::Division { k: -0.15 },
            Distortion::ThinPrismFisheye {
                k: [0.02, -0.01, 0.005, -0.002],
                p: [0.003, -0.004],
                s: [0.001, -0.002],
            },
            Distortion::RadTanThinPrismFisheye {
                k: [0.02, -0.01, 0.005, -0.002, 0.001, -0.0005],
                p: [0.003, -0.004],
                s: [0.001, -0.002, 0.0015, 0.0005],
            },
        ]
    }

    /// Values by tools/make_distortion_golden.py (OpenCV 5.0.0).
    #[test]
    fn distort_is_opencvs() {
        let rays = [(0.3, -0.2), (-0.5, 0.4), (0.7, 0.1)];
        let table = [
            (
                Distortion::brown(
                    [0.0578421, -0.0805099, 0.0, 0.0, 0.0, 0.0],
                    [-0.000980296, 0.00015575],
                ),
                [
                    (0.302013575, -0.201456323),
                    (-0.504556923, 0.403294703),
                    (0.706248771, 0.100391409),
                ],
            ),
            (
                Distortion::brown([-0.2, 0.05, 0.03, 0.0, 0.0, 0.0], [0.01, -0.02]),
                [(0.285073273, -0.190482182), (-0.486436315, 0.386689052), (0.613175, 0.094025)],
            ),
            (
                Distortion::brown([0.3, 0.1, -0.02, 0.5, 0.05, 0.01], [0.003, 0.004]),
                [
                    (0.293781297, -0.195117531),
                    (-0.466399885, 0.375661908),
                    (0.655795984, 0.094899426),
                ],
            ),
            (
                Distortion::fisheye([0.0; 4]),
                [
                    (0.287928451, -0.1919523),
                    (-0.444731961, 0.355785569),
                    (0.609293826, 0.087041975),
                ],
            ),
            (
                Distortion::fisheye([0.02, -0.01, 0.005, -0.002]),
                [
                    (0.288579096, -0.192386064),
                    (-0.44721523, 0.357772184),
                    (0.613176193, 0.087596599),
                ],
            ),
        ];
        for (lens, seen) in table {
            for (ray, want) in rays.into_iter().zip(seen) {
                let got = lens.distort_f64(ray.into());
                assert!((got - DVec2::from(want)).length() < 1e-8, "{lens:?} {ray:?}: {got}");
            }
            assert_eq!(lens.distort(Vec2::ZERO).x, lens.distort_f64(DVec2::ZERO).x as f32);
        }
    }

    #[test]
    fn the_new_pinhole_touches_the_border_and_stays_inside() {
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            let (mut inside, mut closest) = (true, f64::MAX);
            for px in border(&new) {
                let d = lens.distort_f64(ray(&new, px));
                let u = f64::from(K.fx) * d.x + f64::from(K.cx);
                let v = f64::from(K.fy) * d.y + f64::from(K.cy);
                let edge = u.min(v).min(320.0 - u).min(240.0 - v);
                inside &= edge > -1e-3;
                closest = closest.min(edge);
            }
            assert!(inside && closest < 1e-2, "{lens:?} {new:?} {closest}");
            assert!((new.fx / K.fx - new.fy / K.fy).abs() < 1e-6);
        }
    }

    #[test]
    fn barrel_is_widened_and_pincushion_zoomed() {
        assert!(
            pinhole(&K, &Distortion::brown([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])).unwrap().fx
                < K.fx
        );
        assert!(
            pinhole(&K, &Distortion::brown([0.2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])).unwrap().fx
                > K.fx
        );
    }

    #[test]
    fn a_grid_becomes_straight() {
        // The photograph shows u of the ray in red and v in green, bent by the lens.
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            // Inverse of `distort` by fixed-point iteration, for the test alone.
            let straight = |px: DVec2| {
                let seen = ray(&K, px);
                let mut r = seen;
                for _ in 0..200 {
                    r += 0.7 * (seen - lens.distort_f64(r));
                }
                r
            };
            let mut photo = Rgb::black(K.width, K.height);
            let shade = |v: f64| (128.0 + 100.0 * v).clamp(0.0, 255.0).round() as u8;
            for y in 0..K.height {
                for x in 0..K.width {
                    let r = straight(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                    let p = 3 * (y * K.width + x);
                    photo.data[p] = shade(r.x);
                    photo.data[p + 1] = shade(r.y);
                }
            }
            let out = undistort(&photo, &K, &lens, &new);
            for (i, pixel) in out.data.chunks_exact(3).enumerate() {
                let at = DVec2::new((i % K.width) as f64 + 0.5, (i / K.width) as f64 + 0.5);
                let r = ray(&new, at);
                for (got, want) in [(pixel[0], shade(r.x)), (pixel[1], shade(r.y))] {
                    assert!(got.abs_diff(want) <= 2, "{lens:?} at {at}: {got} not {want}");
                }
            }
        }
    }

    #[test]
    fn masked_pixels_do_not_mix_into_the_others() {
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            let mut photo = Rgb { data: vec![90; 3 * 320 * 240], ..Rgb::black(320, 240) };
            let masked = |x: f64, y: f64| (x - 130.0).hypot(y - 100.0) < 50.0;
            let kept: Vec<bool> = (0..320 * 240)
                .map(|i| !masked((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5))
                .collect();
            for (pixel, kept) in photo.data.chunks_exact_mut(3).zip(&kept) {
                if !kept {
                    pixel.fill(255);
                }
            }
            let mask = Mask::new(320, 240, kept).unwrap();
            let (out, moved) = undistort_masked(&photo, &mask, &K, &lens, &new);
            let moved = moved.unwrap();
            let mut counts = [0, 0];
            for (i, (pixel, kept)) in out.data.chunks_exact(3).zip(moved.kept()).enumerate() {
                let r = ray(&new, DVec2::new((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5));
                let seen = lens.distort_f64(r);
                let distance = (200.0 * seen.x + 155.0 - 130.0).hypot(210.0 * seen.y + 22.0);
                assert!((distance - 50.0).abs() < 1.0 || *kept == (distance > 50.0));
                assert!(!kept || pixel == [90; 3], "{lens:?} {i}: {pixel:?}");
                counts[usize::from(*kept)] += 1;
            }
            assert!(counts[0] > 2000 && counts[1] > 20_000, "{counts:?}");
        }
    }

    #[test]
    fn a_lens_that_folds_is_refused_or_cut_before_the_fold() {
        // r' = r(1 − 2r²) turns back at r = 0.41; the picture's corner is at 0.97.
        let lens = Distortion::brown([-2.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        let new = pinhole(&K, &lens).unwrap();
        let corner = border(&new).map(|px| ray(&new, px).length()).fold(0.0, f64::max);
        assert!(corner <= 0.41, "{corner}");
        let lens = Distortion::brown([-200.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        assert!(pinhole(&K, &lens).is_err());
        let lens = Distortion::brown([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        assert!(pinhole(&K, &lens).is_err());
    }
}
