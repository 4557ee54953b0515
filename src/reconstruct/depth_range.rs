//! The depth range: the nearest and farthest depth candidate of a reconstruction.
//!
//! Candidates are uniform in 1/depth between the two. The ends come, in this order, from the
//! caller ([`DepthRange`]), from a file ([`DepthBounds::of_scene`]), or from the distance
//! between the cameras. Points matched between the photographs replace the last kind. The
//! small backbone then estimates both ends, unless the caller fixed one
//! ([`SubSplat::estimate_depth_range`](crate::network::model::subsplat::SubSplat::estimate_depth_range)).

use super::{Error, Result};
use crate::cameras::check::{PairReport, Verdict};
use crate::files::scene::{Scene, Units};
use crate::reconstruct::inputs::depth::depth_range;
use std::fmt;
use subsplat_kernels::camera::{Camera, NearFar};

/// Nearest depth of a guess, in units of the largest distance between two cameras.
const NEAR_BASELINES: f32 = 0.5;
/// Farthest depth of a guess, in the same unit.
const FAR_BASELINES: f32 = 30.0;

/// Ends of the depth range that the caller fixes, world units of camera z.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum DepthRange {
    /// Both ends are determined automatically.
    #[default]
    Auto,
    /// Both ends are fixed.
    Fixed {
        /// Nearest depth.
        near: f32,
        /// Farthest depth.
        far: f32,
    },
    /// The nearest depth is fixed.
    Near(f32),
    /// The farthest depth is fixed.
    Far(f32),
}

impl DepthRange {
    /// The range with these ends fixed.
    pub fn from_ends(near: Option<f32>, far: Option<f32>) -> Self {
        match (near, far) {
            (Some(near), Some(far)) => Self::Fixed { near, far },
            (Some(near), None) => Self::Near(near),
            (None, Some(far)) => Self::Far(far),
            (None, None) => Self::Auto,
        }
    }

    /// `bounds` with the fixed ends in place of its own.
    fn applied_to(self, bounds: DepthBounds) -> DepthBounds {
        let DepthBounds { near, far, source } = bounds;
        match self {
            Self::Auto => DepthBounds { near, far, source },
            Self::Fixed { near, far } => DepthBounds { near, far, source: DepthSource::Fixed },
            Self::Near(near) => {
                DepthBounds { near, far, source: DepthSource::FixedNear { far: Box::new(source) } }
            }
            Self::Far(far) => {
                DepthBounds { near, far, source: DepthSource::FixedFar { near: Box::new(source) } }
            }
        }
    }
}

/// Nearest and farthest depth candidate, with their source.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthBounds {
    /// Nearest depth, world units of camera z.
    pub near: f32,
    /// Farthest depth, world units of camera z.
    pub far: f32,
    /// Origin of the two numbers.
    pub source: DepthSource,
}

/// Origin of a depth range. [`fmt::Display`] gives a phrase for the user.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum DepthSource {
    /// The caller fixed both ends.
    Fixed,
    /// The caller fixed near.
    FixedNear {
        /// Source of far.
        far: Box<DepthSource>,
    },
    /// The caller fixed far.
    FixedFar {
        /// Source of near.
        near: Box<DepthSource>,
    },
    /// The pose file states near and far.
    PoseFile,
    /// The scene is RealEstate10K's, where near 1 and far 100 are customary.
    RealEstate10k,
    /// Quantiles of the scene's sparse points.
    SparsePoints,
    /// Points matched between the photographs.
    MatchedPoints {
        /// Number of points.
        points: usize,
    },
    /// A guess from the largest distance between two cameras.
    Baseline {
        /// That distance, world units.
        distance: f32,
    },
    /// The network's estimate from pictures of half the size.
    Estimated {
        /// Source of the range in which the network searched.
        from: Box<DepthSource>,
    },
}

impl DepthSource {
    /// Returns whether nothing but the distance between the cameras determined an end.
    pub fn is_guess(&self) -> bool {
        match self {
            Self::Baseline { .. } => true,
            Self::FixedNear { far: open } | Self::FixedFar { near: open } => open.is_guess(),
            _ => false,
        }
    }
}

