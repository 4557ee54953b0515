//! What matched points say before the network runs: whether the poses are right, and
//! how far the scene is where nothing else says it.

use super::report::warn;
use anyhow::{Context, Result};
use serde_json::{Value, json};
use subsplat::check::{CheckOptions, GrayImage, PairReport, Verdict, check_pair};
use subsplat::data::depth::DepthRange;
use subsplat::io::image::Rgb;
use subsplat::pipeline::Photo;

/// Grey copy of a photograph.
pub fn grey(photo: &Rgb) -> Result<GrayImage> {
    GrayImage::from_rgb8(photo.width, photo.height, &photo.data)
        .with_context(|| format!("picture of {}x{} pixels", photo.width, photo.height))
}

/// What is found about each context photograph and the next.
pub fn check(photos: &[Photo]) -> Result<Vec<PairReport>> {
    let pair = |w: &[Photo]| {
        let [a, b] = [grey(&w[0].image)?, grey(&w[1].image)?];
        Ok(check_pair(&a, &w[0].camera, &b, &w[1].camera, &CheckOptions::default()))
    };
    photos.windows(2).map(pair).collect()
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

/// `range` with what was only guessed, and not `given`, replaced by what the matched
/// points say.
pub fn refine(
    range: DepthRange,
    given: (Option<f32>, Option<f32>),
    reports: &[PairReport],
) -> DepthRange {
    let usable = reports.iter().filter(|r| r.verdict != Verdict::Bad);
    let depths: Vec<_> = usable.filter_map(|r| r.depth).collect();
    if !range.guessed || depths.is_empty() {
        return range;
    }
    let near = given.0.unwrap_or(depths.iter().map(|d| d.near).fold(f32::INFINITY, f32::min));
    let far = given.1.unwrap_or(depths.iter().map(|d| d.far).fold(0.0, f32::max));
    if !(near > 0.0 && far > near && far.is_finite()) {
        return range;
    }
    let points: usize = reports.iter().map(|r| r.consistent_matches).sum();
    let reason = match given {
        (None, None) => format!("from {points} matched points"),
        (Some(_), _) => format!("near as given, far from {points} matched points"),
        _ => format!("far as given, near from {points} matched points"),
    };
    DepthRange { near, far, reason, guessed: false }
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat::check::DepthReport;

    fn depth(near: f32, far: f32) -> PairReport {
        let depth = DepthReport {
            quantiles: [0.0; 5],
            near,
            far,
            baseline_over_depth: 0.1,
            parallax_px: 9.0,
        };
        PairReport { depth: Some(depth), ..PairReport::default() }
    }

    #[test]
    fn only_a_guess_gives_way_to_matched_points() {
        let guess = DepthRange { near: 0.01, far: 0.5, reason: "baseline".into(), guessed: true };
        let known = DepthRange { guessed: false, ..guess.clone() };
        let reports = [depth(0.6, 9.0), depth(0.7, 12.0)];
        let ends = |r: DepthRange| (r.near, r.far);
        assert_eq!(ends(refine(guess.clone(), (None, None), &reports)), (0.6, 12.0));
        assert_eq!(ends(refine(guess.clone(), (Some(1.0), None), &reports)), (1.0, 12.0));
        assert_eq!(ends(refine(guess.clone(), (None, Some(20.0)), &reports)), (0.6, 20.0));
        assert_eq!(refine(known.clone(), (None, None), &reports), known);
        assert_eq!(refine(guess.clone(), (None, None), &[]), guess);
        let bad = PairReport { verdict: Verdict::Bad, ..depth(0.6, 9.0) };
        assert_eq!(refine(guess.clone(), (None, None), &[bad]), guess);
    }
}
