//! Judges the measures of a pair: from numbers to findings with sentences.
//!
//! Input: [`Measures`]. Output: [`Finding`]s. Each threshold is a constant of this module, with its
//! reason. A sentence says what was found, what was expected, and what to do.

use super::agreement::{Accuracy, Agreement};
use super::measures::{CameraMeasures, DepthMeasures, Measures};
use super::report::{Finding, Verdict};
use super::working::REPORT_SIDE;

/// Overlap below which most of the result comes from one view alone. Users report 0.4 to 0.6 as
/// workable.
const MIN_OVERLAP: f32 = 0.4;
/// Overlap below which the photographs are not a pair.
const MIN_PAIR_OVERLAP: f32 = 0.05;
/// Coverage below which all matches lie in one part of a photograph, for instance in a doorway.
/// Good pairs of the same rooms reach 0.4 to 0.9.
const MIN_COVERAGE: f32 = 0.3;
/// Smallest parallax, px of a 256 px input. The cost volume has a quarter of that resolution: below
/// 4 px all depths share one cell.
const MIN_PARALLAX: f32 = 4.0;
/// Median distance of the matches to the cameras' epipolar lines over that to their own, above which
/// the cameras are doubted. Good poses of real photographs: 1.0 to 1.3; a rotation that is wrong by
/// 4 degrees and cancels the parallax: 4.
pub(crate) const WORSE_THAN_OWN: f32 = 2.0;
/// Accuracy of a match, px at 640: smaller distances to the matches' own lines count as this.
pub(crate) const MATCH_PX: f32 = 0.25;
/// Baseline over median depth above which the two views of a surface differ too much to match.
const MAX_BASELINE_OVER_DEPTH: f32 = 1.2;
/// Difference of mean brightness (0 to 1) above which the exposures differ.
const MAX_BRIGHTNESS_DIFFERENCE: f32 = 0.12;

/// Judges the measures of a pair.
pub(super) fn of_measures(measures: &Measures, cameras: &CameraMeasures) -> Vec<Finding> {
    let few = measures.epipolar.is_none().then(|| few_matches(measures));
    let poses = measures.agreement.as_ref().and_then(poses);
    let overlap = measures.overlap.and_then(overlap);
    let depths = measures.depths.as_ref().map(|d| of_depths(d, measures, cameras));
    let first = [few, poses, overlap].into_iter().flatten();
    first
        .chain(depths.into_iter().flatten())
        .chain(brightness(measures.brightness_difference))
        .collect()
}

/// Reports that the poses cannot be assessed.
fn few_matches(measures: &Measures) -> Finding {
    let Measures { consistent, matches, .. } = measures;
    let sentence = format!(
        "only {consistent} of {matches} points matched between the photographs agree with one \
         another, too few to check the camera poses: the photographs overlap little, have little \
         texture, or show different places"
    );
    Finding::new(Verdict::Warning, "few_matches", sentence)
}

/// Reports cameras that are imprecise or wrong.
fn poses(agreement: &Agreement) -> Option<Finding> {
    let (severity, code, problem) = match agreement.accuracy {
        Accuracy::Precise => return None,
        Accuracy::Imprecise => {
            (Verdict::Warning, "poses_imprecise", "the camera poses or intrinsics are imprecise")
        }
        Accuracy::Wrong => {
            (Verdict::Bad, "poses_wrong", "the camera poses or intrinsics are wrong")
        }
    };
    let error = if agreement.is_distant {
        format!(
            "matched points lie {:.1} px from where the cameras predict them (photographs reduced \
             to {REPORT_SIDE} px)",
            agreement.error_px
        )
    } else if agreement.error_px.is_finite() {
        let percent = 100.0 * (1.0 - agreement.in_front);
        format!("{percent:.0} % of the matched points lie behind a camera")
    } else {
        "both cameras stand at one place, where no depth can be seen".to_owned()
    };
    let clauses: Vec<&str> = agreement.better.iter().map(|(_, r)| r.clause.as_str()).collect();
    let hint = if clauses.is_empty() {
        String::new()
    } else {
        format!("; they fit if {}", clauses.join(", or if "))
    };
    Some(Finding::new(severity, code, format!("{problem}: {error}{hint}")))
}

/// Reports a small overlap.
fn overlap(shares: [f32; 2]) -> Option<Finding> {
    let smaller = shares[0].min(shares[1]);
    let percent = 100.0 * smaller;
    if smaller < MIN_PAIR_OVERLAP {
        let sentence = format!(
            "the photographs show different places: one camera sees at most {percent:.0} % of the \
             other's photograph"
        );
        return Some(Finding::new(Verdict::Bad, "no_overlap", sentence));
    }
    (smaller < MIN_OVERLAP).then(|| {
        let sentence = format!(
            "the photographs overlap little: one camera sees {percent:.0} % of the other's \
             photograph, and the depth of the rest is a guess"
        );
        Finding::new(Verdict::Warning, "little_overlap", sentence)
    })
}

