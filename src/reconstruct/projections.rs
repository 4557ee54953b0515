//! Photographs of several projections before and after the estimation of their cameras: pinhole photographs,
//! pictures of fisheye lenses and of lenses that bend lines (one pinhole view of each), and panoramas (views of one
//! centre with known rotations).

use super::Result;
use super::estimate_cameras::{EstimateOptions, KnownLens, LensSource, lens};
use crate::cameras::estimation::{Lens, PhotoView, PoseEstimate, PosePhoto, PosePoint, RadialLens};
use crate::files::Error as FileError;
use crate::files::photos::distortion::Distortion;
use crate::files::photos::photograph::{Photograph, load_photograph_or_panorama, panorama_shape};
use crate::files::photos::shape::{ImageCircle, edges_meet, has_two_circles, image_circle};
use crate::files::photos::undistort;
use crate::files::photos::views::{
    Cut, YAWS, fisheye_cut, has_panorama_shape, own_axes, panorama_cut, panorama_view, shared_axes,
    view_label,
};
use crate::files::poses::scene::PosedView;
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DMat3, DVec2, DVec3, Mat4};
use std::f64::consts::PI;
use std::ops::Range;
use std::path::Path;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Projection of photographs without a pose file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum Projection {
    /// A panorama where the file's metadata say so, or where a picture of two to one has edges that continue each
    /// other; else a pinhole.
    #[default]
    Detected,
    /// A pinhole, whatever the file says.
    Pinhole,
    /// An equirectangular panorama of 360° by 180°.
    Panorama,
    /// A fisheye lens.
    Fisheye(FisheyeLens),
}

/// A fisheye lens, whose image circle is found in each picture. Without a circle the angle spans the picture's
/// diagonal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FisheyeLens {
    /// Angle across the image circle, radians.
    pub angle: f64,
    /// Radius of a direction in the picture.
    pub curve: FisheyeCurve,
}

impl Default for FisheyeLens {
    fn default() -> Self {
        Self { angle: PI, curve: FisheyeCurve::default() }
    }
}

/// Radius r of a direction at the angle θ from the axis, f the focal length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FisheyeCurve {
    /// r = f·θ.
    #[default]
    Equidistant,
    /// r = 2f·sin(θ/2).
    Equisolid,
    /// r = 2f·tan(θ/2).
    Stereographic,
}

impl FisheyeCurve {
    /// Radius for f = 1.
    fn radius(self, theta: f64) -> f64 {
        match self {
            Self::Equidistant => theta,
            Self::Equisolid => 2.0 * (0.5 * theta).sin(),
            Self::Stereographic => 2.0 * (0.5 * theta).tan(),
        }
    }

    /// The radius as a polynomial: Taylor's series. Views reach 60°, where the error is below 2e-5.
    fn distortion(self) -> Distortion {
        Distortion::fisheye(match self {
            Self::Equidistant => [0.0; 4],
            Self::Equisolid => [-1.0 / 24.0, 1.0 / 1920.0, -1.0 / 322_560.0, 0.0],
            Self::Stereographic => [1.0 / 12.0, 1.0 / 120.0, 17.0 / 20_160.0, 31.0 / 362_880.0],
        })
    }
}

/// Projection of one photograph, found or given.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "one of each photograph")]
enum Shape {
    Pinhole,
    /// One pinhole view, of which the estimated camera is.
    View(Cut),
    /// The estimated camera is the panorama's.
    Panorama {
        width: usize,
        height: usize,
        /// The part that the photograph shows.
        part: Part,
    },
}

/// Least share of a view that the shown part of a panorama fills.
const LEAST_SHOWN: f64 = 0.25;

/// The rectangle of a panorama that is not masked.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Part {
    /// Left and top edge, px.
    low: [f64; 2],
    /// Right and bottom edge, px.
    high: [f64; 2],
}

impl Part {
    /// The rectangle around the pixels that a mask keeps.
    fn of(mask: Option<&Mask>, [width, height]: [usize; 2]) -> Self {
        let whole = Self { low: [0.0; 2], high: [width as f64, height as f64] };
        let Some(mask) = mask else { return whole };
        let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
        let kept = mask.kept().iter().enumerate().filter(|(_, kept)| **kept);
        for (i, _) in kept {
            let at = [i % width, i / width];
            low = [low[0].min(at[0]), low[1].min(at[1])];
            high = [high[0].max(at[0] + 1), high[1].max(at[1] + 1)];
        }
        let px = |at: [usize; 2]| at.map(|v| v as f64);
        if high == [0; 2] { whole } else { Self { low: px(low), high: px(high) } }
    }

    /// Returns whether a view shows enough of it.
    fn is_in(&self, cut: &Cut) -> bool {
        cut.share_of(self.low, self.high) >= LEAST_SHOWN
    }
}

