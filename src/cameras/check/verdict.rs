//! Derives findings and the verdict from the measurements.
//!
//! Input: matches at the working size, and the cameras. Output: the fields and findings of the
//! [`PairReport`]. Each threshold is a constant of this module, with its reason.

use super::WorkingPair;
use super::epipolar::{Match, TwoViews, distance, median};
use super::estimate;
use super::geometry;
use super::mistakes::{Fit, Reading, fit, in_front, readings};
use super::report::{EpipolarReport, MatchedPoint, PairReport, ReadingReport, Verdict};

/// A match agrees with an epipolar geometry within this many px at 640. The limit is three times
/// the error of good poses of real photographs (0.3 to 0.6 measured).
const LIMIT_PX: f64 = 1.5;
/// Smallest limit, px of the working size: the accuracy of a feature.
const LIMIT_WORKING_PX: f64 = 1.0;
/// Median distance, px at 640, above which the poses are wrong rather than imprecise. Usable video
/// poses reach 2.8. 4 px are 1.6 px of a 256 px input, where both views' Gaussians miss each other
/// by more than their size.
const WRONG_PX: f64 = 4.0;
/// Smallest share of matches in front of both cameras.
const MIN_IN_FRONT: f64 = 0.7;
/// Smallest number of consistent matches that counts as evidence. Any 7 matches define a geometry,
/// and of 100 wrong ones one or two agree with it by chance.
const MIN_EVIDENCE: usize = 16;
/// Smallest share of all matches that counts as evidence.
const MIN_EVIDENCE_SHARE: f64 = 0.25;
/// A reading is reported if its error is below this share of the error of the cameras as given.
const CLEARLY_BETTER: f64 = 0.3;
/// Factor of the focal length (or its inverse) above which it is a mistake. Calibrations of one
/// lens differ by a few percent.
const WRONG_FOCAL: f32 = 1.15;
/// Readings within this factor of the best, or within [`LIMIT_PX`] / 3, are reported too.
const EQUALLY_GOOD: f64 = 1.5;
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
const WORSE_THAN_OWN: f32 = 2.0;
/// Accuracy of a match, px at 640: smaller distances to the matches' own lines count as this.
const MATCH_PX: f32 = 0.25;
/// Baseline over median depth above which the two views of a surface differ too much to match.
const MAX_BASELINE_OVER_DEPTH: f32 = 1.2;
/// Difference of mean brightness (0 to 1) above which the exposures differ.
const MAX_BRIGHTNESS_DIFFERENCE: f32 = 0.12;

/// Writes all measures and findings that depend on matched points.
pub(super) fn matches(
    report: &mut PairReport,
    work: &WorkingPair,
    all: &[Match],
    evidence: &Evidence,
) {
    let views = TwoViews::new(&work.cameras[0], &work.cameras[1]);
    report.points = points(work, all, &evidence.consistent);
    report.consistent_matches = evidence.consistent.len();
    let k = work.cameras.map(|c| c.intrinsics());
    report.coverage = [
        geometry::coverage(&k[0], evidence.consistent.iter().map(|&i| all[i].a)),
        geometry::coverage(&k[1], evidence.consistent.iter().map(|&i| all[i].b)),
    ];
    if evidence.is_insufficient(all.len()) {
        report_few_matches(report, work, &views);
    } else {
        report_agreement(report, work, &views, all, evidence);
    }
    report_brightness(report, work, all, &evidence.consistent);
}

/// Measures the fit of the cameras to the consistent matches.
fn report_agreement(
    report: &mut PairReport,
    work: &WorkingPair,
    views: &TwoViews,
    all: &[Match],
    evidence: &Evidence,
) {
    let limit = limit(work);
    let chosen: Vec<Match> = evidence.consistent.iter().map(|&i| all[i]).collect();
    let camera_fit = fit(views, &chosen, limit);
    report.epipolar =
        Some(epipolar_report(evidence, all.len(), &camera_fit, work.px_per_report_px));
    // Without a baseline there are no epipolar lines. The finding is already reported.
    if report.has("same_camera") {
        return;
    }
    if report_poses(report, work, &chosen, &camera_fit, limit) {
        report_depth(report, work, views, &chosen, limit);
    }
}

/// Matches that agree with one another.
pub(super) struct Evidence {
    /// Indices of the matches that support one geometry.
    consistent: Vec<usize>,
    /// Number of matches that support the cameras.
    camera_inliers: usize,
    /// Median distance to the geometry estimated from the matches, working px.
    estimated_distance: f64,
    /// Number of matches that support the estimated geometry.
    estimated_inliers: usize,
}

