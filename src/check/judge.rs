//! From numbers to a verdict. Every threshold is a constant here, with its reason.

use super::Work;
use super::epipolar::{Match, TwoViews, distance, median};
use super::estimate;
use super::geometry;
use super::mistakes::{Fit, Reading, fit, in_front, readings};
use super::report::{EpipolarReport, MatchedPoint, PairReport, ReadingReport, Verdict};

/// A match agrees with an epipolar geometry within this many px at 640: three
/// times what good poses of real photographs reach (0.3 to 0.6 measured).
const LIMIT_PX: f64 = 1.5;
/// And within this many px of the working size: features are no better placed.
const LIMIT_WORKING_PX: f64 = 1.0;
/// Above this median distance, px at 640, the poses are called wrong rather than
/// imprecise. Video poses that work still reach 2.8; 4 px are 1.6 px of a 256 px
/// input, where both views' Gaussians miss each other by more than their size.
const WRONG_PX: f64 = 4.0;
/// Least share of matches in front of both cameras.
const IN_FRONT: f64 = 0.7;
/// Matches that must agree before they count as evidence: 7 fit any geometry that
/// is drawn through them, and of 100 wrong ones one or two join by chance.
const EVIDENCE: usize = 16;
/// And their least share of all matches.
const EVIDENCE_SHARE: f64 = 0.25;
/// Another reading is named if its error is below this share of the given one's.
const CLEARLY_BETTER: f64 = 0.3;
/// A focal length that must be changed by more than this factor (or its inverse)
/// is a mistake, not imprecision: calibrations of one lens differ by a few percent.
const WRONG_FOCAL: f32 = 1.15;
/// Readings within this factor of the best, or [`LIMIT_PX`] / 3, are named too.
const AS_GOOD: f64 = 1.5;
/// Below this share of a photograph seen by the other camera, most of the result
/// comes from one view alone (users report 0.4 to 0.6 as what works).
const LITTLE_OVERLAP: f32 = 0.4;
/// Below this one the pair is no pair.
const NO_OVERLAP: f32 = 0.05;
/// Below this share of a photograph near matches, all of them lie in one corner: a
/// doorway, a window. Good pairs of the same rooms reach 0.4 to 0.9.
const LITTLE_COVERAGE: f32 = 0.3;
/// Least parallax, px of a 256 px input. The cost volume compares at a quarter of
/// it: below 4 px all depths fall into one cell.
const SMALL_PARALLAX: f32 = 4.0;
/// Baseline in medians of depth above which surfaces are seen from sides too
/// different to match.
const LARGE_BASELINE: f32 = 1.2;
/// Difference of mean brightness (0 to 1) above which one exposure was changed.
const BRIGHTNESS: f32 = 0.12;

/// Everything that matched points tell.
pub(super) fn matches(report: &mut PairReport, work: &Work, all: &[Match], evidence: &Evidence) {
    let views = TwoViews::new(&work.cameras[0], &work.cameras[1]);
    report.points = points(work, all, &evidence.consistent);
    report.consistent_matches = evidence.consistent.len();
    let k = work.cameras.map(|c| c.intrinsics);
    report.coverage = [
        geometry::coverage(&k[0], evidence.consistent.iter().map(|&i| all[i].0)),
        geometry::coverage(&k[1], evidence.consistent.iter().map(|&i| all[i].1)),
    ];
    if evidence.is_thin(all.len()) {
        too_few(report, work, &views);
    } else {
        agreement(report, work, &views, all, evidence);
    }
    brightness(report, work, all, &evidence.consistent);
}

/// Fit of the cameras to the matches that agree with one another.
fn agreement(
    report: &mut PairReport,
    work: &Work,
    views: &TwoViews,
    all: &[Match],
    evidence: &Evidence,
) {
    let limit = limit(work);
    let chosen: Vec<Match> = evidence.consistent.iter().map(|&i| all[i]).collect();
    let given = fit(views, &chosen, limit);
    report.epipolar = Some(epipolar_report(evidence, all.len(), &given, work.unit));
    // No baseline, no epipolar lines: said before, and nothing more to measure.
    if report.has("same_camera") {
        return;
    }
    if poses(report, work, &chosen, &given, limit) {
        depth(report, work, views, &chosen, limit);
    }
}

/// Which matches agree with one another.
pub(super) struct Evidence {
    /// Indices of the matches that support one geometry.
    consistent: Vec<usize>,
    /// How many support the given cameras.
    given: usize,
    /// Median distance to the geometry of their own, working px, and its support.
    own: (f64, usize),
}

