//! Measures a pair of photographs: every number that the findings depend on.
//!
//! Input: photographs and cameras at the working size, and their matches. Output: [`Measures`].
//! The module judges nothing and writes no sentence.

use super::agreement::{Accuracy, Agreement, Fit};
use super::epipolar::{Match, TwoViews, median};
use super::geometry;
use super::matched::{MIN_EVIDENCE, Matched};
use super::report::{DepthReport, EpipolarReport, MatchedPoint};
use super::working::WorkingPair;
use subsplat_kernels::camera::Camera;

/// Half of the side of a patch whose brightness is compared, px of the working size.
const PATCH_RADIUS: usize = 6;

/// Measures of the cameras alone.
pub(super) struct CameraMeasures {
    /// Distance between the two cameras, world units.
    pub baseline: f32,
    /// Angle of the rotation between the two cameras, degrees.
    pub rotation_deg: f32,
    /// Horizontal and vertical field of view of each camera, degrees.
    pub fov_deg: [[f32; 2]; 2],
    /// Both photographs have the same camera.
    pub is_same_camera: bool,
}

impl CameraMeasures {
    /// Measures two cameras.
    pub(super) fn new(cameras: &[Camera; 2]) -> Self {
        let views = TwoViews::new(&cameras[0], &cameras[1]);
        let [a, b] = cameras.map(|c| c.world_from_camera());
        Self {
            baseline: views.translation.length() as f32,
            rotation_deg: views.rotation_angle().to_degrees() as f32,
            fov_deg: cameras.map(|c| {
                [c.intrinsics().fov_x().to_degrees(), c.intrinsics().fov_y().to_degrees()]
            }),
            is_same_camera: a.abs_diff_eq(b, 1e-6),
        }
    }
}

/// Measures of the matches against the cameras.
pub(super) struct Measures {
    /// Number of matches.
    pub matches: usize,
    /// Number of matches that agree with one another.
    pub consistent: usize,
    /// All matches, px of the photographs.
    pub points: Vec<MatchedPoint>,
    /// Share of each photograph near a consistent match.
    pub coverage: [f32; 2],
    /// Fit of the cameras to the matches; `None` with too few matches.
    pub epipolar: Option<EpipolarReport>,
    /// Assessment of the cameras; `None` with too few matches, and for one camera of both.
    pub agreement: Option<Agreement>,
    /// Depths of the matches; `None` without an agreement, and for wrong cameras.
    pub depths: Option<DepthMeasures>,
    /// Share of each photograph that the other camera sees.
    pub overlap: Option<[f32; 2]>,
    /// Brightness of the second photograph minus that of the first, 0 to 1.
    pub brightness_difference: f32,
}

/// Measures of the depths of the matches.
pub(super) struct DepthMeasures {
    /// Quantiles and range; `None` where the matches have too little parallax.
    pub report: Option<DepthReport>,
    /// Enough matches have a depth.
    pub are_known: bool,
    /// Median shift of a match against infinity, px of the network's input.
    pub parallax_px: f32,
    /// Upper quartile of the shifts that no rotation explains, px of the network's input.
    pub parallax_beyond_rotation_px: f32,
}

impl Measures {
    /// Measures the matches of `work`.
    pub(super) fn new(work: &WorkingPair, matched: &Matched, cameras: &CameraMeasures) -> Self {
        let views = TwoViews::new(&work.cameras[0], &work.cameras[1]);
        let chosen = matched.consistent_matches();
        let intrinsics = work.cameras.each_ref().map(|c| c.intrinsics());
        let [k_a, k_b] = intrinsics.each_ref();
        let coverage = [
            geometry::coverage(k_a, chosen.iter().map(|m| m.a)),
            geometry::coverage(k_b, chosen.iter().map(|m| m.b)),
        ];
        let mut measures = Self {
            matches: matched.matches.len(),
            consistent: chosen.len(),
            points: points(work, matched),
            coverage,
            epipolar: None,
            agreement: None,
            depths: None,
            overlap: None,
            brightness_difference: brightness_difference(work, &chosen),
        };
        if !matched.is_sufficient() {
            // Without depths, the overlap is the largest over all depths.
            measures.overlap = Some([
                geometry::overlap_at_best(&views, [k_a, k_b]),
                geometry::overlap_at_best(&views.swapped(), [k_b, k_a]),
            ]);
            return measures;
        }
        let fit = Fit::new(&views, &chosen, work.limit());
        measures.epipolar = Some(epipolar_report(work, matched, &fit));
        // Without a baseline there are no epipolar lines.
        if cameras.is_same_camera {
            return measures;
        }
        let agreement = Agreement::new(work, &chosen, &fit);
        if agreement.accuracy != Accuracy::Wrong {
            let (depths, overlap) = measure_depths(work, &views, &chosen);
            measures.depths = Some(depths);
            measures.overlap = overlap;
        }
        measures.agreement = Some(agreement);
        measures
    }
}