impl Evidence {
    /// Selects the matches in `all` that agree with the cameras or with another geometry.
    pub(super) fn gather(work: &WorkingPair, all: &[Match], seed: u64) -> Self {
        let (limit, views) = (limit(work), TwoViews::new(&work.cameras[0], &work.cameras[1]));
        let f = views.fundamental();
        let by_cameras: Vec<usize> = estimate::support(&f, all, limit)
            .into_iter()
            .filter(|&i| in_front(&views, &all[i], limit))
            .collect();
        let camera_inliers = by_cameras.len();
        let Some(estimate) = estimate::fundamental(all, limit, seed) else {
            return Self {
                consistent: by_cameras,
                camera_inliers,
                estimated_distance: 0.0,
                estimated_inliers: 0,
            };
        };
        let inliers = estimate.inliers.iter();
        let distances = inliers.map(|&i| distance(&estimate.fundamental, &all[i])).collect();
        let estimated_inliers = estimate.inliers.len();
        // The cameras have fewer degrees of freedom than a free matrix. With equal support
        // they are the better explanation.
        let consistent =
            if camera_inliers >= estimated_inliers { by_cameras } else { estimate.inliers };
        Self {
            consistent,
            camera_inliers,
            estimated_distance: median(distances).unwrap_or(0.0),
            estimated_inliers,
        }
    }

    /// Returns the number of consistent matches.
    pub(super) fn count(&self) -> usize {
        self.consistent.len()
    }

    /// Tests whether too few of `matches` agree for an assessment of the poses.
    pub(super) fn is_insufficient(&self, matches: usize) -> bool {
        let n = self.consistent.len();
        n < MIN_EVIDENCE || (n as f64) < MIN_EVIDENCE_SHARE * matches as f64
    }
}

/// Returns the largest distance of a consistent match, working px.
fn limit(work: &WorkingPair) -> f64 {
    (LIMIT_PX * work.px_per_report_px).max(LIMIT_WORKING_PX)
}

/// Converts the matches to px of the photographs.
fn points(work: &WorkingPair, all: &[Match], consistent: &[usize]) -> Vec<MatchedPoint> {
    let mut points: Vec<MatchedPoint> = all
        .iter()
        .map(|m| MatchedPoint {
            a: (m.a / work.scale[0]).as_vec2().to_array(),
            b: (m.b / work.scale[1]).as_vec2().to_array(),
            consistent: false,
        })
        .collect();
    consistent.iter().for_each(|&i| points[i].consistent = true);
    points
}

/// Converts the fit to px of the reported scale.
fn epipolar_report(
    evidence: &Evidence,
    matches: usize,
    camera_fit: &Fit,
    px_per_report_px: f64,
) -> EpipolarReport {
    let share = |n: usize| n as f32 / matches.max(1) as f32;
    EpipolarReport {
        median_px: camera_fit
            .distance
            .is_finite()
            .then_some((camera_fit.distance / px_per_report_px) as f32),
        inlier_share: share(evidence.camera_inliers),
        own_median_px: (evidence.estimated_distance / px_per_report_px) as f32,
        own_inlier_share: share(evidence.estimated_inliers),
        in_front_share: camera_fit.in_front as f32,
        limit_px: LIMIT_PX.max(LIMIT_WORKING_PX / px_per_report_px) as f32,
    }
}

/// Reports that the poses cannot be assessed, and the overlap without depths.
fn report_few_matches(report: &mut PairReport, work: &WorkingPair, views: &TwoViews) {
    let (n, m) = (report.consistent_matches, report.matches);
    let sentence = format!(
        "only {n} of {m} matched points agree with one another: too few to assess the poses \
         (little overlap, little texture, or photographs of different places)"
    );
    report.add(Verdict::Warning, "few_matches", sentence);
    let k = [&work.cameras[0].intrinsics(), &work.cameras[1].intrinsics()];
    let shares = [
        geometry::overlap_at_best(views, k),
        geometry::overlap_at_best(&views.swapped(), [k[1], k[0]]),
    ];
    report_overlap(report, shares);
}

