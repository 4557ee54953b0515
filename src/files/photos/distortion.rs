//! Models of lens distortion of pose files.
//!
//! A point (x, y) at z = 1 in camera coordinates projects to fx·x' + cx, fy·y' + cy. With
//! r² = x² + y², (x', y') is (OpenCV's and COLMAP's formulas)
//!
//! * Brown: x' = x·(1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)
//!   + 2 p1 x y + p2 (r² + 2x²), and y' alike with p1, p2 exchanged;
//! * Polynomial: x' = x·(1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2x²), y' alike with p1, p2
//!   exchanged, then x' + s·y' (Agisoft, Metashape's manual, "Camera models", with P1, P2 = p2, p1 and B2 = s·fx);
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

use glam::{DVec2, DVec3, Vec2};
use std::f64::consts::PI;

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
    /// Radial polynomial of four terms, tangential, and skew: frame cameras of Metashape and RealityCapture that
    /// [`Distortion::Brown`] lacks.
    Polynomial {
        /// k1 to k4.
        k: [f64; 4],
        /// p1, p2.
        p: [f64; 2],
        /// Skew s, in units of the focal length of x.
        skew: f64,
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

    /// Makes [`Distortion::Polynomial`], or [`Distortion::brown`] where k4 and the skew are zero.
    pub fn polynomial(k: [f64; 4], p: [f64; 2], skew: f64) -> Self {
        match k {
            [k1, k2, k3, 0.0] if skew == 0.0 => Self::brown([k1, k2, k3, 0.0, 0.0, 0.0], p),
            _ => Self::Polynomial { k, p, skew },
        }
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
            Self::Polynomial { k, p, skew } => {
                k.iter().chain(p).chain([skew]).all(|v| v.is_finite())
            }
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

    pub(super) fn distort_f64(&self, ray: DVec2) -> DVec2 {
        let r2 = ray.length_squared();
        match *self {
            Self::None => ray,
            Self::Brown { p, .. } => ray * self.radial(r2) + tangential(ray, p),
            Self::Polynomial { p, skew, .. } => {
                let DVec2 { x, y } = ray * self.radial(r2) + tangential(ray, p);
                DVec2::new(x + skew * y, y)
            }
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
                Some(uv * even_polynomial(k, t2))
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
                uv * even_polynomial(k, t2) + tangential(uv, p) + DVec2::from(s) * t2
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
            Self::Polynomial { k, .. } => even_polynomial(k, r2),
            Self::Fisheye { k } => {
                let r = r2.sqrt();
                if r < 1e-9 {
                    return 1.0;
                }
                let theta = r.atan();
                let t2 = theta * theta;
                theta * even_polynomial(k, t2) / r
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
    pub(super) fn monotone_radius(&self, limit: f64) -> f64 {
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

/// 1 + k1 t² + k2 t⁴ + k3 t⁶ + k4 t⁸, of `t2` = t².
fn even_polynomial(k: [f64; 4], t2: f64) -> f64 {
    1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_polynomial_is_metashapes() {
        // Metashape's manual, "Frame cameras": P1 belongs to (r² + 2x²), P2 to 2xy; b1 and b2 are in px.
        let ([k1, k2, k3, k4], [p1, p2], [f, b1, b2]) =
            ([-0.1, 0.03, -0.02, 0.4], [0.003, -0.005], [1500.0, 4.0, -3.0]);
        let (x, y) = (0.31, -0.42);
        let r2: f64 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3) + k4 * r2.powi(4);
        let bent_x = x * radial + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y;
        let bent_y = y * radial + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y;
        let px = [bent_x * f + bent_x * b1 + bent_y * b2, bent_y * f];
        let lens = Distortion::polynomial([k1, k2, k3, k4], [p2, p1], b2 / (f + b1));
        let seen = lens.distort_f64(DVec2::new(x, y)) * DVec2::new(f + b1, f);
        assert!((seen - DVec2::from(px)).length() < 1e-9, "{seen} {px:?}");
        let plain = Distortion::polynomial([k1, k2, k3, 0.0], [p2, p1], 0.0);
        assert_eq!(plain, Distortion::brown([k1, k2, k3, 0.0, 0.0, 0.0], [p2, p1]));
        assert!(Distortion::polynomial([0.0; 4], [0.0; 2], f64::NAN).check().is_err());
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
}
