//! Checks whether two posed photographs agree with their cameras, before a reconstruction.
//!
//! Points are matched between the photographs without the poses and compared with the epipolar
//! geometry of the cameras. Where they disagree, the check tests the usual mistakes of camera files
//! and reports the one that fits.
//!
//! Input: grey photographs and cameras. Output: [`PairReport`]. The module reads no files and
//! prints nothing. Equal inputs give equal reports.

mod epipolar;
mod estimate;
mod geometry;
mod mistakes;
mod picture;
mod plausibility;
mod report;
mod verdict;

pub use crate::cameras::matches::GrayImage;
pub use picture::{RgbPicture, epipolar_picture};
pub use report::{
    DepthReport, EpipolarReport, Finding, MatchedPoint, PairReport, ReadingReport, Verdict,
};

use crate::cameras::matches::features;
use crate::cameras::matches::features::Orientation;
use crate::cameras::matches::pairs;
use epipolar::Match;
use glam::DVec2;
use subsplat_kernels::camera::Camera;
use verdict::Evidence;

/// Options of [`check_pair`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckOptions {
    /// Photographs are first reduced to this many px along the longer side.
    pub longest_side: usize,
    /// Maximum number of features in each photograph.
    pub features: usize,
    /// Seed of the random samples of RANSAC.
    pub seed: u64,
}

impl Default for CheckOptions {
    /// 960 px resolve a twentieth of a degree, and a pair takes less than a second. 2500 features:
    /// the time of matching grows with their square.
    fn default() -> Self {
        Self { longest_side: 960, features: 2500, seed: 0x5EED }
    }
}

/// Longer side of the photographs at which errors are reported, px.
const REPORT_SIDE: f64 = 640.0;

/// Checks photographs `a` and `b` against their cameras.
pub fn check_pair(
    a: &GrayImage,
    camera_a: &Camera,
    b: &GrayImage,
    camera_b: &Camera,
    options: &CheckOptions,
) -> PairReport {
    let mut report = PairReport::default();
    plausibility::cameras(&mut report, [(a, camera_a), (b, camera_b)]);
    let cameras = [fitted(camera_a, a), fitted(camera_b, b)];
    geometry::describe(&mut report, &cameras);
    if plausibility::same_photograph(&mut report, a, b) {
        return report;
    }
    let work = WorkingPair::new([a, b], cameras, options);
    let upright = Matched::new(&work, options, Orientation::Upright);
    // Photographs that roll against each other need descriptors oriented along their gradients.
    let found = if upright.evidence.is_insufficient(upright.matches.len()) {
        let oriented = Matched::new(&work, options, Orientation::Gradient);
        if oriented.evidence.count() > upright.evidence.count() { oriented } else { upright }
    } else {
        upright
    };
    report.features = found.features;
    report.matches = found.matches.len();
    verdict::matches(&mut report, &work, &found.matches, &found.evidence);
    report
}

/// Points matched between the photographs.
struct Matched {
    features: [usize; 2],
    matches: Vec<Match>,
    evidence: Evidence,
}

impl Matched {
    /// Detects and matches features, then finds the consistent matches.
    fn new(work: &WorkingPair, options: &CheckOptions, orientation: Orientation) -> Self {
        let [a, b] = [&work.images[0], &work.images[1]]
            .map(|image| features::detect(image, options.features, orientation));
        let position = |f: &features::Feature| DVec2::new(f64::from(f.x), f64::from(f.y));
        let matches: Vec<Match> = pairs::pairs(&a, &b)
            .iter()
            .map(|p| Match { a: position(&a.points[p.a]), b: position(&b.points[p.b]) })
            .collect();
        let evidence = Evidence::gather(work, &matches, options.seed);
        Self { features: [a.points.len(), b.points.len()], matches, evidence }
    }
}

/// Rescales the camera to the size of the photograph.
fn fitted(camera: &Camera, image: &GrayImage) -> Camera {
    camera.resized_unchecked(image.width(), image.height())
}

/// The photographs at the working size.
struct WorkingPair {
    /// Photographs reduced to the working size.
    images: [GrayImage; 2],
    /// Cameras of the reduced photographs.
    cameras: [Camera; 2],
    /// Working px per px of the photograph, (x, y).
    scale: [DVec2; 2],
    /// Working px per px of the reported scale ([`REPORT_SIDE`]).
    px_per_report_px: f64,
}

impl WorkingPair {
    /// Reduces photographs and cameras to the working size.
    fn new(images: [&GrayImage; 2], cameras: [Camera; 2], options: &CheckOptions) -> Self {
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
}
