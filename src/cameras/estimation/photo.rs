//! A photograph for pose estimation: its features and what is known of its lens.

use super::bend;
use super::two_view::Bearings;
use crate::cameras::matches::descriptors::DESCRIPTOR;
use crate::cameras::matches::features;
use crate::cameras::matches::features::{Features, Orientation};
use crate::cameras::matches::pairs::Pair;
use crate::cameras::matches::{GrayImage, align};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use subsplat_kernels::camera::{CameraError, Intrinsics};

/// Focal length over the longer side that is assumed without any other knowledge: phones' main
/// cameras and lenses of 26 mm to 28 mm (35 mm format) have 0.7 to 0.78.
const TYPICAL_FOCAL: f64 = 0.75;
/// Standard deviation of the logarithm of an assumed focal length: lenses from 16 mm to 50 mm lie
/// within two of them.
pub(super) const UNKNOWN_DEVIATION: f64 = 0.35;
/// Standard deviation of the logarithm of a focal length that EXIF states: rounded to whole
/// millimetres of the 35 mm format, and changed a little by the focus.
const STATED_DEVIATION: f64 = 0.03;

/// Standard deviation of the focal length's logarithm above which a photograph's file did not state it.
pub(super) const STATED: f64 = 0.1;

/// Lens of a photograph: a pinhole camera, and the uncertainty of its focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// The intrinsics as far as they are known, px of the photograph.
    pub intrinsics: Intrinsics,
    /// Standard deviation of the logarithm of the focal length: 0 where it is exact, 0.03 means
    /// three percent.
    pub deviation: f64,
}

impl Lens {
    /// Intrinsics that are known and kept.
    pub fn known(intrinsics: Intrinsics) -> Self {
        Self { intrinsics, deviation: 0.0 }
    }

    /// A focal length that the photograph's file states, px; the principal point is the middle. The
    /// estimation changes it by a few percent.
    pub fn stated(focal: f32, width: usize, height: usize) -> Self {
        Self::central(focal, STATED_DEVIATION, width, height)
    }

    /// Nothing is known: three quarters of the longer side, which the estimation may change freely.
    pub fn unknown(width: usize, height: usize) -> Self {
        let focal = (TYPICAL_FOCAL * width.max(height) as f64) as f32;
        Self::central(focal, UNKNOWN_DEVIATION, width, height)
    }

    fn central(focal: f32, deviation: f64, width: usize, height: usize) -> Self {
        let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx, cy, width, height };
        Self { intrinsics, deviation }
    }
}

/// Reason for which a photograph cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PosePhotoError {
    /// The lens is no camera.
    #[error(transparent)]
    Lens(#[from] CameraError),
    /// The uncertainty of the focal length is no number, infinite or negative.
    #[error("standard deviation of the focal length: expected a number from 0, got {found}")]
    Deviation {
        /// The value.
        found: f64,
    },
    /// The pixels do not have the lens's size.
    #[error("photograph: expected 3 bytes for each of {width}x{height} pixels, got {found} bytes")]
    Length {
        /// Width of the lens's picture, px.
        width: usize,
        /// Height of the lens's picture, px.
        height: usize,
        /// Number of bytes.
        found: usize,
    },
}

/// A photograph's features with its lens.
#[derive(Clone, Debug)]
pub struct PosePhoto {
    /// The photograph, reduced to the working size.
    pub(super) image: GrayImage,
    pub(super) features: Features,
    /// Lens in px of the photograph.
    pub(super) lens: Lens,
    /// Lens in px of the working size.
    pub(super) working: Intrinsics,
    /// Bend k of the lens, for its own focal length ([`bend`]).
    pub(super) bend: f64,
    /// Each feature on the plane z = 1, for the lens's own focal length, without the lens's bend.
    pub(super) bearings: Vec<DVec2>,
    /// Colour at each feature.
    pub(super) colours: Vec<[u8; 3]>,
    /// Rotations from the photograph's axes to those of its views, whose pictures lie side by side in `image`;
    /// empty for a photograph that is one view ([`PosePhoto::from_views`]).
    pub(super) views: Vec<DMat3>,
}

