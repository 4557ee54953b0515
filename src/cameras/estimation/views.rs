//! Photographs of several pinhole views with one centre and known rotations, as panoramas have them: a rig whose
//! pose is estimated as that of one camera.
//!
//! The views lie side by side in one working picture. A feature belongs to the view at its place, and its bearing
//! lies on that view's plane z = 1, because residuals in px are uniform there. The essential matrix, the depths and
//! the projections of two such features are those between their two views ([`Bearings::views`],
//! [`Sight::view`](super::absolute::Sight::view)). Therefore pairs, tracks and bundle adjustment treat panoramas and
//! photographs alike, also together.
//!
//! [`Bearings::views`]: super::two_view::Bearings::views

use super::photo::{Lens, PosePhoto, PosePhotoError};
use crate::cameras::matches::GrayImage;
use crate::cameras::matches::descriptors::DESCRIPTOR;
use crate::cameras::matches::features::{Feature, Features, Orientation, detect};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Longer side of a view in which points are matched, px.
const VIEW_SIDE: usize = 800;

/// A pinhole view of a photograph.
#[derive(Clone, Copy, Debug)]
pub struct PhotoView<'a> {
    /// Pixels.
    pub picture: &'a Rgb,
    /// Pixels that count; `None` for all.
    pub mask: Option<&'a Mask>,
    /// Rotation from the photograph's axes to those of the view.
    pub view_from_photo: DMat3,
}

/// A view with its features.
struct Part<'a> {
    picture: &'a Rgb,
    image: GrayImage,
    features: Features,
}