/// Assesses the poses. Returns true if they are precise enough to measure depths.
fn report_poses(
    report: &mut PairReport,
    work: &WorkingPair,
    chosen: &[Match],
    camera_fit: &Fit,
    limit: f64,
) -> bool {
    let error_px = camera_fit.distance / work.px_per_report_px;
    let behind = camera_fit.in_front < MIN_IN_FRONT;
    let precise = error_px <= LIMIT_PX;
    if precise && !behind {
        return true;
    }
    let fitting = better_readings(work, chosen, camera_fit, limit);
    let mistaken =
        |r: &Reading| r.rank == 0 || r.factor.is_some_and(|f| f.max(1.0 / f) > WRONG_FOCAL);
    let wrong = behind || error_px > WRONG_PX || fitting.first().is_some_and(|f| mistaken(&f.1));
    let error = if error_px.is_finite() && error_px > LIMIT_PX {
        format!(
            "matched points lie {error_px:.1} px (of {} px) from the lines that the poses predict",
            super::REPORT_SIDE
        )
    } else {
        let percent = 100.0 * (1.0 - camera_fit.in_front);
        format!("{percent:.0} % of the matched points lie behind a camera")
    };
    let hint = match fitting.first() {
        None => String::new(),
        Some(_) => {
            let clauses: Vec<&str> = fitting.iter().map(|f| f.1.clause.as_str()).collect();
            format!("; they fit if {}", clauses.join(", or if "))
        }
    };
    let (severity, code, problem) = if wrong {
        (Verdict::Bad, "poses_wrong", "the poses or intrinsics are wrong")
    } else {
        (Verdict::Warning, "poses_imprecise", "the poses or intrinsics are imprecise")
    };
    report.add(severity, code, format!("{problem}: {error}{hint}"));
    report.readings = fitting
        .into_iter()
        .map(|(e, r)| ReadingReport {
            name: r.name,
            clause: r.clause,
            error_px: (e / work.px_per_report_px) as f32,
        })
        .collect();
    !wrong
}

/// Returns the readings that explain the matches clearly better, the best first. The usual mistakes
/// have precedence over a changed focal length, and that over other axes.
fn better_readings(
    work: &WorkingPair,
    chosen: &[Match],
    camera_fit: &Fit,
    limit: f64,
) -> Vec<(f64, Reading)> {
    let sizes = [0, 1].map(|i| (work.images[i].width(), work.images[i].height()));
    let mut tried: Vec<(f64, Reading)> = readings(&work.cameras, sizes)
        .into_iter()
        .map(|r| (fit(&TwoViews::new(&r.cameras[0], &r.cameras[1]), chosen, limit).error, r))
        .collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    for rank in 0..=Reading::LAST_RANK {
        // Poses may be imprecise even after a usual mistake is corrected. Readings from a search
        // fit partly by chance and must therefore fit well.
        let max_error = if rank == 0 { WRONG_PX * work.px_per_report_px } else { limit };
        let fits = |(e, r): &(f64, Reading)| {
            r.rank == rank && *e <= max_error && *e < CLEARLY_BETTER * camera_fit.error
        };
        let mut fitting: Vec<(f64, Reading)> = tried.iter().filter(|t| fits(t)).cloned().collect();
        let Some(best) = fitting.first().map(|f| f.0) else { continue };
        let as_good = (EQUALLY_GOOD * best).max(limit / 3.0);
        fitting.retain(|(e, _)| *e <= as_good);
        fitting.truncate(if rank == 0 { fitting.len() } else { 1 });
        return fitting;
    }
    Vec::new()
}