impl fmt::Display for DepthSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed => f.write_str("as given"),
            Self::FixedNear { far } => write!(f, "near as given, far {far}"),
            Self::FixedFar { near } => write!(f, "far as given, near {near}"),
            Self::PoseFile => f.write_str("from the pose file"),
            Self::RealEstate10k => f.write_str("RealEstate10K's usual range"),
            Self::SparsePoints => f.write_str("from sparse points"),
            Self::MatchedPoints { points } => write!(f, "from {points} matched points"),
            Self::Baseline { distance } => write!(
                f,
                "{NEAR_BASELINES} and {FAR_BASELINES} times the baseline of {distance:.4}"
            ),
            Self::Estimated { from } => {
                write!(f, "estimated by the network at half size (initial range: {from})")
            }
        }
    }
}

impl DepthBounds {
    /// Near and far of a source.
    pub fn new(near: f32, far: f32, source: DepthSource) -> Self {
        Self { near, far, source }
    }

    /// RealEstate10K's near 1 and far 100.
    pub fn re10k() -> Self {
        let NearFar { near, far } = NearFar::RE10K;
        Self { near, far, source: DepthSource::RealEstate10k }
    }

    /// The range that a scene's files suggest for the photographs of frames `context`: the pose
    /// file's own, RealEstate10K's, or quantiles of sparse points. `None` where they suggest
    /// none.
    ///
    /// # Errors
    /// A frame that the scene does not have.
    pub fn of_scene(scene: &Scene, context: &[usize]) -> Result<Option<Self>> {
        if let Some(i) = context.iter().find(|i| **i >= scene.frames.len()) {
            let expected = format!("frames below {}", scene.frames.len());
            return Err(Error::argument(&scene.name, expected, i.to_string()));
        }
        if let Some(NearFar { near, far }) = scene.near_far {
            return Ok(Some(Self { near, far, source: DepthSource::PoseFile }));
        }
        if scene.units == Units::RealEstate10k {
            return Ok(Some(Self::re10k()));
        }
        // An error means cameras at one place: `initial_bounds` reports it where it matters.
        let points = depth_range(scene, context, None, None).ok().filter(|r| !r.guessed);
        let source = DepthSource::SparsePoints;
        Ok(points.map(|range| Self { near: range.near, far: range.far, source }))
    }

    /// Returns the two ends.
    pub fn near_far(&self) -> NearFar {
        NearFar { near: self.near, far: self.far }
    }

    /// Returns whether 0 < near < far, both finite.
    fn is_valid(&self) -> bool {
        self.near_far().is_valid()
    }
}

/// The range before any photograph is read: `range`, then `prior`, then a guess from the
/// distances between `cameras`.
///
/// # Errors
/// Not 0 < near < far; cameras at one place and no other source.
pub fn initial_bounds(
    cameras: &[Camera],
    range: DepthRange,
    prior: Option<&DepthBounds>,
) -> Result<DepthBounds> {
    let bounds = match (range, prior) {
        (DepthRange::Fixed { near, far }, _) => {
            DepthBounds { near, far, source: DepthSource::Fixed }
        }
        (_, Some(prior)) => range.applied_to(prior.clone()),
        (_, None) => range.applied_to(guess_from_baseline(cameras)?),
    };
    if !bounds.is_valid() {
        let DepthBounds { near, far, source } = bounds;
        let got = format!("near {near}, far {far} ({source})");
        return Err(Error::argument("depth range", "0 < near < far", got));
    }
    Ok(bounds)
}

fn guess_from_baseline(cameras: &[Camera]) -> Result<DepthBounds> {
    let mut distance = 0.0f32;
    for (i, a) in cameras.iter().enumerate() {
        for b in &cameras[i + 1..] {
            distance = distance.max(a.position().distance(b.position()));
        }
    }
    if !(distance > 0.0 && distance.is_finite()) {
        let expected = "cameras at different places, or near and far";
        return Err(Error::argument("depth range", expected, format!("a baseline of {distance}")));
    }
    Ok(DepthBounds {
        near: NEAR_BASELINES * distance,
        far: FAR_BASELINES * distance,
        source: DepthSource::Baseline { distance },
    })
}