/// Judges depths, parallax and coverage.
fn of_depths(
    depths: &DepthMeasures,
    measures: &Measures,
    cameras: &CameraMeasures,
) -> impl Iterator<Item = Finding> {
    // Shifts against imprecise poses say nothing about the baseline.
    let are_precise = measures.agreement.as_ref().is_some_and(|a| a.accuracy == Accuracy::Precise);
    let parallax =
        if are_precise { small_parallax(depths, measures, cameras.baseline) } else { None };
    let covered = measures.coverage[0].min(measures.coverage[1]);
    let coverage = (covered < MIN_COVERAGE).then(|| {
        let sentence = format!(
            "the matched points lie in one part of a photograph, {:.0} % of it: the rest may be \
             visible in one photograph only",
            100.0 * covered
        );
        Finding::new(Verdict::Warning, "little_coverage", sentence)
    });
    let ratio = depths.report.map_or(0.0, |d| d.baseline_over_depth);
    let baseline = (ratio > MAX_BASELINE_OVER_DEPTH).then(|| {
        let sentence = format!(
            "the cameras are {ratio:.1} times as far apart as the scene is deep, so that many \
             surfaces are visible in one photograph only: take the photographs closer together"
        );
        Finding::new(Verdict::Warning, "large_baseline", sentence)
    });
    [parallax, coverage, baseline].into_iter().flatten()
}

/// Reports points with too little parallax against the cameras' rotation, or with few depths.
/// Either the baseline is small, or the rotation is wrong and cancels the parallax.
fn small_parallax(depths: &DepthMeasures, measures: &Measures, baseline: f32) -> Option<Finding> {
    let (parallax, beyond) = (depths.parallax_px, depths.parallax_beyond_rotation_px);
    if depths.are_known && parallax >= MIN_PARALLAX {
        return None;
    }
    let is_worse = measures.epipolar.is_some_and(|e| {
        e.median_px.unwrap_or(0.0) > WORSE_THAN_OWN * e.own_median_px.max(MATCH_PX)
    });
    if is_worse || (!depths.are_known && beyond >= MIN_PARALLAX) {
        let sentence = format!(
            "the rotation between the cameras may be wrong: with it, points shift by {parallax:.1} \
             px between photographs of 256 px; with a better rotation they shift by {beyond:.1} px"
        );
        return Some(Finding::new(Verdict::Warning, "rotation_doubtful", sentence));
    }
    (beyond < MIN_PARALLAX).then(|| {
        let sentence = format!(
            "the cameras are too close together for the depth of the scene ({baseline:.3} units): \
             points shift by {parallax:.1} px between photographs of 256 px, and {MIN_PARALLAX} px \
             are needed; take the photographs further apart"
        );
        Finding::new(Verdict::Warning, "small_baseline", sentence)
    })
}