/// Longer side of the photographs in which points are matched, px.
const WORKING_SIDE: usize = 1600;

impl PosePhoto {
    /// Detects at most `max_features` features of a photograph of interleaved 8-bit RGB. `lens` is
    /// in px of the photograph.
    ///
    /// # Errors
    /// A lens that is no camera; `rgb` of another length than 3·W·H of the lens's size.
    pub fn from_rgb8(rgb: &[u8], lens: Lens, max_features: usize) -> Result<Self, PosePhotoError> {
        Self::detected(rgb, |w, h| GrayImage::from_rgb8(w, h, rgb), lens, max_features)
    }

    /// [`PosePhoto::from_rgb8`] of the pixels that `mask` keeps. A mask of another size is ignored.
    ///
    /// # Errors
    /// Those of [`PosePhoto::from_rgb8`].
    pub fn from_picture(
        picture: &Rgb,
        mask: Option<&Mask>,
        lens: Lens,
        max_features: usize,
    ) -> Result<Self, PosePhotoError> {
        let mask = mask.filter(|mask| mask.fits(picture));
        let size = (picture.width, picture.height);
        let grey = |w, h| match mask {
            Some(_) if (w, h) == size => GrayImage::from_picture(picture, mask),
            _ => GrayImage::from_rgb8(w, h, &picture.data),
        };
        Self::detected(&picture.data, grey, lens, max_features)
    }

    /// Detects the features of `rgb` in its grey `image` of a given size.
    fn detected(
        rgb: &[u8],
        image: impl FnOnce(usize, usize) -> Option<GrayImage>,
        lens: Lens,
        max_features: usize,
    ) -> Result<Self, PosePhotoError> {
        lens.intrinsics.check()?;
        if !(lens.deviation >= 0.0 && lens.deviation.is_finite()) {
            return Err(PosePhotoError::Deviation { found: lens.deviation });
        }
        let (w, h) = (lens.intrinsics.width, lens.intrinsics.height);
        let length = PosePhotoError::Length { width: w, height: h, found: rgb.len() };
        let image = image(w, h).ok_or(length)?;
        let mut photo = Self::new(image, lens, max_features, Orientation::Upright);
        photo.sample_colours(|x, y| {
            let at = 3 * (y * w + x);
            [rgb[at], rgb[at + 1], rgb[at + 2]]
        });
        Ok(photo)
    }

    fn new(image: GrayImage, lens: Lens, count: usize, orientation: Orientation) -> Self {
        let (w, h) = (image.width(), image.height());
        let factor = (WORKING_SIDE as f64 / w.max(h) as f64).min(1.0);
        let side = |v: usize| ((v as f64 * factor).round() as usize).clamp(1, v);
        let image = if factor < 1.0 { image.reduced(side(w), side(h)) } else { image };
        let features = features::detect(&image, count, orientation);
        let working = lens.intrinsics.resized(image.width(), image.height());
        let (bearings, colours, views) = (Vec::new(), Vec::new(), Vec::new());
        let mut photo =
            Self { image, features, lens, working, bend: 0.0, bearings, colours, views };
        photo.update_bearings();
        photo
    }

    /// Computes the bearings of all features.
    pub(super) fn update_bearings(&mut self) {
        let all = 0..self.features.points.len();
        self.bearings = all.map(|i| self.bearing(self.position(i))).collect();
    }

    /// Samples the colour of each feature from the photograph.
    fn sample_colours(&mut self, colour: impl Fn(usize, usize) -> [u8; 3]) {
        let Intrinsics { width: w, height: h, .. } = self.lens.intrinsics;
        let all = 0..self.features.points.len();
        self.colours = all
            .map(|i| {
                let px = self.in_photograph(self.position(i));
                colour((px.x.max(0.0) as usize).min(w - 1), (px.y.max(0.0) as usize).min(h - 1))
            })
            .collect();
    }