impl Evidence {
    /// Which of `all` agree, with the given cameras or with another geometry.
    pub(super) fn gather(work: &Work, all: &[Match], seed: u64) -> Self {
        let (limit, views) = (limit(work), TwoViews::new(&work.cameras[0], &work.cameras[1]));
        let f = views.fundamental();
        let given: Vec<usize> = estimate::support(&f, all, limit)
            .into_iter()
            .filter(|&i| in_front(&views, &all[i], limit))
            .collect();
        let own = estimate::fundamental(all, limit, seed);
        let Some(own) = own else {
            return Self { given: given.len(), consistent: given, own: (0.0, 0) };
        };
        let distances = own.inliers.iter().map(|&i| distance(&own.fundamental, &all[i])).collect();
        let own_fit = (median(distances).unwrap_or(0.0), own.inliers.len());
        // The given cameras have fewer freedoms than a free matrix: where as many
        // matches support them, they are the better explanation.
        let count = given.len();
        let consistent = if count >= own.inliers.len() { given } else { own.inliers };
        Self { consistent, given: count, own: own_fit }
    }

    /// How many agree.
    pub(super) fn strength(&self) -> usize {
        self.consistent.len()
    }

    /// Whether too few agree to say anything.
    pub(super) fn is_thin(&self, matches: usize) -> bool {
        let n = self.consistent.len();
        n < EVIDENCE || (n as f64) < EVIDENCE_SHARE * matches as f64
    }
}

/// Distance within which a match agrees, working px.
fn limit(work: &Work) -> f64 {
    (LIMIT_PX * work.unit).max(LIMIT_WORKING_PX)
}

fn points(work: &Work, all: &[Match], consistent: &[usize]) -> Vec<MatchedPoint> {
    let mut points: Vec<MatchedPoint> = all
        .iter()
        .map(|m| MatchedPoint {
            a: (m.0 / work.scale[0]).as_vec2().to_array(),
            b: (m.1 / work.scale[1]).as_vec2().to_array(),
            consistent: false,
        })
        .collect();
    consistent.iter().for_each(|&i| points[i].consistent = true);
    points
}

fn epipolar_report(evidence: &Evidence, matches: usize, given: &Fit, unit: f64) -> EpipolarReport {
    let share = |n: usize| n as f32 / matches.max(1) as f32;
    EpipolarReport {
        median_px: given.distance.is_finite().then_some((given.distance / unit) as f32),
        inlier_share: share(evidence.given),
        own_median_px: (evidence.own.0 / unit) as f32,
        own_inlier_share: share(evidence.own.1),
        in_front_share: given.in_front as f32,
        limit_px: LIMIT_PX.max(LIMIT_WORKING_PX / unit) as f32,
    }
}

fn too_few(report: &mut PairReport, work: &Work, views: &TwoViews) {
    let (n, m) = (report.consistent_matches, report.matches);
    let sentence = format!(
        "only {n} of {m} matched points agree with one another: too few to judge the poses \
         (little overlap, little texture, or photographs of different places)"
    );
    report.find(Verdict::Warning, "few_matches", sentence);
    let k = [&work.cameras[0].intrinsics, &work.cameras[1].intrinsics];
    let seen = [
        geometry::overlap_at_best(views, k),
        geometry::overlap_at_best(&views.swapped(), [k[1], k[0]]),
    ];
    overlap(report, seen);
}

/// Judges the poses; whether they are good enough to measure depths with.
fn poses(report: &mut PairReport, work: &Work, chosen: &[Match], given: &Fit, limit: f64) -> bool {
    let told = given.distance / work.unit;
    let reversed = given.in_front < IN_FRONT;
    let precise = told <= LIMIT_PX;
    if precise && !reversed {
        return true;
    }
    let fitting = better_readings(work, chosen, given, limit);
    let mistaken =
        |r: &Reading| r.rank == 0 || r.factor.is_some_and(|f| f.max(1.0 / f) > WRONG_FOCAL);
    let wrong = reversed || told > WRONG_PX || fitting.first().is_some_and(|f| mistaken(&f.1));
    let error = if told.is_finite() && told > LIMIT_PX {
        format!(
            "matched points lie {told:.1} px (of {} px) from where the poses put them",
            super::TOLD_SIDE
        )
    } else {
        let behind = 100.0 * (1.0 - given.in_front);
        format!("{behind:.0} % of the matched points lie behind a camera")
    };
    let hint = match fitting.first() {
        None => String::new(),
        Some(_) => {
            let clauses: Vec<&str> = fitting.iter().map(|f| f.1.clause.as_str()).collect();
            format!("; they fit if {}", clauses.join(", or if "))
        }
    };
    let (severity, code, what) = if wrong {
        (Verdict::Bad, "poses_wrong", "the poses or intrinsics are wrong")
    } else {
        (Verdict::Warning, "poses_imprecise", "the poses or intrinsics are imprecise")
    };
    report.find(severity, code, format!("{what}: {error}{hint}"));
    report.readings = fitting
        .into_iter()
        .map(|(e, r)| ReadingReport {
            name: r.name,
            clause: r.clause,
            error_px: (e / work.unit) as f32,
        })
        .collect();
    !wrong
}