/// Measures depths, overlap and coverage, and reports those that are unfavourable.
fn report_depth(
    report: &mut PairReport,
    work: &WorkingPair,
    views: &TwoViews,
    chosen: &[Match],
    limit: f64,
) {
    let k = [&work.cameras[0].intrinsics(), &work.cameras[1].intrinsics()];
    let longer = work.images[1].width().max(work.images[1].height());
    let parallax = geometry::parallax(views, chosen, longer);
    // A third of the limit is the accuracy of a match, measured on good poses.
    let depths = geometry::depths(views, chosen, limit / 3.0);
    if let Some(depths) = &depths {
        report.depth = geometry::depth_report(views, depths, parallax);
        let back = views.swapped();
        let swapped: Vec<Match> = chosen.iter().map(|m| m.swapped()).collect();
        let second = geometry::depths(&back, &swapped, limit / 3.0);
        let first = geometry::overlap(views, k, chosen, depths);
        let second = second.map(|d| geometry::overlap(&back, [k[1], k[0]], &swapped, &d));
        report_overlap(report, [first, second.unwrap_or(first)]);
    }
    // Shifts against imprecise poses say nothing about the baseline.
    if (depths.is_none() || parallax < MIN_PARALLAX) && !report.has("poses_imprecise") {
        report_small_parallax(report, (parallax, depths.is_none()), views, chosen, longer);
    }
    let covered = report.coverage[0].min(report.coverage[1]);
    if covered < MIN_COVERAGE {
        let sentence = format!(
            "matched points lie in one part ({:.0} %) of a photograph; the rest may have no \
             second view",
            100.0 * covered
        );
        report.add(Verdict::Warning, "little_coverage", sentence);
    }
    let ratio = report.depth.map_or(0.0, |d| d.baseline_over_depth);
    if ratio > MAX_BASELINE_OVER_DEPTH {
        let sentence = format!(
            "the baseline is {ratio:.1} times the median depth: many surfaces are visible in one \
             photograph only; take the photographs closer together"
        );
        report.add(Verdict::Warning, "large_baseline", sentence);
    }
}

/// Reports points with too little `parallax` against the cameras' rotation, or with few depths.
/// Either the baseline is small, or the rotation is wrong and cancels the parallax.
fn report_small_parallax(
    report: &mut PairReport,
    (parallax, without_depths): (f32, bool),
    views: &TwoViews,
    chosen: &[Match],
    longer: usize,
) {
    let beyond = geometry::parallax_beyond_rotation(views, chosen, longer);
    let worse = report.epipolar.is_some_and(|e| {
        e.median_px.unwrap_or(0.0) > WORSE_THAN_OWN * e.own_median_px.max(MATCH_PX)
    });
    if worse || (without_depths && beyond >= MIN_PARALLAX) {
        let sentence = format!(
            "the rotation between the cameras may be wrong: with it the points shift by \
             {parallax:.1} px of a 256 px input, and a better rotation leaves {beyond:.1} px"
        );
        report.add(Verdict::Warning, "rotation_doubtful", sentence);
        return;
    }
    if beyond >= MIN_PARALLAX {
        return;
    }
    let sentence = format!(
        "the baseline ({:.3} units) is too small for this depth: points shift by {parallax:.1} px of \
         a 256 px input; take the photographs further apart",
        report.baseline
    );
    report.add(Verdict::Warning, "small_baseline", sentence);
}

/// Writes the overlap and reports a small one.
fn report_overlap(report: &mut PairReport, shares: [f32; 2]) {
    report.overlap = Some(shares);
    let smaller = shares[0].min(shares[1]);
    let percent = 100.0 * smaller;
    if smaller < MIN_PAIR_OVERLAP {
        let sentence = format!(
            "the cameras show different places: one sees at most {percent:.0} % of the other's \
             photograph"
        );
        report.add(Verdict::Bad, "no_overlap", sentence);
    } else if smaller < MIN_OVERLAP {
        let sentence = format!(
            "the overlap is small: one camera sees {percent:.0} % of the other's photograph; the \
             rest has no second view"
        );
        report.add(Verdict::Warning, "little_overlap", sentence);
    }
}

/// Compares the brightness around matched points, or of the whole photographs where there are too
/// few.
fn report_brightness(
    report: &mut PairReport,
    work: &WorkingPair,
    all: &[Match],
    consistent: &[usize],
) {
    /// Half of the side of a compared patch, px of the working size.
    const RADIUS: usize = 6;
    let difference = |i: &usize| {
        let (a, b) = (all[*i].a.as_vec2(), all[*i].b.as_vec2());
        let first = work.images[0].mean_around(a.x, a.y, RADIUS);
        f64::from(work.images[1].mean_around(b.x, b.y, RADIUS) - first)
    };
    let around = (consistent.len() >= MIN_EVIDENCE)
        .then(|| median(consistent.iter().map(difference).collect()))
        .flatten();
    let whole = work.images[1].mean() - work.images[0].mean();
    report.brightness_difference = around.map_or(whole, |d| d as f32);
    if report.brightness_difference.abs() > MAX_BRIGHTNESS_DIFFERENCE {
        let darker = if report.brightness_difference < 0.0 { "darker" } else { "brighter" };
        let sentence = format!(
            "the second photograph is {darker} by {:.0} % of the full range: use the same exposure",
            100.0 * report.brightness_difference.abs()
        );
        report.add(Verdict::Warning, "brightness", sentence);
    }
}
