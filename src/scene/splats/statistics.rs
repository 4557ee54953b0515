//! Distribution of sizes and opacities of Gaussians.

use super::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{OPACITY_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};

/// The 10 %, 50 % and 90 % quantiles of a distribution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantiles {
    /// A tenth of the values are smaller.
    pub low: f32,
    /// The median.
    pub middle: f32,
    /// A tenth of the values are larger.
    pub high: f32,
}

impl Quantiles {
    /// Computes the quantiles of `values`; `None` without a value. NaN counts as larger than all
    /// numbers.
    pub fn of(mut values: Vec<f32>) -> Option<Self> {
        let last = values.len().checked_sub(1)?;
        let mut at = |share: f32| {
            let rank = (share * last as f32).round() as usize;
            *values.select_nth_unstable_by(rank.min(last), f32::total_cmp).1
        };
        Some(Self { low: at(0.1), middle: at(0.5), high: at(0.9) })
    }
}

/// Distribution of the Gaussians of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SplatStatistics {
    /// Number of Gaussians.
    pub count: usize,
    /// The middle one of each Gaussian's three scales, in pixels of its view: σ·f/z with the camera's
    /// mean focal length f and the Gaussian's camera z. A child that tiles its pixel has about
    /// ½. Gaussians behind their camera do not count.
    pub sigma_px: Quantiles,
    /// Opacity.
    pub opacity: Quantiles,
}

impl SplatStatistics {
    /// Computes the statistics of Gaussians that `cameras` predicted in order: an equal share of
    /// them belongs to each camera. Pixels are those of `cameras`. `None` without Gaussians before
    /// their cameras, or if the cameras do not divide the Gaussians evenly.
    pub fn new(splats: &Splats, cameras: &[Camera]) -> Option<Self> {
        let count = splats.len();
        if count == 0 || cameras.is_empty() || !count.is_multiple_of(cameras.len()) {
            return None;
        }
        let mut sigma_px = Vec::with_capacity(count);
        let views = splats.rows().chunks_exact(SPLAT_STRIDE * (count / cameras.len()));
        for (camera, rows) in cameras.iter().zip(views) {
            let (k, eye) = (camera.intrinsics(), camera.position());
            let forward = camera.rotation().z_axis;
            let focal = (k.fx * k.fy).sqrt();
            for row in rows.chunks_exact(SPLAT_STRIDE) {
                let z = forward.dot(glam::Vec3::from_slice(row) - eye);
                let mut scales = [0, 1, 2].map(|i| row[SCALE_OFFSET + i]);
                scales.sort_by(f32::total_cmp);
                if z > 0.0 {
                    sigma_px.push(scales[1] * focal / z);
                }
            }
        }
        let opacity = splats.rows().chunks_exact(SPLAT_STRIDE).map(|row| row[OPACITY_OFFSET]);
        let opacity = Quantiles::of(opacity.collect())?;
        Some(Self { count, sigma_px: Quantiles::of(sigma_px)?, opacity })
    }
}

#[cfg(test)]
mod tests {
    use super::super::SplatParts;
    use super::*;
    use glam::{Mat4, Vec3};
    use subsplat_kernels::camera::Intrinsics;
    use subsplat_kernels::layout::ShBasis;

    #[test]
    fn quantiles_are_ranks() {
        let found = Quantiles::of((0..=100).rev().map(|i| i as f32).collect()).unwrap();
        assert_eq!((found.low, found.middle, found.high), (10.0, 50.0, 90.0));
        let one = Quantiles::of(vec![3.0]).unwrap();
        assert_eq!((one.low, one.middle, one.high), (3.0, 3.0, 3.0));
        assert_eq!(Quantiles::of(Vec::new()), None);
    }

    #[test]
    fn sizes_are_pixels_of_the_own_view() {
        let k = Intrinsics { fx: 100.0, fy: 100.0, cx: 8.0, cy: 8.0, width: 16, height: 16 };
        let cameras = [0.0, -2.0]
            .map(|z| Camera::new(k, Mat4::from_translation(Vec3::new(0.0, 0.0, z))).unwrap());
        // Both stand at z = 2: 2 units before the first camera, 4 before the second.
        let row = |opacity: f32| [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.03, opacity];
        let parts = SplatParts {
            rows: [row(0.2), row(0.8)].concat(),
            sh: vec![0.0; 6],
            gain: Vec::new(),
            sh_degree: 0,
            sh_basis: ShBasis::Standard,
        };
        let splats = Splats::try_from(parts).unwrap();
        let found = SplatStatistics::new(&splats, &cameras).unwrap();
        assert_eq!(found.count, 2);
        assert!(
            (found.sigma_px.high - 1.0).abs() < 1e-6 && (found.sigma_px.low - 0.5).abs() < 1e-6
        );
        assert_eq!((found.opacity.low, found.opacity.high), (0.2, 0.8));
        assert_eq!(SplatStatistics::new(&splats, &[cameras[0]; 3]), None);
    }
}