    /// The same photograph with descriptors that are rotated along the gradients, for photographs
    /// that roll against each other.
    pub(super) fn with_rotated_features(&self) -> Self {
        let count = self.features.points.len();
        let mut photo = Self::new(self.image.clone(), self.lens, count, Orientation::Gradient);
        let nearest = |at: DVec2| {
            let places = self.features.points.iter();
            let distance = |f: &features::Feature| {
                DVec2::new(f64::from(f.x), f64::from(f.y)).distance_squared(at)
            };
            let closest = places.enumerate().min_by(|a, b| distance(a.1).total_cmp(&distance(b.1)));
            closest.and_then(|(i, _)| self.colours.get(i).copied()).unwrap_or_default()
        };
        photo.colours =
            (0..photo.features.points.len()).map(|i| nearest(photo.position(i))).collect();
        photo
    }

    /// The photograph mirrored left to right, without colours.
    pub(super) fn flipped(&self) -> Self {
        let mut lens = self.lens;
        lens.intrinsics.cx = lens.intrinsics.width as f32 - lens.intrinsics.cx;
        let count = self.features.points.len();
        let mut photo = Self::new(self.image.flipped(), lens, count, Orientation::Upright);
        photo.colours = vec![[0; 3]; photo.features.points.len()];
        photo
    }

    /// The same photograph with a focal length `scale` times as long, which is then exact.
    ///
    /// Views of one photograph have known directions, so that their focal length stays as it is.
    pub(super) fn with_focal(&self, scale: f64) -> Self {
        let mut photo = self.clone();
        if self.has_views() {
            return photo;
        }
        for k in [&mut photo.lens.intrinsics, &mut photo.working] {
            k.fx *= scale as f32;
            k.fy *= scale as f32;
        }
        photo.lens.deviation = 0.0;
        photo.bend *= scale * scale;
        photo.update_bearings();
        photo
    }

    /// The same photograph with a focal length `scale` times as long, of which as much is known as before.
    pub(super) fn zoomed(&self, scale: f64) -> Self {
        let mut photo = self.with_focal(scale);
        photo.lens.deviation = self.lens.deviation;
        photo
    }

    /// The same photograph with a lens that bends by `k` ([`bend`]).
    pub(super) fn with_bend(mut self, k: f64) -> Self {
        self.bend = k;
        self.update_bearings();
        self
    }

    /// The same photograph without the features that `left_out` marks.
    pub(super) fn without(&self, left_out: &[bool]) -> Self {
        let mut photo = self.clone();
        let kept: Vec<usize> = (0..self.feature_count()).filter(|&i| !left_out[i]).collect();
        photo.features.points = kept.iter().map(|&i| self.features.points[i].clone()).collect();
        photo.bearings = kept.iter().map(|&i| self.bearings[i]).collect();
        photo.colours = kept.iter().filter_map(|&i| self.colours.get(i).copied()).collect();
        let row = |&i: &usize| &self.features.descriptors[i * DESCRIPTOR..(i + 1) * DESCRIPTOR];
        photo.features.descriptors = kept.iter().flat_map(row).copied().collect();
        photo
    }

    /// Number of features.
    pub fn feature_count(&self) -> usize {
        self.features.points.len()
    }

    /// Position in the photograph of a position of the working picture, px.
    pub(super) fn in_photograph(&self, px: DVec2) -> DVec2 {
        let k = &self.lens.intrinsics;
        let scale = DVec2::new(
            k.width as f64 / self.working.width as f64,
            k.height as f64 / self.working.height as f64,
        );
        px * scale
    }

    /// Point on the plane z = 1 of a position of the working picture, px, without the lens's bend.
    pub(super) fn bearing(&self, px: DVec2) -> DVec2 {
        let seen = self.seen(px);
        if self.bend == 0.0 { seen } else { bend::straight(seen, self.bend) }
    }