/// `bounds` with guessed ends replaced by the depths of the points that `reports` matched. Ends
/// that `range` fixes stay.
pub fn refined_bounds(
    bounds: DepthBounds,
    range: DepthRange,
    reports: &[PairReport],
) -> DepthBounds {
    let usable = reports.iter().filter(|r| r.verdict != Verdict::Bad);
    let depths: Vec<_> = usable.filter_map(|r| r.depth).collect();
    if !bounds.source.is_guess() || depths.is_empty() {
        return bounds;
    }
    let matched = DepthBounds {
        near: depths.iter().map(|d| d.near).fold(f32::INFINITY, f32::min),
        far: depths.iter().map(|d| d.far).fold(0.0, f32::max),
        source: DepthSource::MatchedPoints {
            points: reports.iter().map(|r| r.consistent_matches).sum(),
        },
    };
    let refined = range.applied_to(matched);
    if refined.is_valid() { refined } else { bounds }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::check::DepthReport;
    use glam::{Mat4, Vec3};
    use subsplat_kernels::camera::Intrinsics;

    fn matched(near: f32, far: f32) -> PairReport {
        let depth = DepthReport {
            quantiles: [0.0; 5],
            near,
            far,
            baseline_over_depth: 0.1,
            parallax_px: 9.0,
        };
        PairReport { depth: Some(depth), consistent_matches: 40, ..PairReport::default() }
    }

    fn cameras(distance: f32) -> [Camera; 2] {
        let k = Intrinsics::from_fov_x(1.0, 8, 8);
        [0.0, distance]
            .map(|x| Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap())
    }

    fn ends(bounds: &DepthBounds) -> (f32, f32) {
        (bounds.near, bounds.far)
    }

    #[test]
    fn matched_points_replace_only_a_guess() {
        let reports = [matched(0.6, 9.0), matched(0.7, 12.0)];
        let refined = |range: DepthRange, reports: &[PairReport]| {
            let guess = initial_bounds(&cameras(0.125), range, None).unwrap();
            refined_bounds(guess, range, reports)
        };
        let auto = refined(DepthRange::Auto, &reports);
        assert_eq!(ends(&auto), (0.6, 12.0));
        assert_eq!(auto.source.to_string(), "from 80 matched points");
        let near = refined(DepthRange::Near(1.0), &reports);
        assert_eq!(ends(&near), (1.0, 12.0));
        assert_eq!(near.source.to_string(), "near as given, far from 80 matched points");
        assert_eq!(ends(&refined(DepthRange::Far(20.0), &reports)), (0.6, 20.0));
        // Points beyond the fixed far end leave the guess.
        assert_eq!(ends(&refined(DepthRange::Far(0.5), &reports)), (0.0625, 0.5));
        let prior = DepthBounds::new(0.01, 0.5, DepthSource::PoseFile);
        let known = initial_bounds(&cameras(1.0), DepthRange::Auto, Some(&prior)).unwrap();
        assert_eq!(refined_bounds(known.clone(), DepthRange::Auto, &reports), known);
        let bad = PairReport { verdict: Verdict::Bad, ..matched(0.6, 9.0) };
        for reports in [&[][..], &[bad]] {
            let guess = refined(DepthRange::Auto, reports);
            assert_eq!(ends(&guess), (0.0625, 3.75));
            assert!(guess.source.is_guess());
        }
    }

    #[test]
    fn fixed_ends_come_before_the_prior_and_the_prior_before_the_baseline() {
        let prior = DepthBounds::re10k();
        let initial = |range, prior: Option<&DepthBounds>| {
            initial_bounds(&cameras(2.0), range, prior).map(|b| (ends(&b), b.source.to_string()))
        };
        let (both, text) =
            initial(DepthRange::Fixed { near: 3.0, far: 4.0 }, Some(&prior)).unwrap();
        assert_eq!((both, text.as_str()), ((3.0, 4.0), "as given"));
        let (near, text) = initial(DepthRange::Near(3.0), Some(&prior)).unwrap();
        assert_eq!(near, (3.0, 100.0));
        assert_eq!(text, "near as given, far RealEstate10K's usual range");
        assert_eq!(initial(DepthRange::Auto, Some(&prior)).unwrap().0, (1.0, 100.0));
        let (guess, text) = initial(DepthRange::Far(9.0), None).unwrap();
        assert_eq!(guess, (1.0, 9.0));
        assert!(text.ends_with("times the baseline of 2.0000"), "{text}");
        for (near, far) in [(5.0, 1.0), (-1.0, 2.0), (f32::NAN, 2.0), (1.0, f32::INFINITY)] {
            let error = initial(DepthRange::Fixed { near, far }, None).unwrap_err().to_string();
            assert!(error.contains(&format!("near {near}, far {far}")), "{error}");
        }
        let error = initial_bounds(&cameras(0.0), DepthRange::Auto, None).unwrap_err();
        assert!(error.to_string().contains("baseline"), "{error}");
    }
}
