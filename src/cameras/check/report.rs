//! The result of [`super::check_pair`]: numbers for programs, sentences for people.

use serde::{Deserialize, Serialize};

/// Overall assessment of a pair of photographs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No finding.
    #[default]
    Ok,
    /// The reconstruction runs, but its quality may suffer for the reported reason.
    Warning,
    /// The cameras are wrong, or the pair holds no depth. A reconstruction is not useful.
    Bad,
}

/// One finding of the check.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// Severity.
    pub severity: Verdict,
    /// Identifier for programs: `poses_wrong`, `small_baseline`, ….
    pub code: String,
    /// Explanation for people: one sentence without a final full stop.
    pub sentence: String,
}

/// Agreement of the matched points with the epipolar geometry of the cameras.
///
/// All px are those of the photographs scaled to 640 px along the longer side.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpipolarReport {
    /// Median distance of the consistent matches to the cameras' epipolar lines, px. `None` without
    /// a baseline, where the lines are not defined.
    pub median_px: Option<f32>,
    /// Share of all matches within the limit of the cameras' lines.
    pub inlier_share: f32,
    /// Median distance to the epipolar lines estimated from the matches, px.
    pub own_median_px: f32,
    /// Share of all matches within the limit of the estimated lines.
    pub own_inlier_share: f32,
    /// Share of the consistent matches in front of both cameras.
    pub in_front_share: f32,
    /// Limit of the distance, px.
    pub limit_px: f32,
}

/// An alternative interpretation of the camera file that fits the matches.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadingReport {
    /// Identifier: `opengl`, `world_to_camera`, `focal_scaled`, ….
    pub name: String,
    /// Completes "the poses fit if …".
    pub clause: String,
    /// Median epipolar distance of this interpretation, px at 640.
    pub error_px: f32,
}

/// Depth of the matched points in the first camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthReport {
    /// Depths below which 2, 25, 50, 75 and 98 % of the points lie, world units.
    pub quantiles: [f32; 5],
    /// Suggested near plane, with a margin before the points, world units.
    pub near: f32,
    /// Suggested far plane, with a margin behind the points, world units.
    pub far: f32,
    /// Baseline divided by the median depth.
    pub baseline_over_depth: f32,
    /// Median shift of a matched point against infinity, px of a picture that is
    /// 256 px along the longer side.
    pub parallax_px: f32,
}

/// A matched pair of points, px of the photographs at their full size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MatchedPoint {
    /// Position in the first photograph, px.
    pub a: [f32; 2],
    /// Position in the second photograph, px.
    pub b: [f32; 2],
    /// The match agrees with the epipolar geometry that most matches support: the cameras' or the
    /// estimated one.
    pub consistent: bool,
}

/// Result of a check of two posed photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PairReport {
    /// Severity of the worst finding.
    pub verdict: Verdict,
    /// All findings, the most severe first.
    pub findings: Vec<Finding>,
    /// Number of features in each photograph.
    pub features: [usize; 2],
    /// Number of matched points.
    pub matches: usize,
    /// Number of matches that agree on one epipolar geometry.
    pub consistent_matches: usize,
    /// Fit of the cameras; `None` with too few matches.
    pub epipolar: Option<EpipolarReport>,
    /// Interpretations of the camera file that fit where the file as read does not, the best first.
    pub readings: Vec<ReadingReport>,
    /// Distance between the two cameras, world units.
    pub baseline: f32,
    /// Angle of the rotation between the two cameras, degrees.
    pub rotation_deg: f32,
    /// Horizontal and vertical field of view of each camera, degrees.
    pub fov_deg: [[f32; 2]; 2],
    /// Depths; `None` where the cameras or the matches do not determine them.
    pub depth: Option<DepthReport>,
    /// Share of each photograph that the other camera sees. It comes from the matched points'
    /// depths; without them it is the maximum over all depths. `None` where the cameras are wrong.
    pub overlap: Option<[f32; 2]>,
    /// Share of each photograph near a consistent match. Surfaces without texture count as not
    /// covered.
    pub coverage: [f32; 2],
    /// Brightness of the second photograph minus that of the first, 0 to 1. It is measured around
    /// matched points where there are enough.
    pub brightness_difference: f32,
    /// The matches, the most certain first.
    #[serde(skip)]
    pub points: Vec<MatchedPoint>,
}

impl Finding {
    /// Makes a finding.
    pub(super) fn new(severity: Verdict, code: &str, sentence: impl Into<String>) -> Self {
        Self { severity, code: code.into(), sentence: sentence.into() }
    }
}

impl PairReport {
    /// Returns the report with `findings`, the most severe first, and their verdict.
    pub(super) fn with_findings(mut self, mut findings: Vec<Finding>) -> Self {
        findings.sort_by_key(|f| std::cmp::Reverse(f.severity));
        self.verdict = findings.first().map_or(Verdict::Ok, |f| f.severity);
        self.findings = findings;
        self
    }

    /// Returns true if the report holds a finding with this code.
    pub fn has(&self, code: &str) -> bool {
        self.findings.iter().any(|f| f.code == code)
    }
}
