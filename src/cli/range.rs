//! What matched points say before the network runs: whether the poses are right.

use super::report::warn;
use anyhow::{Context, Result};
use serde_json::{Value, json};
use subsplat::check::{GrayImage, PairReport, Verdict};
use subsplat::io::image::Rgb;

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
