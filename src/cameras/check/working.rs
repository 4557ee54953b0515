//! The photographs and cameras of a check at one working size.

use super::CheckOptions;
use crate::cameras::matches::GrayImage;
use glam::DVec2;
use subsplat_kernels::camera::Camera;

/// Longer side of the photographs at which errors are reported, px.
pub(crate) const REPORT_SIDE: f64 = 640.0;
/// A match agrees with an epipolar geometry within this many px at 640. The limit is three times
/// the error of good poses of real photographs (0.3 to 0.6 measured).
pub(super) const LIMIT_PX: f64 = 1.5;
/// Smallest limit, px of the working size: the accuracy of a feature.
const LIMIT_WORKING_PX: f64 = 1.0;

/// Two photographs at the working size, with their cameras.
pub(super) struct WorkingPair {
    /// Photographs reduced to the working size.
    pub images: [GrayImage; 2],
    /// Cameras of the reduced photographs.
    pub cameras: [Camera; 2],
    /// Working px per px of the photograph, (x, y).
    pub scale: [DVec2; 2],
    /// Working px per px of the reported scale ([`REPORT_SIDE`]).
    pub px_per_report_px: f64,
}

impl WorkingPair {
    /// Reduces photographs and cameras to the working size.
    pub(super) fn new(
        images: [&GrayImage; 2],
        cameras: [Camera; 2],
        options: &CheckOptions,
    ) -> Self {
        let target = options.longest_side.max(16);
        let reduced = images.map(|image| {
            let (w, h) = (image.width(), image.height());
            let factor = (target as f64 / w.max(h) as f64).min(1.0);
            let side = |v: usize| ((v as f64 * factor).round() as usize).clamp(1, v);
            if factor < 1.0 { image.reduced(side(w), side(h)) } else { image.clone() }
        });
        let size = |i: usize| (reduced[i].width(), reduced[i].height());
        let scale = [0, 1].map(|i| {
            let (w, h) = size(i);
            DVec2::new(w as f64 / images[i].width() as f64, h as f64 / images[i].height() as f64)
        });
        let cameras = [0, 1].map(|i| cameras[i].resized_unchecked(size(i).0, size(i).1));
        let side = |i: usize| size(i).0.max(size(i).1) as f64;
        let px_per_report_px = 0.5 * (side(0) + side(1)) / REPORT_SIDE;
        Self { images: reduced, cameras, scale, px_per_report_px }
    }

    /// Returns the largest distance of a consistent match, working px.
    pub(super) fn limit(&self) -> f64 {
        (LIMIT_PX * self.px_per_report_px).max(LIMIT_WORKING_PX)
    }

    /// Returns [`WorkingPair::limit`] in px of the reported scale.
    pub(super) fn limit_report_px(&self) -> f64 {
        LIMIT_PX.max(LIMIT_WORKING_PX / self.px_per_report_px)
    }
}
