//! What [`super::check_pair`] answers: numbers for programs, sentences for people.

use serde::{Deserialize, Serialize};

/// How much a pair of photographs promises.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing to say against it.
    #[default]
    Ok,
    /// It will run; the result may disappoint for the reason given.
    Warning,
    /// The cameras are wrong, or the pair holds no depth: do not run it.
    Bad,
}

/// One thing that was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Verdict,
    /// What it is, for programs: `poses_wrong`, `small_baseline`, ….
    pub code: String,
    /// The same for people, one sentence, no final full stop.
    pub sentence: String,
}

/// Matched points against the epipolar geometry of the given cameras. All px are
/// of the photographs scaled to 640 px along the longer side.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpipolarReport {
    /// Median distance of the consistent matches to the given cameras' epipolar
    /// lines, px; `None` where those have none (no baseline).
    pub median_px: Option<f32>,
    /// Share of all matches nearer than the limit to the given cameras' lines.
    pub inlier_share: f32,
    /// Median distance to the lines that the matches themselves support, px.
    pub own_median_px: f32,
    /// Share of all matches nearer than the limit to those.
    pub own_inlier_share: f32,
    /// Share of the consistent matches that lie in front of both given cameras.
    pub in_front_share: f32,
    /// The limit, px.
    pub limit_px: f32,
}

/// Another way to read the camera file that fits the matches.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadingReport {
    /// Short name: `opengl`, `world_to_camera`, `focal_scaled`, ….
    pub name: String,
    /// Completes "the poses fit if …".
    pub clause: String,
    /// Median epipolar distance so read, px at 640.
    pub error_px: f32,
}

/// Depth of the matched points in the first camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthReport {
    /// Depths below which 2, 25, 50, 75 and 98 % of the points lie, world units.
    pub quantiles: [f32; 5],
    /// A nearest depth that leaves room before the points, world units.
    pub near: f32,
    /// A farthest depth that leaves room behind the points, world units.
    pub far: f32,
    /// Distance of both eyes divided by the median depth.
    pub baseline_over_depth: f32,
    /// Median shift of a matched point against infinity, px of a picture that is
    /// 256 px along the longer side.
    pub parallax_px: f32,
}

/// A matched pair of points in px of the photographs as given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MatchedPoint {
    /// Place in the first photograph, px.
    pub a: [f32; 2],
    /// Place in the second photograph, px.
    pub b: [f32; 2],
    /// Whether it agrees with the epipolar geometry that most matches support
    /// (the given cameras' or another).
    pub consistent: bool,
}

/// Everything found about two posed photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PairReport {
    /// The worst of the findings.
    pub verdict: Verdict,
    /// All of them, worst first.
    pub findings: Vec<Finding>,
    /// Features found in either photograph.
    pub features: [usize; 2],
    /// Points matched between them.
    pub matches: usize,
    /// Matches that agree on one epipolar geometry.
    pub consistent_matches: usize,
    /// Fit of the given cameras; `None` where there were too few matches.
    pub epipolar: Option<EpipolarReport>,
    /// Readings of the camera file that fit when the given one does not, best first.
    pub readings: Vec<ReadingReport>,
    /// Distance of both eyes, world units.
    pub baseline: f32,
    /// Angle by which one camera is turned against the other, degrees.
    pub rotation_deg: f32,
    /// Horizontal and vertical field of view of either camera, degrees.
    pub fov_deg: [[f32; 2]; 2],
    /// Depths; `None` where the cameras or the matches do not give any.
    pub depth: Option<DepthReport>,
    /// Share of either photograph that the other camera sees; from the matched
    /// points' depths, or the most over all depths where those are unknown. `None`
    /// where the cameras are wrong.
    pub overlap: Option<[f32; 2]>,
    /// Share of either photograph near a consistent match: what both photographs
    /// are known to show. Walls without texture count as not shown.
    pub coverage: [f32; 2],
    /// Brightness of the second photograph minus the first's, 0 to 1, around
    /// matched points where there are some.
    pub brightness_difference: f32,
    /// The matches, surest first.
    #[serde(skip)]
    pub points: Vec<MatchedPoint>,
}

impl PairReport {
    /// Adds a finding and lets the verdict follow.
    pub(super) fn find(&mut self, severity: Verdict, code: &str, sentence: impl Into<String>) {
        self.verdict = self.verdict.max(severity);
        self.findings.push(Finding { severity, code: code.into(), sentence: sentence.into() });
        self.findings.sort_by_key(|f| std::cmp::Reverse(f.severity));
    }

    /// Whether a finding of this code is there.
    pub fn has(&self, code: &str) -> bool {
        self.findings.iter().any(|f| f.code == code)
    }
}
