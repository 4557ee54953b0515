//! Reasons against an estimate: those that weaken it, and those for which there is none.

use super::photo::{PosePhoto, STATED};

/// A weakness of an estimate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PoseWarning {
    /// Too little is known of the focal length.
    #[error("the focal length is uncertain by {percent:.0} %")]
    UncertainFocal {
        /// Standard deviation, percent.
        percent: f64,
    },
    /// The focal length is a result of two photographs alone.
    #[error(
        "the focal length ({focal_px:.0} px) was estimated from two photographs, which often fails: \
         give --fov or --intrinsics, or more photographs"
    )]
    FocalOfTwo {
        /// The focal length, px of the first photograph.
        focal_px: f64,
    },
    /// Another pose explains the matches nearly as well.
    #[error("another position of the cameras explains {percent:.0} % of what this one explains")]
    Rival {
        /// Support of the other pose, percent of the support of this one.
        percent: f64,
    },
    /// Few matches support the pose.
    #[error("only {count} matched points support the cameras")]
    FewPoints {
        /// Number of matches.
        count: usize,
    },
    /// The statistical error is large.
    #[error("the direction between the cameras is uncertain by {degrees:.1} degrees")]
    UncertainDirection {
        /// Standard deviation, degrees.
        degrees: f64,
    },
    /// An unknown focal length came out as that of a long lens.
    #[error(
        "the estimated angle of view is only {degrees:.0} degrees: pictures that hold two views side by side, or a \
         part of a panorama, lead to such an estimate; give --fov if the lens is a long one"
    )]
    NarrowView {
        /// Angle across the longer side, degrees.
        degrees: f64,
    },
    /// Features stand still in the pictures. They were left out, so that the cameras are as certain as without them.
    #[error(
        "{percent:.0} % of the features stand still in the pictures while the camera moves (a logo, a frame, a part \
         of what carries the camera); the cameras are estimated without them, and a folder `masks` leaves such \
         pixels out of the scene"
    )]
    StandsStill {
        /// Share of the features, percent.
        percent: f64,
    },
    /// The photographs have different focal lengths, which the points tell. Each camera has its own.
    #[error(
        "the focal lengths of the photographs differ by up to {percent:.0} %, as those of a zoom lens or of pictures that \
         were cropped: each photograph has its own"
    )]
    Zoomed {
        /// The longest over the shortest, less one, percent.
        percent: f64,
    },
    /// The points contradict the focal length that was given.
    #[error(
        "the points contradict the focal length that was given: they fit one that is about {percent:.0} % {}; without \
         --fov and --intrinsics it is estimated", if *.is_longer { "longer" } else { "shorter" }
    )]
    ContradictedFocal {
        /// Difference, percent of the given one.
        percent: f64,
        /// The points fit a longer one.
        is_longer: bool,
    },
    /// The lens bends straight lines, but the straightened photographs have cameras for fewer of them.
    #[error(
        "the lens seems to bend straight lines, but photographs that were straightened fit together worse; straighten \
         them with another program, or give cameras with their distortion"
    )]
    BentLines,
    /// A refusal that [`Uncertain::Accept`](super::Uncertain::Accept) overrode.
    #[error("{0}")]
    Forced(PoseRefusal),
}

impl PoseWarning {
    /// The warning of a focal length that points fit, over the one that was given.
    pub(super) fn contradicted(found: f64) -> Self {
        Self::ContradictedFocal { percent: 100.0 * (found - 1.0).abs(), is_longer: found > 1.0 }
    }
}

/// Reason for which photographs get no cameras.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PoseRefusal {
    /// Fewer than two photographs.
    #[error("expected at least 2 photographs, got {count}")]
    TooFew {
        /// Number of photographs.
        count: usize,
    },
    /// The photographs are equal.
    #[error(
        "the photographs show the same view: matched points move by {shift_px:.1} px at most; take \
         the second photograph from a place a step aside"
    )]
    SameView {
        /// Median shift of the matched points, px of a photograph of 640 px.
        shift_px: f64,
    },
    /// The camera turned at one place.
    #[error(
        "the camera turned by {degrees:.0} degrees but did not move: points shift by \
         {parallax_px:.1} px (of 640 px) beside the turn; take the second photograph from a place a \
         step aside"
    )]
    PureRotation {
        /// Angle of the rotation, degrees.
        degrees: f64,
        /// Median shift of the points beside the rotation, px of a photograph of 640 px.
        parallax_px: f64,
    },
    /// Too few matches agree with one geometry.
    #[error(
        "only {consistent} of {matches} matched points agree with one position of the cameras \
         ({needed} are needed): different places, a mirrored photograph, or too little in common; \
         take photographs with more overlap and more texture"
    )]
    FewMatches {
        /// Number of matches that agree.
        consistent: usize,
        /// Number of matches.
        matches: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// One of two photographs is mirrored.
    #[error(
        "one of the photographs is mirrored: {consistent} matched points agree with one position of \
         the cameras once the second one is flipped left to right; flip one of them"
    )]
    Mirrored {
        /// Number of matches that agree.
        consistent: usize,
    },
    /// Several cameras explain the matches equally well.
    #[error(
        "two different positions of the cameras explain the matched points equally well ({percent:.0} \
         %); take photographs of a scene that is less flat, or give --fov"
    )]
    Ambiguous {
        /// Support of the second position, percent of the support of the first.
        percent: f64,
    },
    /// No pair of photographs is wide enough to start with.
    #[error("no two of the photographs have enough in common and enough distance")]
    NoPair,
}

/// Focal length over the longer side of a picture, above which an estimate is doubtful: 37 degrees, a lens of 54 mm.
/// Estimates of stereo pictures side by side, of files of two fisheye lenses and of panoramas without their zenith have
/// 1.52, 1.72 and 1.58.
const LONG_FOCAL: f64 = 1.5;

/// Warns of a focal length `scale` times the lenses' where none is stated and the result is that of a long lens.
pub(super) fn narrow_view(photos: &[&PosePhoto], scale: f64) -> Option<PoseWarning> {
    let focal = |photo: &&PosePhoto| {
        let k = photo.lens.intrinsics;
        f64::from(k.fx.max(k.fy)) * scale / k.width.max(k.height) as f64
    };
    let unknown = photos.iter().filter(|photo| photo.lens.deviation > STATED);
    let longest = unknown.map(focal).fold(0.0, f64::max);
    let degrees = 2.0 * (0.5 / longest).atan().to_degrees();
    (longest > LONG_FOCAL).then_some(PoseWarning::NarrowView { degrees })
}