/// Reports a difference in exposure.
fn brightness(difference: f32) -> Option<Finding> {
    (difference.abs() > MAX_BRIGHTNESS_DIFFERENCE).then(|| {
        let comparison = if difference < 0.0 { "darker" } else { "brighter" };
        let sentence = format!(
            "the second photograph is {comparison} by {:.0} % of the full range: take both with \
             the same exposure",
            100.0 * difference.abs()
        );
        Finding::new(Verdict::Warning, "brightness", sentence)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::check::report::{DepthReport, EpipolarReport};

    const CAMERAS: CameraMeasures = CameraMeasures {
        baseline: 0.2,
        rotation_deg: 5.0,
        fov_deg: [[60.0, 45.0]; 2],
        is_same_camera: false,
    };

    fn agreement(accuracy: Accuracy, error_px: f64) -> Agreement {
        let is_distant = error_px.is_finite() && error_px > 1.5;
        Agreement { accuracy, error_px, is_distant, in_front: 1.0, better: Vec::new() }
    }

    /// A good pair.
    fn good() -> Measures {
        let epipolar = EpipolarReport {
            median_px: Some(0.5),
            inlier_share: 0.9,
            own_median_px: 0.4,
            own_inlier_share: 0.9,
            in_front_share: 1.0,
            limit_px: 1.5,
        };
        let report = DepthReport {
            quantiles: [1.0, 1.5, 2.0, 2.5, 3.0],
            near: 0.7,
            far: 6.0,
            baseline_over_depth: 0.1,
            parallax_px: 12.0,
        };
        Measures {
            matches: 300,
            consistent: 250,
            points: Vec::new(),
            coverage: [0.8; 2],
            epipolar: Some(epipolar),
            agreement: Some(agreement(Accuracy::Precise, 0.5)),
            depths: Some(DepthMeasures {
                report: Some(report),
                are_known: true,
                parallax_px: 12.0,
                parallax_beyond_rotation_px: 14.0,
            }),
            overlap: Some([0.8, 0.7]),
            brightness_difference: 0.02,
        }
    }

    /// Findings of a good pair after a change, as `code`s.
    fn codes(change: impl FnOnce(&mut Measures)) -> Vec<String> {
        let mut measures = good();
        change(&mut measures);
        of_measures(&measures, &CAMERAS).into_iter().map(|f| f.code).collect()
    }

    #[test]
    fn each_measure_has_its_finding() {
        let none: [&str; 0] = [];
        assert_eq!(codes(|_| ()), none);
        assert_eq!(codes(|m| m.overlap = Some([0.8, 0.39])), ["little_overlap"]);
        assert_eq!(codes(|m| m.overlap = Some([0.04, 0.8])), ["no_overlap"]);
        assert_eq!(codes(|m| m.coverage[1] = 0.29), ["little_coverage"]);
        assert_eq!(codes(|m| m.brightness_difference = -0.13), ["brightness"]);
        let depths =
            |change: fn(&mut DepthMeasures)| codes(|m| m.depths.iter_mut().for_each(change));
        let ratio = |d: &mut DepthMeasures| {
            d.report.iter_mut().for_each(|r| r.baseline_over_depth = 1.3);
        };
        assert_eq!(depths(ratio), ["large_baseline"]);
        let small = |d: &mut DepthMeasures| {
            (d.parallax_px, d.parallax_beyond_rotation_px) = (3.9, 3.9);
        };
        assert_eq!(depths(small), ["small_baseline"]);
        assert_eq!(depths(|d| d.are_known = false), ["rotation_doubtful"]);
        // Shifts against imprecise poses say nothing about the baseline.
        let imprecise = codes(|m| {
            m.agreement = Some(agreement(Accuracy::Imprecise, 2.0));
            m.depths.iter_mut().for_each(small);
        });
        assert_eq!(imprecise, ["poses_imprecise"]);
    }

    /// Each threshold by cases 2 % below and above it. The thresholds stand here as numbers, so that a change of a
    /// constant is seen.
    #[test]
    fn thresholds_are_where_they_were_measured() {
        let by = |change: &dyn Fn(&mut Measures, f32), at: f32| {
            [0.98, 1.02].map(|part| codes(|m| change(m, part * at)).join(" "))
        };
        let overlap = |m: &mut Measures, v: f32| m.overlap = Some([0.8, v]);
        assert_eq!(by(&overlap, 0.4), ["little_overlap", ""]);
        assert_eq!(by(&overlap, 0.05), ["no_overlap", "little_overlap"]);
        assert_eq!(by(&|m, v| m.coverage[0] = v, 0.3), ["little_coverage", ""]);
        assert_eq!(by(&|m, v| m.brightness_difference = v, 0.12), ["", "brightness"]);
        let depths = |m: &mut Measures, change: &dyn Fn(&mut DepthMeasures)| {
            m.depths.iter_mut().for_each(change);
        };
        let ratio = |m: &mut Measures, v: f32| {
            depths(m, &|d| d.report.iter_mut().for_each(|r| r.baseline_over_depth = v));
        };
        assert_eq!(by(&ratio, 1.2), ["", "large_baseline"]);
        let shifts = |m: &mut Measures, v: f32| {
            depths(m, &|d| (d.parallax_px, d.parallax_beyond_rotation_px) = (v, v));
        };
        assert_eq!(by(&shifts, 4.0), ["small_baseline", ""]);
        // Small shifts, and larger ones beside another rotation: the lines are those of a wrong rotation.
        let lines = |m: &mut Measures, own: f32, median: f32| {
            depths(m, &|d| d.parallax_px = 3.0);
            let lines = |e: &mut EpipolarReport| {
                (e.own_median_px, e.median_px) = (own, Some(median));
            };
            m.epipolar.iter_mut().for_each(lines);
        };
        assert_eq!(by(&|m, v| lines(m, 0.4, v), 0.8), ["", "rotation_doubtful"]);
        assert_eq!(by(&|m, v| lines(m, 0.1, v), 0.5), ["", "rotation_doubtful"]);
    }

    #[test]
    fn the_sentence_on_wrong_poses_names_the_reason() {
        let sentence = |error_px, in_front| {
            let agreement = Agreement { in_front, ..agreement(Accuracy::Wrong, error_px) };
            poses(&agreement).unwrap().sentence
        };
        assert!(sentence(5.25, 1.0).contains("5.2 px from"), "{}", sentence(5.25, 1.0));
        assert!(sentence(0.5, 0.25).contains("75 % of the matched points lie behind"));
        assert!(sentence(f64::INFINITY, 1.0).contains("stand at one place"));
    }
}
