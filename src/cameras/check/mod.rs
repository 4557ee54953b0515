//! Checks whether two posed photographs agree with their cameras, before a reconstruction.
//!
//! Points are matched between the photographs without the poses and compared with the epipolar
//! geometry of the cameras. Where they disagree, the check tests the usual mistakes of camera files
//! and reports the one that fits.
//!
//! Input: grey photographs and cameras. Output: [`PairReport`]. The module reads no files and
//! prints nothing. Equal inputs give equal reports.
//!
//! Data flows one way:
//!
//! ```text
//! photographs, cameras ─> working ─> matched ─> measures ─> findings ─┐
//!          └────────────> plausibility ──────────────────────────────┴─> PairReport
//! ```
//!
//! `working` reduces the photographs, `matched` finds the matches that agree with one another,
//! `measures` computes every number (with `agreement` and `mistakes` for the poses, `geometry` for
//! depths), and `findings` judges the numbers in sentences. `plausibility` judges what needs no
//! matches. `epipolar` and `estimate` hold the mathematics.

mod agreement;
mod epipolar;
mod estimate;
mod findings;
mod geometry;
mod matched;
mod measures;
mod mistakes;
mod picture;
mod plausibility;
mod report;
mod working;

pub use crate::cameras::matches::GrayImage;
#[cfg(feature = "network")]
pub(crate) use findings::{MATCH_PX, WORSE_THAN_OWN};
pub use picture::{RgbPicture, epipolar_picture};
pub use report::{
    DepthReport, EpipolarReport, Finding, MatchedPoint, PairReport, ReadingReport, Verdict,
};
#[cfg(feature = "network")]
pub(crate) use working::REPORT_SIDE;

use matched::Matched;
use measures::{CameraMeasures, Measures};
use subsplat_kernels::camera::Camera;
use working::WorkingPair;

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

/// Checks photographs `a` and `b` against their cameras.
pub fn check_pair(
    a: &GrayImage,
    camera_a: &Camera,
    b: &GrayImage,
    camera_b: &Camera,
    options: &CheckOptions,
) -> PairReport {
    let fitted = [fitted(camera_a, a), fitted(camera_b, b)];
    let cameras = CameraMeasures::new(&fitted);
    let mut findings = plausibility::of_cameras([(a, camera_a), (b, camera_b)], &cameras);
    let report = PairReport {
        baseline: cameras.baseline,
        rotation_deg: cameras.rotation_deg,
        fov_deg: cameras.fov_deg,
        ..PairReport::default()
    };
    if let Some(same) = plausibility::same_photograph(a, b) {
        findings.push(same);
        return report.with_findings(findings);
    }
    let work = WorkingPair::new([a, b], fitted, options);
    let matched = Matched::new(&work, options);
    let measures = Measures::new(&work, &matched, &cameras);
    findings.extend(findings::of_measures(&measures, &cameras));
    let readings = measures.agreement.map_or_else(Vec::new, |a| a.better);
    let reading = |(error_px, reading): (f64, mistakes::Reading)| ReadingReport {
        name: reading.name,
        clause: reading.clause,
        error_px: error_px as f32,
    };
    PairReport {
        features: matched.features,
        matches: measures.matches,
        consistent_matches: measures.consistent,
        epipolar: measures.epipolar,
        readings: readings.into_iter().map(reading).collect(),
        depth: measures.depths.and_then(|d| d.report),
        overlap: measures.overlap,
        coverage: measures.coverage,
        brightness_difference: measures.brightness_difference,
        points: measures.points,
        ..report
    }
    .with_findings(findings)
}

/// Rescales the camera to the size of the photograph.
fn fitted(camera: &Camera, image: &GrayImage) -> Camera {
    camera.resized_unchecked(image.width(), image.height())
}