/// A photograph as the estimation sees it.
pub(super) struct Prepared {
    /// Features.
    pub photo: PosePhoto,
    /// Origin of the focal length.
    pub source: LensSource,
    /// Warnings about the photograph.
    pub warnings: Vec<String>,
    shape: Shape,
}

/// Loads a photograph and detects at most `features` features.
///
/// # Errors
/// A photograph that cannot be read; a panorama or a fisheye picture that is none, by its shape; two fisheye pictures in
/// one.
pub(super) fn prepare(path: &Path, options: &EstimateOptions, features: usize) -> Result<Prepared> {
    let (mut photograph, stated) = load_photograph_or_panorama(path, &options.load)?;
    let mut warnings = std::mem::take(&mut photograph.warnings);
    let Rgb { width, height, .. } = photograph.image;
    if options.projection == Projection::Detected && has_two_circles(&photograph.image) {
        let got = "the two circles of a 360-degree camera's lenses, side by side (export panoramas with the camera's \
                   program; --lens pinhole reads it as it is)";
        return Err(FileError::format(path, "a photograph or a panorama", got).into());
    }
    let panorama = match options.projection {
        Projection::Panorama => true,
        Projection::Pinhole | Projection::Fisheye(_) => false,
        Projection::Detected if stated => true,
        Projection::Detected => {
            let suspect = panorama_shape(&photograph.camera, width, height, path);
            let meet = suspect.is_some() && edges_meet(&photograph.image);
            if meet {
                warnings.push(format!(
                    "{}: read as a panorama, because its left and right edges continue each other; --lens pinhole \
                     reads it as a photograph",
                    path.display()
                ));
            } else {
                warnings.extend(suspect);
            }
            meet
        }
    };
    if panorama {
        return of_panorama(path, &photograph, features, warnings);
    }
    if let Projection::Fisheye(fisheye) = options.projection {
        return of_fisheye(path, &photograph, fisheye, features, warnings);
    }
    if options.projection == Projection::Detected && image_circle(&photograph.image).is_some() {
        warnings.push(format!(
            "{}: a bright disc on black looks like the circle of a fisheye lens, which is read wrongly as a \
             photograph: --lens fisheye (or fisheye:190 for a lens of 190 degrees) reads it",
            path.display()
        ));
    }
    let (lens, source) = lens(&photograph, options.lens);
    let Photograph { image, mask, .. } = photograph;
    let photo = PosePhoto::from_picture(&image, mask.as_ref(), lens, features)?;
    Ok(Prepared { photo, source, warnings, shape: Shape::Pinhole })
}

fn of_panorama(
    path: &Path,
    photograph: &Photograph,
    features: usize,
    warnings: Vec<String>,
) -> Result<Prepared> {
    let Rgb { width, height, .. } = photograph.image;
    if !has_panorama_shape(width, height) {
        let expected = "a panorama of 360x180 degrees, twice as wide as high";
        return Err(FileError::format(path, expected, format!("{width}x{height} pixels")).into());
    }
    let axes = own_axes();
    let part = Part::of(photograph.mask.as_ref(), [width, height]);
    let shown = axes.iter().filter(|axes| part.is_in(&panorama_cut(width, height, **axes))).count();
    if shown < 2 {
        let degrees = [0, 1].map(|i| 360.0 * (part.high[i] - part.low[i]) / width as f64);
        let got = format!("one of {:.0}x{:.0} degrees", degrees[0], degrees[1]);
        let expected = "a panorama that fills at least two views of 90 degrees";
        return Err(FileError::format(path, expected, got).into());
    }
    let views: Vec<(Rgb, Option<Mask>)> = axes
        .iter()
        .map(|axes| panorama_cut(width, height, *axes))
        .map(|cut| cut.apply(&photograph.image, photograph.mask.as_ref()))
        .collect();
    let views: Vec<PhotoView<'_>> = views
        .iter()
        .zip(&axes)
        .map(|((picture, mask), axes)| PhotoView {
            picture,
            mask: mask.as_ref(),
            view_from_photo: axes.transpose(),
        })
        .collect();
    // A panorama shows more than one photograph, but each part of it is matched with one part of another.
    let photo = PosePhoto::from_views(&views, panorama_view(width), features / 3)?;
    let shape = Shape::Panorama { width, height, part };
    Ok(Prepared { photo, source: LensSource::Panorama, warnings, shape })
}