/// Other readings that explain the matches clearly better, best first: the usual
/// mistakes where one fits, else a changed focal length, else other axes.
fn better_readings(work: &Work, chosen: &[Match], given: &Fit, limit: f64) -> Vec<(f64, Reading)> {
    let sizes = [0, 1].map(|i| (work.images[i].width(), work.images[i].height()));
    let mut tried: Vec<(f64, Reading)> = readings(&work.cameras, sizes)
        .into_iter()
        .map(|r| (fit(&TwoViews::new(&r.cameras[0], &r.cameras[1]), chosen, limit).error, r))
        .collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    for rank in 0..=Reading::LAST_RANK {
        // A usual mistake may leave the poses as imprecise as they were; searched
        // readings fit something by chance and must fit well.
        let most = if rank == 0 { WRONG_PX * work.unit } else { limit };
        let fits = |(e, r): &(f64, Reading)| {
            r.rank == rank && *e <= most && *e < CLEARLY_BETTER * given.error
        };
        let mut fitting: Vec<(f64, Reading)> = tried.iter().filter(|t| fits(t)).cloned().collect();
        let Some(best) = fitting.first().map(|f| f.0) else { continue };
        let as_good = (AS_GOOD * best).max(limit / 3.0);
        fitting.retain(|(e, _)| *e <= as_good);
        fitting.truncate(if rank == 0 { fitting.len() } else { 1 });
        return fitting;
    }
    Vec::new()
}

fn depth(report: &mut PairReport, work: &Work, views: &TwoViews, chosen: &[Match], limit: f64) {
    let k = [&work.cameras[0].intrinsics, &work.cameras[1].intrinsics];
    let longer = work.images[1].width().max(work.images[1].height());
    let parallax = geometry::parallax(views, chosen, longer);
    // A third of the limit is the accuracy of a match, measured on good poses.
    let depths = geometry::depths(views, chosen, limit / 3.0);
    if let Some(depths) = &depths {
        report.depth = geometry::depth_report(views, depths, parallax);
        let back = views.swapped();
        let turned: Vec<Match> = chosen.iter().map(|m| (m.1, m.0)).collect();
        let second = geometry::depths(&back, &turned, limit / 3.0);
        let first = geometry::overlap(views, k, chosen, depths);
        let second = second.map(|d| geometry::overlap(&back, [k[1], k[0]], &turned, &d));
        overlap(report, [first, second.unwrap_or(first)]);
    }
    if depths.is_none() || parallax < SMALL_PARALLAX {
        let sentence = format!(
            "the baseline ({:.3} units) is too small for this depth: points move by {parallax:.1} \
             px of a 256 px input; take photographs further apart",
            report.baseline
        );
        report.find(Verdict::Warning, "small_baseline", sentence);
    }
    let covered = report.coverage[0].min(report.coverage[1]);
    if covered < LITTLE_COVERAGE {
        let sentence = format!(
            "matched points lie in one part ({:.0} %) of a photograph; what the rest shows may \
             have no second view",
            100.0 * covered
        );
        report.find(Verdict::Warning, "little_coverage", sentence);
    }
    let ratio = report.depth.map_or(0.0, |d| d.baseline_over_depth);
    if ratio > LARGE_BASELINE {
        let sentence = format!(
            "the eyes are {ratio:.1} times the median depth apart: many surfaces are seen by one \
             photograph only; take photographs closer together"
        );
        report.find(Verdict::Warning, "large_baseline", sentence);
    }
}

fn overlap(report: &mut PairReport, seen: [f32; 2]) {
    report.overlap = Some(seen);
    let least = seen[0].min(seen[1]);
    let percent = 100.0 * least;
    if least < NO_OVERLAP {
        let sentence = format!(
            "the cameras look at different things: one sees {percent:.0} % of the other's \
             photograph at most"
        );
        report.find(Verdict::Bad, "no_overlap", sentence);
    } else if least < LITTLE_OVERLAP {
        let sentence = format!(
            "little overlap: one camera sees {percent:.0} % of the other's photograph, the rest \
             has no second view"
        );
        report.find(Verdict::Warning, "little_overlap", sentence);
    }
}

/// Brightness around matched points where there are enough, else of the whole.
fn brightness(report: &mut PairReport, work: &Work, all: &[Match], consistent: &[usize]) {
    /// Half the side of the patch compared, px of the working size.
    const RADIUS: usize = 6;
    let difference = |i: &usize| {
        let (a, b) = (all[*i].0.as_vec2(), all[*i].1.as_vec2());
        let first = work.images[0].mean_around(a.x, a.y, RADIUS);
        f64::from(work.images[1].mean_around(b.x, b.y, RADIUS) - first)
    };
    let around = (consistent.len() >= EVIDENCE)
        .then(|| median(consistent.iter().map(difference).collect()))
        .flatten();
    let whole = work.images[1].mean() - work.images[0].mean();
    report.brightness_difference = around.map_or(whole, |d| d as f32);
    if report.brightness_difference.abs() > BRIGHTNESS {
        let darker = if report.brightness_difference < 0.0 { "darker" } else { "brighter" };
        let sentence = format!(
            "the second photograph is {darker} by {:.0} % of the full range: lock the exposure",
            100.0 * report.brightness_difference.abs()
        );
        report.find(Verdict::Warning, "brightness", sentence);
    }
}
