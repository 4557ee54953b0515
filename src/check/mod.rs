//! Whether two posed photographs are what they claim to be, before anyone waits
//! for a reconstruction: points matched between the photographs, without a look at
//! the poses, are held against the epipolar geometry of the given cameras. Where
//! they disagree, the usual mistakes of camera files are tried and the one that
//! fits is named.
//!
//! In: grey photographs and cameras. Out: [`PairReport`]. The room knows no files
//! and prints nothing. The same input gives the same report.

mod descriptors;
mod epipolar;
mod estimate;
mod features;
mod geometry;
mod image;
mod judge;
mod matching;
mod mistakes;
mod picture;
mod plausible;
mod report;

pub use image::GrayImage;
pub use picture::{RgbPicture, epipolar_picture};
pub use report::{
    DepthReport, EpipolarReport, Finding, MatchedPoint, PairReport, ReadingReport, Verdict,
};

use crate::camera::Camera;
use epipolar::Match;
use glam::DVec2;
use judge::Evidence;

/// What may be chosen about a check.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckOptions {
    /// Photographs are reduced to this many px along the longer side first.
    pub longest_side: usize,
    /// Most features looked for in either photograph.
    pub features: usize,
    /// Seed of the random samples.
    pub seed: u64,
}

impl Default for CheckOptions {
    /// 960 px: enough for a twentieth of a degree, and a pair stays below a second.
    /// 2500 features: matching grows with the square of it.
    fn default() -> Self {
        Self { longest_side: 960, features: 2500, seed: 0x5EED }
    }
}

/// Px along the longer side of the scale at which errors are told.
pub(crate) const TOLD_SIDE: f64 = 640.0;

/// Checks photographs `a` and `b` against their cameras.
pub fn check_pair(
    a: &GrayImage,
    camera_a: &Camera,
    b: &GrayImage,
    camera_b: &Camera,
    options: &CheckOptions,
) -> PairReport {
    let mut report = PairReport::default();
    plausible::cameras(&mut report, [(a, camera_a), (b, camera_b)]);
    let given = [fitted(camera_a, a), fitted(camera_b, b)];
    geometry::describe(&mut report, &given);
    if plausible::same_photograph(&mut report, a, b) {
        return report;
    }
    let work = Work::new([a, b], given, options);
    let upright = Found::new(&work, options, true);
    // Photographs that roll against each other need descriptors that turn along.
    let found = if upright.evidence.is_thin(upright.matches.len()) {
        let turned = Found::new(&work, options, false);
        if turned.evidence.strength() > upright.evidence.strength() { turned } else { upright }
    } else {
        upright
    };
    report.features = found.features;
    report.matches = found.matches.len();
    judge::matches(&mut report, &work, &found.matches, &found.evidence);
    report
}

/// Points matched between the photographs.
struct Found {
    features: [usize; 2],
    matches: Vec<Match>,
    evidence: Evidence,
}

impl Found {
    fn new(work: &Work, options: &CheckOptions, upright: bool) -> Self {
        let [a, b] = [&work.images[0], &work.images[1]]
            .map(|image| features::detect(image, options.features, upright));
        let place = |f: &features::Feature| DVec2::new(f64::from(f.x), f64::from(f.y));
        let matches: Vec<Match> = matching::pairs(&a, &b)
            .iter()
            .map(|p| (place(&a.points[p.a]), place(&b.points[p.b])))
            .collect();
        let evidence = Evidence::gather(work, &matches, options.seed);
        Self { features: [a.points.len(), b.points.len()], matches, evidence }
    }
}

/// The camera for the photograph's real size.
fn fitted(camera: &Camera, image: &GrayImage) -> Camera {
    camera.resized(image.width(), image.height())
}

/// The photographs as they are worked on.
struct Work {
    /// Reduced to the working size.
    images: [GrayImage; 2],
    /// Cameras of the reduced photographs.
    cameras: [Camera; 2],
    /// Working px per px of the photograph, (x, y).
    scale: [DVec2; 2],
    /// Working px per px of the told scale.
    unit: f64,
}

impl Work {
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
        let cameras = [0, 1].map(|i| cameras[i].resized(size(i).0, size(i).1));
        let side = |i: usize| size(i).0.max(size(i).1) as f64;
        let unit = 0.5 * (side(0) + side(1)) / TOLD_SIDE;
        Self { images: reduced, cameras, scale, unit }
    }
}