fn of_fisheye(
    path: &Path,
    photograph: &Photograph,
    fisheye: FisheyeLens,
    features: usize,
    mut warnings: Vec<String>,
) -> Result<Prepared> {
    let Rgb { width, height, .. } = photograph.image;
    let circle = image_circle(&photograph.image);
    let (centre, radius) = match circle {
        Some(ImageCircle { centre, radius }) => (centre, radius),
        None => {
            let (w, h) = (width as f64, height as f64);
            warnings.push(format!(
                "{}: no circle of a fisheye lens is found: the angle of {:.0} degrees is taken across the diagonal",
                path.display(),
                fisheye.angle.to_degrees()
            ));
            ([0.5 * w, 0.5 * h], 0.5 * w.hypot(h))
        }
    };
    let focal = (radius / fisheye.curve.radius(0.5 * fisheye.angle)) as f32;
    let [cx, cy] = centre.map(|v| v as f32);
    let lens = Intrinsics { fx: focal, fy: focal, cx, cy, width, height };
    let rim = circle.map(|circle| circle.radius);
    let cut = fisheye_cut(&lens, &fisheye.curve.distortion(), rim).ok_or_else(|| {
        let got = format!("{width}x{height} pixels with the lens's centre at ({cx:.0}, {cy:.0})");
        FileError::format(path, "a fisheye picture that shows what is straight ahead", got)
    })?;
    let (picture, mask) = cut.apply(&photograph.image, photograph.mask.as_ref());
    let Intrinsics { width, height, fx, .. } = cut.view;
    let photo = PosePhoto::from_picture(
        &picture,
        mask.as_ref(),
        Lens::stated(fx, width, height),
        features,
    )?;
    let shape = Shape::View(cut);
    Ok(Prepared { photo, source: LensSource::Fisheye, warnings, shape })
}

/// Loads a photograph again and straightens what its lens bends.
///
/// # Errors
/// A photograph that cannot be read; a lens of which no rectangle can be straightened.
pub(super) fn prepare_straight(
    path: &Path,
    options: &EstimateOptions,
    radial: RadialLens,
    features: usize,
) -> Result<Prepared> {
    let photograph = load_photograph_or_panorama(path, &options.load)?.0;
    let cut = straight_view(&photograph, options.lens, radial)?;
    let (photo, source) = straight_photo(&photograph, &cut, options.lens, features)?;
    let warnings = vec![format!("{}: {}", path.display(), straightened(&cut))];
    Ok(Prepared { photo, source, warnings, shape: Shape::View(cut) })
}

/// The largest pinhole view of a photograph whose lens bends.
///
/// # Errors
/// A lens of which no rectangle can be straightened.
pub(super) fn straight_view(
    photograph: &Photograph,
    known: Option<KnownLens>,
    radial: RadialLens,
) -> Result<Cut> {
    let mut of_middle = lens(photograph, known).0.intrinsics;
    of_middle.fx *= radial.focal_scale as f32;
    of_middle.fy *= radial.focal_scale as f32;
    let distortion = Distortion::Division { k: radial.k };
    let view = undistort::pinhole(&of_middle, &distortion)
        .map_err(|got| FileError::format("photograph", "a lens that can be straightened", got))?;
    Ok(Cut { lens: of_middle, distortion, lens_from_view: DMat3::IDENTITY, view })
}

/// Says how a photograph was straightened.
fn straightened(cut: &Cut) -> String {
    let corner = undistort::ray(&cut.lens, DVec2::ZERO);
    // The corner's own distance from the middle over that of a pinhole's picture of the same thing.
    let percent = match cut.distortion {
        Distortion::Division { k } => -100.0 * k * corner.length_squared(),
        _ => 0.0,
    };
    let side = if percent > 0.0 { "near to" } else { "far from" };
    format!(
        "the lens bends straight lines (things in the corners are seen {:.0} % too {side} the middle): straightened; \
         --lens pinhole reads photographs as they are",
        percent.abs()
    )
}

/// Features of the view `cut` of a photograph, and the origin of its focal length.
///
/// # Errors
/// A view that is no camera.
pub(super) fn straight_photo(
    photograph: &Photograph,
    cut: &Cut,
    known: Option<KnownLens>,
    features: usize,
) -> Result<(PosePhoto, LensSource)> {
    let (picture, mask) = cut.apply(&photograph.image, photograph.mask.as_ref());
    let Intrinsics { width, height, fx, .. } = cut.view;
    let lens_of_view = Lens::stated(fx, width, height);
    let photo = PosePhoto::from_picture(&picture, mask.as_ref(), lens_of_view, features)?;
    Ok((photo, lens(photograph, known).1))
}

/// Frames of photographs with estimated cameras.
pub(super) struct Posed {
    /// One frame for a photograph, at most [`YAWS`] for a panorama; in the order of the photographs.
    pub views: Vec<PosedView>,
    /// For each point of the estimate, the frames that show it and its positions in them, px.
    pub observations: Vec<Vec<(usize, [f32; 2])>>,
}

