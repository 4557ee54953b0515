//! What matched points say before the network runs: whether the poses are right.

use crate::report::{say, warn};
use anyhow::{Context, Result};
use serde_json::{Value, json};
use subsplat::check::{GrayImage, PairReport, Verdict};
use subsplat::data::depth::DepthRange;
use subsplat::io::image::Rgb;
use subsplat::pipeline::{self, Reconstruction};

/// Grey copy of a photograph.
pub fn grey(photo: &Rgb) -> Result<GrayImage> {
    GrayImage::from_rgb8(photo.width, photo.height, &photo.data)
        .with_context(|| format!("picture of {}x{} pixels", photo.width, photo.height))
}

/// Tells the user what `reports` found.
pub fn tell(reports: &[PairReport]) {
    for finding in reports.iter().flat_map(|r| &r.findings) {
        warn(&finding.sentence);
    }
    if reports.iter().any(|r| r.verdict == Verdict::Bad) {
        warn("these cameras look wrong, so the result will; `subsplat check` says more");
    }
}

/// Tells the user what `reports` found, and the depth range that follows from a `guess`
/// where near and far are not `given`.
pub fn refine(
    guess: DepthRange,
    given: (Option<f32>, Option<f32>),
    reports: &[PairReport],
) -> DepthRange {
    tell(reports);
    let range = pipeline::refine_range(guess, given, reports);
    say(format!("near {:.4}, far {:.4}: {}", range.near, range.far, range.reason));
    range
}

/// The range that the network worked with, said where it is its own.
pub fn looked(range: DepthRange, result: &Reconstruction) -> DepthRange {
    let (near, far) = result.near_far;
    if (near, far) == (range.near, range.far) {
        return range;
    }
    say(format!("near {near:.4}, far {far:.4}: from a first look at half size"));
    let reason = format!("a first look at half size, after {}", range.reason);
    DepthRange { near, far, reason, ..range }
}

/// The findings for programs.
pub fn report(reports: &[PairReport]) -> Vec<Value> {
    let one = |r: &PairReport| {
        json!({
            "verdict": r.verdict,
            "matches": r.matches,
            "median_epipolar_px": r.epipolar.and_then(|e| e.median_px),
            "findings": r.findings,
        })
    };
    reports.iter().map(one).collect()
}