/// Measures depths and parallax of the matches, and the overlap that follows from the depths.
fn measure_depths(
    work: &WorkingPair,
    views: &TwoViews,
    chosen: &[Match],
) -> (DepthMeasures, Option<[f32; 2]>) {
    let intrinsics = work.cameras.each_ref().map(|c| c.intrinsics());
    let [k_a, k_b] = intrinsics.each_ref();
    let longer_side = work.images[1].width().max(work.images[1].height());
    let parallax_px = geometry::parallax(views, chosen, longer_side);
    // A third of the limit is the accuracy of a match, measured on good poses.
    let noise = work.limit() / 3.0;
    let depths = geometry::depths(views, chosen, noise);
    let overlap = depths.as_ref().map(|depths| {
        let back = views.swapped();
        let swapped: Vec<Match> = chosen.iter().map(Match::swapped).collect();
        let first = geometry::overlap(views, [k_a, k_b], chosen, depths);
        let second = geometry::depths(&back, &swapped, noise)
            .map(|depths| geometry::overlap(&back, [k_b, k_a], &swapped, &depths));
        [first, second.unwrap_or(first)]
    });
    let measures = DepthMeasures {
        report: depths.as_ref().and_then(|d| geometry::depth_report(views, d, parallax_px)),
        are_known: depths.is_some(),
        parallax_px,
        parallax_beyond_rotation_px: geometry::parallax_beyond_rotation(views, chosen, longer_side),
    };
    (measures, overlap)
}

/// Converts the matches to px of the photographs.
fn points(work: &WorkingPair, matched: &Matched) -> Vec<MatchedPoint> {
    let point = |m: &Match| MatchedPoint {
        a: (m.a / work.scale[0]).as_vec2().to_array(),
        b: (m.b / work.scale[1]).as_vec2().to_array(),
        consistent: false,
    };
    let mut points: Vec<MatchedPoint> = matched.matches.iter().map(point).collect();
    matched.consistent.iter().for_each(|&i| points[i].consistent = true);
    points
}

/// Converts the fit of the cameras to px of the reported scale.
fn epipolar_report(work: &WorkingPair, matched: &Matched, fit: &Fit) -> EpipolarReport {
    let share = |n: usize| n as f32 / matched.matches.len().max(1) as f32;
    let reported = |px: f64| (px / work.px_per_report_px) as f32;
    EpipolarReport {
        median_px: fit.distance.is_finite().then(|| reported(fit.distance)),
        inlier_share: share(matched.camera_inliers),
        own_median_px: reported(matched.estimated_distance),
        own_inlier_share: share(matched.estimated_inliers),
        in_front_share: fit.in_front as f32,
        limit_px: work.limit_report_px() as f32,
    }
}

/// Compares the brightness around matched points, or of the whole photographs where there are too
/// few.
fn brightness_difference(work: &WorkingPair, chosen: &[Match]) -> f32 {
    let difference = |m: &Match| {
        let (a, b) = (m.a.as_vec2(), m.b.as_vec2());
        let first = work.images[0].mean_around(a.x, a.y, PATCH_RADIUS);
        f64::from(work.images[1].mean_around(b.x, b.y, PATCH_RADIUS) - first)
    };
    let around = if chosen.len() >= MIN_EVIDENCE {
        median(chosen.iter().map(difference).collect())
    } else {
        None
    };
    around.map_or_else(|| work.images[1].mean() - work.images[0].mean(), |d| d as f32)
}
