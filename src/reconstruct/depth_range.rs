//! The depth range of a reconstruction: its near and far depth, decided in this module alone.
//!
//! Depth candidates are uniform in 1/depth between the two. A far end that is too far costs
//! little; a near end that is too near costs resolution everywhere. Each end comes from the first
//! of these sources that knows it:
//!
//! 1. the caller ([`DepthRange`]);
//! 2. the scene's files ([`DepthBounds::of_scene`]): the pose file's own near and far; 1 and 100
//!    for RealEstate10K, as pixelSplat and MVSplat use them; quantiles of the sparse points;
//! 3. points matched between the photographs ([`DepthBounds::refined`]);
//! 4. the largest distance between two cameras, a guess ([`DepthBounds::initial`]).
//!
//! With both ends free, the network may then narrow the range: it runs once at half size
//! ([`SubSplat::estimate_depth_range`](crate::network::model::subsplat::SubSplat::estimate_depth_range)).

use super::{Error, Result};
use crate::cameras::check::{PairReport, Verdict};
use crate::files::poses::scene::{Scene, Units};
use crate::reconstruct::inputs::pair::{points_in_view, quantile};
use std::fmt;
use subsplat_kernels::camera::{Camera, NearFar};

/// Nearest depth of a guess, in units of the largest distance between two cameras.
const NEAR_BASELINES: f32 = 0.5;
/// Farthest depth of a guess, in the same unit.
const FAR_BASELINES: f32 = 30.0;
/// Fewest depths of sparse points that determine a range.
const SPARSE_DEPTHS_MIN: usize = 20;
/// Quantiles of the depths of sparse points. Stray points lie outside the two.
const SPARSE_QUANTILES: [f32; 2] = [0.02, 0.98];
/// The nearest depth is the low quantile divided by this: surfaces without texture have no points.
const SPARSE_NEAR_MARGIN: f32 = 1.5;
/// The farthest depth is the high quantile times this, for the same reason.
const SPARSE_FAR_MARGIN: f32 = 2.0;

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
    /// Quantiles of the depths of the scene's sparse points.
    SparsePoints {
        /// Number of depths. A point counts once in each photograph that shows it.
        depths: usize,
    },
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
            Self::RealEstate10k => f.write_str("the usual range of RealEstate10K"),
            Self::SparsePoints { depths } => {
                write!(f, "from {depths} depths of the scene's sparse points")
            }
            Self::MatchedPoints { points } => {
                write!(f, "from {points} points matched between the photographs")
            }
            Self::Baseline { distance } => write!(
                f,
                "guessed as {NEAR_BASELINES} and {FAR_BASELINES} times the distance between the \
                 cameras ({distance:.4})"
            ),
            Self::Estimated { from } => {
                write!(f, "estimated by the network at half size; initial range: {from}")
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

    /// The range that a scene's files give for the photographs of frames `context`: the pose
    /// file's own, RealEstate10K's, or quantiles of sparse points. `None` where they give none.
    ///
    /// # Errors
    /// A frame that the scene does not have.
    pub fn of_scene(scene: &Scene, context: &[usize]) -> Result<Option<Self>> {
        let cameras = context_cameras(scene, context)?;
        if let Some(NearFar { near, far }) = scene.near_far {
            return Ok(Some(Self { near, far, source: DepthSource::PoseFile }));
        }
        if scene.units == Units::RealEstate10k {
            return Ok(Some(Self::re10k()));
        }
        let points = scene.points.as_deref().unwrap_or_default();
        let mut depths: Vec<f32> = cameras.iter().flat_map(|c| points_in_view(c, points)).collect();
        if depths.len() < SPARSE_DEPTHS_MIN {
            return Ok(None);
        }
        let [low, high] = SPARSE_QUANTILES.map(|q| quantile(&mut depths, q));
        let source = DepthSource::SparsePoints { depths: depths.len() };
        let near = low / SPARSE_NEAR_MARGIN;
        let far = high * SPARSE_FAR_MARGIN;
        Ok(Some(Self { near, far, source }))
    }

    /// The range for the photographs of frames `context`, without a look at their pixels:
    /// [`DepthBounds::of_scene`], else a guess from the cameras.
    ///
    /// # Errors
    /// Those of [`DepthBounds::of_scene`] and of [`DepthBounds::initial`].
    pub fn of_frames(scene: &Scene, context: &[usize], range: DepthRange) -> Result<Self> {
        let prior = Self::of_scene(scene, context)?;
        Self::initial(&context_cameras(scene, context)?, range, prior.as_ref()).map_err(|error| {
            match error {
                Error::Argument { expected, got, .. } => {
                    Error::argument(format!("depth range of {}", scene.name), expected, got)
                }
                error => error,
            }
        })
    }

    /// The range before any photograph is read: `range`, then `prior`, then a guess from the
    /// distances between `cameras`.
    ///
    /// # Errors
    /// Not 0 < near < far; cameras at one place and no other source.
    pub fn initial(cameras: &[Camera], range: DepthRange, prior: Option<&Self>) -> Result<Self> {
        let bounds = match (range, prior) {
            (DepthRange::Fixed { near, far }, _) => Self { near, far, source: DepthSource::Fixed },
            (_, Some(prior)) => range.applied_to(prior.clone()),
            (_, None) => range.applied_to(guess_from_cameras(cameras)?),
        };
        if !bounds.is_valid() {
            let Self { near, far, source } = bounds;
            let got = format!("near {near}, far {far} ({source})");
            return Err(Error::argument("depth range", "0 < near < far", got));
        }
        Ok(bounds)
    }

    /// Replaces guessed ends by the depths of the points that `reports` matched. Ends that
    /// `range` fixes stay, and so do ends that are no guess.
    pub fn refined(self, range: DepthRange, reports: &[PairReport]) -> Self {
        let usable = reports.iter().filter(|r| r.verdict != Verdict::Bad);
        let depths: Vec<_> = usable.filter_map(|r| r.depth).collect();
        if !self.source.is_guess() || depths.is_empty() {
            return self;
        }
        let matched = Self {
            near: depths.iter().map(|d| d.near).fold(f32::INFINITY, f32::min),
            far: depths.iter().map(|d| d.far).fold(0.0, f32::max),
            source: DepthSource::MatchedPoints {
                points: reports.iter().map(|r| r.consistent_matches).sum(),
            },
        };
        let refined = range.applied_to(matched);
        if refined.is_valid() { refined } else { self }
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

/// Returns the cameras of frames `context`.
fn context_cameras(scene: &Scene, context: &[usize]) -> Result<Vec<Camera>> {
    let camera = |&i: &usize| match scene.frames.get(i) {
        Some(frame) => Ok(frame.camera),
        None => {
            let expected = format!("frames below {}", scene.frames.len());
            Err(Error::argument(&scene.name, expected, i.to_string()))
        }
    };
    context.iter().map(camera).collect()
}

/// Guesses both ends from the largest distance between two cameras.
fn guess_from_cameras(cameras: &[Camera]) -> Result<DepthBounds> {
    let mut distance = 0.0f32;
    for (i, a) in cameras.iter().enumerate() {
        for b in &cameras[i + 1..] {
            distance = distance.max(a.position().distance(b.position()));
        }
    }
    if !(distance > 0.0 && distance.is_finite()) {
        let expected = "cameras at different places, or near and far";
        let got = format!("a distance of {distance} between the cameras");
        return Err(Error::argument("depth range", expected, got));
    }
    Ok(DepthBounds {
        near: NEAR_BASELINES * distance,
        far: FAR_BASELINES * distance,
        source: DepthSource::Baseline { distance },
    })
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
            let guess = DepthBounds::initial(&cameras(0.125), range, None).unwrap();
            guess.refined(range, reports)
        };
        let auto = refined(DepthRange::Auto, &reports);
        assert_eq!(ends(&auto), (0.6, 12.0));
        assert_eq!(auto.source.to_string(), "from 80 points matched between the photographs");
        let near = refined(DepthRange::Near(1.0), &reports);
        assert_eq!(ends(&near), (1.0, 12.0));
        assert_eq!(
            near.source.to_string(),
            "near as given, far from 80 points matched between the photographs"
        );
        assert_eq!(ends(&refined(DepthRange::Far(20.0), &reports)), (0.6, 20.0));
        // Points beyond the fixed far end leave the guess.
        assert_eq!(ends(&refined(DepthRange::Far(0.5), &reports)), (0.0625, 0.5));
        let prior = DepthBounds::new(0.01, 0.5, DepthSource::PoseFile);
        let known = DepthBounds::initial(&cameras(1.0), DepthRange::Auto, Some(&prior)).unwrap();
        assert_eq!(known.clone().refined(DepthRange::Auto, &reports), known);
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
            DepthBounds::initial(&cameras(2.0), range, prior)
                .map(|b| (ends(&b), b.source.to_string()))
        };
        let (both, text) =
            initial(DepthRange::Fixed { near: 3.0, far: 4.0 }, Some(&prior)).unwrap();
        assert_eq!((both, text.as_str()), ((3.0, 4.0), "as given"));
        let (near, text) = initial(DepthRange::Near(3.0), Some(&prior)).unwrap();
        assert_eq!(near, (3.0, 100.0));
        assert_eq!(text, "near as given, far the usual range of RealEstate10K");
        assert_eq!(initial(DepthRange::Auto, Some(&prior)).unwrap().0, (1.0, 100.0));
        let (guess, text) = initial(DepthRange::Far(9.0), None).unwrap();
        assert_eq!(guess, (1.0, 9.0));
        assert!(text.ends_with("(2.0000)"), "{text}");
        for (near, far) in [(5.0, 1.0), (-1.0, 2.0), (f32::NAN, 2.0), (1.0, f32::INFINITY)] {
            let error = initial(DepthRange::Fixed { near, far }, None).unwrap_err().to_string();
            assert!(error.contains(&format!("near {near}, far {far}")), "{error}");
        }
        let error = DepthBounds::initial(&cameras(0.0), DepthRange::Auto, None).unwrap_err();
        assert!(error.to_string().contains("a distance of 0 between"), "{error}");
    }
}