    /// The same as the lens bends it.
    fn seen(&self, px: DVec2) -> DVec2 {
        let k = &self.working;
        let start = DVec2::new((self.view_at(px) * k.width) as f64, 0.0);
        let centred = px - start - DVec2::new(f64::from(k.cx), f64::from(k.cy));
        centred / DVec2::new(f64::from(k.fx), f64::from(k.fy))
    }

    /// Position of feature `i` in the working picture, px.
    pub(super) fn position(&self, i: usize) -> DVec2 {
        let f = &self.features.points[i];
        DVec2::new(f64::from(f.x), f64::from(f.y))
    }

    /// Working px per unit of the plane z = 1.
    pub(super) fn focal(&self) -> f64 {
        f64::from(self.working.fx).min(f64::from(self.working.fy))
    }
}

/// Standard deviation of a match across its epipolar line, working px. This value, the next one and
/// `pair::LIMIT` gave the best poses among 18 combinations on 53 pairs of `../shared/photos` that
/// the report does not use.
const FEATURE_DEVIATION: f64 = 0.4;
/// The same after the alignment of the surroundings.
const ALIGNED_DEVIATION: f64 = 0.1;

/// Standard deviations of detected and of aligned features, units of the plane z = 1.
pub(super) fn deviations(photo: &PosePhoto) -> [f64; 2] {
    [FEATURE_DEVIATION, ALIGNED_DEVIATION].map(|d| d / photo.focal())
}

impl PosePhoto {
    /// [`deviations`] of feature `i`, where the lens's bend was taken out.
    pub(super) fn deviations_of(&self, i: usize) -> [f64; 2] {
        let all = deviations(self);
        if self.bend == 0.0 {
            return all;
        }
        let seen = self.seen(self.position(i));
        all.map(|d| d * bend::stretch(seen, self.bend))
    }
}

/// Returns the matches of `found` as they were detected.
pub(super) fn detected(a: &PosePhoto, b: &PosePhoto, found: &[Pair]) -> Vec<Bearings> {
    found.iter().map(|p| bearings(a, b, p.a, p.b)).collect()
}

/// The match of feature `i` of `a` with feature `j` of `b`, as they were detected.
pub(super) fn bearings(a: &PosePhoto, b: &PosePhoto, i: usize, j: usize) -> Bearings {
    let deviation = 0.5 * (a.deviations_of(i)[0] + b.deviations_of(j)[0]);
    let (of_a, of_b) = (a.view_of(i), b.view_of(j));
    let turn = |view: Option<DMat3>| view.unwrap_or(DMat3::IDENTITY);
    let views = (of_a.is_some() || of_b.is_some()).then(|| [of_a, of_b].map(turn));
    Bearings { a: a.bearings[i], b: b.bearings[j], deviation, views }
}

/// Returns the matches of `found` with the second point moved to where the surroundings of both
/// agree. Matches whose surroundings do not agree keep their place and a larger deviation.
pub(super) fn aligned(a: &PosePhoto, b: &PosePhoto, found: &[Pair]) -> Vec<Bearings> {
    let mut matches = detected(a, b, found);
    matches.par_iter_mut().zip(found).for_each(|(m, p)| {
        if let Some(place) = aligned_position((a, p.a), (b, p.b)) {
            m.b = b.bearing(place);
            m.deviation = 0.5 * (a.deviations_of(p.a)[1] + b.deviations_of(p.b)[1]);
        }
    });
    matches
}

/// Position in the second photograph, working px, where the surroundings agree with those of a
/// feature of the first. Each photograph comes with the index of its feature.
pub(super) fn aligned_position(
    (a, i): (&PosePhoto, usize),
    (b, j): (&PosePhoto, usize),
) -> Option<DVec2> {
    let sizes = [a.features.points[i].size, b.features.points[j].size].map(f64::from);
    align::aligned([&a.image, &b.image], [a.position(i), b.position(j)], sizes)
}