/// The projections of all photographs, as far as frames depend on them.
pub(super) struct Shapes(Vec<Shape>);

impl Shapes {
    pub fn new(prepared: &[Prepared]) -> Self {
        Self(prepared.iter().map(|p| p.shape).collect())
    }

    /// A warning of panoramas beside photographs whose focal length is not known.
    pub fn warning(&self, lenses: &[LensSource]) -> Option<String> {
        let panoramas = lenses.contains(&LensSource::Panorama);
        let assumed = lenses.iter().filter(|lens| **lens == LensSource::Assumed).count();
        (panoramas && assumed > 0).then(|| {
            format!(
                "{assumed} photographs have no stated focal length, which is not estimated beside panoramas: 0.75 of \
                 the longer side is taken; give --fov"
            )
        })
    }

    /// Frames and observations of an estimate.
    pub fn posed(&self, photographs: &[&Path], estimate: &PoseEstimate) -> Posed {
        let placed = || {
            let cameras = self.0.iter().zip(photographs).zip(&estimate.cameras).enumerate();
            cameras.filter_map(|(i, ((shape, path), camera))| Some((i, *shape, *path, (*camera)?)))
        };
        let panoramas: Vec<(DMat3, DVec3)> = placed()
            .filter(|(_, shape, ..)| matches!(shape, Shape::Panorama { .. }))
            .map(|(.., camera)| axes_and_position(&camera))
            .collect();
        let axes = shared_axes(&panoramas);
        let mut views = Vec::new();
        let mut of_photo = vec![0..0; self.0.len()];
        for (i, shape, path, camera) in placed() {
            let first = views.len();
            let one =
                |cut| PosedView { photograph: path.to_owned(), cut, label: String::new(), camera };
            match shape {
                Shape::Pinhole => views.push(one(None)),
                Shape::View(cut) => views.push(one(Some(cut))),
                Shape::Panorama { width, height, part } => {
                    let (rotation, position) = axes_and_position(&camera);
                    for (n, view) in axes.iter().enumerate() {
                        let cut = panorama_cut(width, height, rotation.transpose() * *view);
                        if !part.is_in(&cut) {
                            continue;
                        }
                        let pose = Mat4::from_mat3_translation(view.as_mat3(), position.as_vec3());
                        // The intrinsics are those of a panorama's view, the axes orthonormal.
                        let camera = Camera::new(cut.view, pose).unwrap_or(camera);
                        let label = view_label(n);
                        views.push(PosedView { cut: Some(cut), label, camera, ..one(None) });
                    }
                }
            }
            of_photo[i] = first..views.len();
        }
        let observations = estimate
            .points
            .iter()
            .map(|point| self.observed(point, &of_photo, &views, &estimate.cameras))
            .collect();
        Posed { views, observations }
    }

    /// Frames that show a point where its photograph does.
    fn observed(
        &self,
        point: &PosePoint,
        of_photo: &[Range<usize>],
        views: &[PosedView],
        cameras: &[Option<Camera>],
    ) -> Vec<(usize, [f32; 2])> {
        let mut all = Vec::new();
        for (photo, px) in &point.observations {
            let Some(camera) = cameras[*photo] else { continue };
            let frames = of_photo[*photo].clone();
            let Shape::Panorama { .. } = self.0[*photo] else {
                all.push((frames.start, *px));
                continue;
            };
            let ray = own_ray(&camera.intrinsics(), *px);
            let (rotation, _) = axes_and_position(&camera);
            for i in frames {
                let view = &views[i];
                let k = view.camera.intrinsics();
                let ray = axes_and_position(&view.camera).0.transpose() * (rotation * ray);
                let at = ray.truncate() / ray.z;
                let at = [k.fx * at.x as f32 + k.cx, k.fy * at.y as f32 + k.cy];
                let inside = (0.0..=k.width as f32).contains(&at[0])
                    && (0.0..=k.height as f32).contains(&at[1]);
                if ray.z > 0.0 && inside {
                    all.push((i, at));
                }
            }
        }
        all
    }
}

/// Direction in a panorama of a position in its views side by side, px ([`PosePhoto::from_views`]).
fn own_ray(view: &Intrinsics, px: [f32; 2]) -> DVec3 {
    let n = ((px[0] / view.width as f32) as usize).min(YAWS - 1);
    let x = px[0] - (n * view.width) as f32;
    let at = DVec2::new(f64::from((x - view.cx) / view.fx), f64::from((px[1] - view.cy) / view.fy));
    own_axes()[n] * at.extend(1.0)
}

fn axes_and_position(camera: &Camera) -> (DMat3, DVec3) {
    (camera.rotation().as_dmat3(), camera.position().as_dvec3())
}