impl PosePhoto {
    /// Photograph of several pinhole views with one centre and known rotations. All views have the size and the
    /// exact intrinsics `view`. Camera and points of the estimate refer to the photograph's axes; positions are px
    /// of the views side by side, in their order. `max_features` counts those of one view.
    ///
    /// A direction that several views show gives features in the view whose middle is nearest.
    ///
    /// # Errors
    /// Those of [`PosePhoto::from_rgb8`]; no view.
    pub fn from_views(
        views: &[PhotoView<'_>],
        view: Intrinsics,
        max_features: usize,
    ) -> Result<Self, PosePhotoError> {
        view.check()?;
        let working = working(&view);
        let turns: Vec<DMat3> = views.iter().map(|v| v.view_from_photo).collect();
        let parts: Vec<Part<'_>> = views
            .iter()
            .map(|v| Part::new(v, &view, &working, max_features))
            .collect::<Result<_, _>>()?;
        // The strongest first, as of one picture.
        let mut order: Vec<(usize, usize)> = Vec::new();
        for (i, part) in parts.iter().enumerate() {
            let own = |n: &usize| is_nearest(&turns, i, &part.features.points[*n], &working);
            order.extend((0..part.features.points.len()).filter(own).map(|n| (i, n)));
        }
        let response = |(i, n): (usize, usize)| parts[i].features.points[n].response;
        order.sort_by(|&p, &q| response(q).total_cmp(&response(p)).then(p.cmp(&q)));
        let (mut features, mut colours) = (Features::default(), Vec::with_capacity(order.len()));
        for (i, n) in order {
            let part = &parts[i];
            let mut point = part.features.points[n].clone();
            colours.push(part.colour(&point, &working));
            point.x += (i * working.width) as f32;
            features.points.push(point);
            let row = n * DESCRIPTOR..(n + 1) * DESCRIPTOR;
            features.descriptors.extend_from_slice(&part.features.descriptors[row]);
        }
        let images: Vec<GrayImage> = parts.into_iter().map(|part| part.image).collect();
        let none = PosePhotoError::Length { width: view.width, height: view.height, found: 0 };
        let image = GrayImage::side_by_side(&images).ok_or(none)?;
        let (lens, bearings) = (Lens::known(view), Vec::new());
        let views = turns;
        let mut photo =
            Self { image, features, lens, working, bend: 0.0, bearings, colours, views };
        photo.update_bearings();
        Ok(photo)
    }

    /// Returns whether the photograph consists of several views.
    pub(super) fn has_views(&self) -> bool {
        !self.views.is_empty()
    }

    /// Index of the view at a position of the working picture, px; 0 for a photograph that is one view.
    pub(super) fn view_at(&self, px: DVec2) -> usize {
        // `as` saturates: any position gives a valid index.
        ((px.x / self.working.width as f64) as usize).min(self.views.len().saturating_sub(1))
    }

    /// Rotation from the photograph's axes to those of the view that shows feature `i`; `None` for a photograph
    /// that is one view.
    pub(super) fn view_of(&self, i: usize) -> Option<DMat3> {
        self.views.get(self.view_at(self.position(i))).copied()
    }

    /// Direction of feature `i` in the photograph's axes, of unit length.
    pub(super) fn ray(&self, i: usize) -> DVec3 {
        let ray = self.bearings[i].extend(1.0).normalize();
        self.view_of(i).map_or(ray, |view| view.transpose() * ray)
    }

    /// Projects a point of the world to the photograph, in the view that shows feature `i`, px.
    pub(super) fn project(&self, camera: &Camera, i: usize, point: Vec3) -> Option<Vec2> {
        let Some(view) = self.view_of(i) else { return camera.project(point) };
        let p = view * camera.to_camera(point).as_dvec3();
        let k = &self.lens.intrinsics;
        let at = DVec2::new(f64::from(k.fx), f64::from(k.fy)) * p.truncate() / p.z;
        let start = self.view_at(self.position(i)) * k.width;
        let px = at + DVec2::new(f64::from(k.cx) + start as f64, f64::from(k.cy));
        (p.z > 0.0).then(|| px.as_vec2())
    }
}

/// The intrinsics of a view at its working size.
fn working(view: &Intrinsics) -> Intrinsics {
    let longer = view.width.max(view.height);
    let side = VIEW_SIDE.min(longer);
    view.resized((view.width * side).div_ceil(longer), (view.height * side).div_ceil(longer))
}

impl<'a> Part<'a> {
    fn new(
        from: &PhotoView<'a>,
        view: &Intrinsics,
        working: &Intrinsics,
        max_features: usize,
    ) -> Result<Self, PosePhotoError> {
        let picture = from.picture;
        let (width, height, found) = (view.width, view.height, picture.data.len());
        let length = PosePhotoError::Length { width, height, found };
        if (picture.width, picture.height) != (width, height) {
            return Err(length);
        }
        let image = GrayImage::from_picture(picture, from.mask).ok_or(length)?;
        let image = image.reduced(working.width, working.height);
        let features = detect(&image, max_features, Orientation::Upright);
        Ok(Self { picture, image, features })
    }

    /// Colour of the view at a feature.
    fn colour(&self, feature: &Feature, working: &Intrinsics) -> [u8; 3] {
        let Rgb { width, height, .. } = *self.picture;
        // `as` saturates: any position gives a valid index.
        let at = |v: f32, from: usize, to: usize| {
            ((v * to as f32 / from as f32) as usize).min(to.saturating_sub(1))
        };
        let (x, y) = (at(feature.x, working.width, width), at(feature.y, working.height, height));
        let pixel = 3 * (y * width + x);
        [0, 1, 2].map(|c| self.picture.data[pixel + c])
    }
}

/// Returns whether view `i` is the one whose middle is nearest to a feature of it; of two that are equally near it
/// is the first.
fn is_nearest(views: &[DMat3], i: usize, feature: &Feature, working: &Intrinsics) -> bool {
    let k = working;
    let at = Vec2::new((feature.x - k.cx) / k.fx, (feature.y - k.cy) / k.fy);
    let ray = views[i].transpose() * at.as_dvec2().extend(1.0);
    let own = (views[i] * ray).z;
    let nearer = |j: usize| {
        let other = (views[j] * ray).z;
        if j < i { other >= own - 1e-9 } else { other > own + 1e-9 }
    };
    (0..views.len()).all(|j| j == i || !nearer(j))
}
