//! Estimates the cameras of photographs without a pose file: decodes them, takes what is known of
//! their lenses, estimates the poses ([`crate::cameras::estimation`]), and returns photographs or a scene.

use super::projections::{self, Posed, Projection, Shapes};
use super::{Error, Photo, Result};
use crate::cameras::estimation::{Lens, PoseEstimate, PoseOptions, PosePhoto, estimate_poses};
use crate::files::photos::exif::FocalSource;
use crate::files::photos::image::LoadOptions;
use crate::files::photos::notes::grouped;
use crate::files::photos::photograph::Photograph;
use crate::files::poses::scene::{Scene, SceneFormat};
use std::fmt;
use std::path::Path;
use subsplat_kernels::camera::Intrinsics;

/// Intrinsics of all photographs that the caller knows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum KnownLens {
    /// Horizontal field of view, radians; square pixels, principal point in the middle.
    FovX(f32),
    /// fx, fy, cx, cy, px of the upright photographs.
    Pixels([f32; 4]),
}

impl KnownLens {
    fn intrinsics(self, width: usize, height: usize) -> Intrinsics {
        match self {
            Self::FovX(fov) => Intrinsics::from_fov_x(fov, width, height),
            Self::Pixels([fx, fy, cx, cy]) => Intrinsics { fx, fy, cx, cy, width, height },
        }
    }
}

/// Origin of a photograph's focal length before the estimation. [`fmt::Display`] gives a phrase.
#[derive(Clone, Debug, PartialEq)]
pub enum LensSource {
    /// The caller gave it.
    Given,
    /// The photograph's EXIF block.
    Exif(FocalSource),
    /// Nothing is known: 0.75 of the longer side.
    Assumed,
    /// The photograph is a panorama, of which views are made.
    Panorama,
    /// The photograph is the picture of a fisheye lens, of which a view is made.
    Fisheye,
}

impl fmt::Display for LensSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Given => f.write_str("as given"),
            Self::Exif(source) => write!(f, "from EXIF ({source})"),
            Self::Assumed => {
                f.write_str("not stated: estimated from a start of 0.75 of the longer side")
            }
            Self::Panorama => f.write_str("a view of a panorama"),
            Self::Fisheye => f.write_str("a view of a fisheye picture, by its circle"),
        }
    }
}

/// Options of [`estimate_cameras`] and [`estimate_cameras_of_files`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EstimateOptions {
    /// Intrinsics of all photographs. They win over EXIF.
    pub lens: Option<KnownLens>,
    /// Estimation of the poses.
    pub poses: PoseOptions,
    /// Decoding by [`estimate_cameras_of_files`].
    pub load: LoadOptions,
    /// Projection of the photographs of [`estimate_cameras_of_files`]. With panoramas and fisheye pictures
    /// [`EstimateOptions::lens`] has no effect.
    pub projection: Projection,
}

/// Result of [`estimate_cameras_of_files`]: a scene with estimated cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct EstimatedScene {
    /// The photographs that have a camera, and the sparse points. A panorama becomes several frames.
    pub scene: Scene,
    /// For each point of the estimate the frames of the scene that show it, with its position in them, px.
    pub observations: Vec<Vec<(usize, [f32; 2])>>,
    /// The estimate; its indices count all photographs.
    pub estimate: PoseEstimate,
    /// Origin of each photograph's focal length.
    pub lenses: Vec<LensSource>,
}

/// Result of [`estimate_cameras`]: photographs in memory with estimated cameras.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct EstimatedPhotos {
    /// The photographs that have a camera, in their order.
    pub photos: Vec<Photo>,
    /// The estimate; its indices count all photographs.
    pub estimate: PoseEstimate,
    /// Origin of each photograph's focal length.
    pub lenses: Vec<LensSource>,
}

/// Features of a photograph of a pair, and of one of many: the time of matching grows with their
/// square and with the number of pairs.
const FEATURES: [usize; 2] = [4000, 2500];

/// Returns the number of features of each of `photographs` photographs.
fn features_of(photographs: usize) -> usize {
    FEATURES[usize::from(photographs > 2)]
}

/// Estimates the cameras of photographs in memory, for
/// [`Reconstructor::run`](super::Reconstructor::run).
/// [`parse_photograph`](crate::files::photos::photograph::parse_photograph) decodes files in memory.
///
/// # Errors
/// A lens that is no valid camera; [`Error::NoPoses`].
pub fn estimate_cameras(
    photographs: Vec<Photograph>,
    options: &EstimateOptions,
) -> Result<EstimatedPhotos> {
    let features = features_of(photographs.len());
    let (mut pose_photos, mut lenses) = (Vec::new(), Vec::new());
    for photograph in &photographs {
        let (lens, source) = lens(photograph, options.lens);
        lenses.push(source);
        let Photograph { image, mask, .. } = photograph;
        pose_photos.push(PosePhoto::from_picture(image, mask.as_ref(), lens, features)?);
    }
    let estimate = estimate_poses(&pose_photos, &options.poses).map_err(|reason| {
        let warnings = photographs.iter().flat_map(|p| p.warnings.clone()).collect();
        let photographs = format!("{} photographs", photographs.len());
        Error::NoPoses { photographs, reason, warnings }
    })?;
    let photos = photographs
        .into_iter()
        .zip(&estimate.cameras)
        .filter_map(|(photograph, camera)| {
            let photo = Photo::new(photograph.image, (*camera)?);
            Some(match photograph.mask {
                Some(mask) => photo.and_then(|photo| photo.with_mask(mask)),
                None => photo,
            })
        })
        .collect::<Result<_>>()?;
    Ok(EstimatedPhotos { photos, estimate, lenses })
}

/// Estimates the cameras of photographs in files. `name` names the scene in messages.
/// `photograph` is called with the index of each photograph before it is decoded.
///
/// One photograph is decoded at a time, so that memory holds one at its full size.
///
/// # Errors
/// Those of [`load_photograph`](crate::load_photograph), but panoramas are accepted; a lens that is no valid camera; [`Error::NoPoses`]; the error of
/// `photograph`.
pub fn estimate_cameras_of_files(
    name: impl AsRef<Path>,
    photographs: &[impl AsRef<Path>],
    options: &EstimateOptions,
    photograph: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<EstimatedScene> {
    let photographs: Vec<&Path> = photographs.iter().map(AsRef::as_ref).collect();
    estimate_scene(name.as_ref(), &photographs, options, photograph)
}

fn estimate_scene(
    name: &Path,
    photographs: &[&Path],
    options: &EstimateOptions,
    photograph: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<EstimatedScene> {
    let features = features_of(photographs.len());
    let mut said: Vec<Vec<String>> = Vec::new();
    let mut prepared = Vec::new();
    for (i, path) in photographs.iter().enumerate() {
        photograph(i)?;
        let mut one = projections::prepare(path, options, features)?;
        said.push(std::mem::take(&mut one.warnings));
        prepared.push(one);
    }
    let mut warnings = grouped(photographs.iter().copied().zip(said.iter().map(Vec::as_slice)));
    let shapes = Shapes::new(&prepared);
    let (photos, lenses): (Vec<PosePhoto>, Vec<LensSource>) =
        prepared.into_iter().map(|p| (p.photo, p.source)).unzip();
    warnings.extend(shapes.warning(&lenses));
    let estimate = match estimate_poses(&photos, &options.poses) {
        Ok(estimate) => estimate,
        Err(reason) => {
            let photographs = photographs_of(name, photographs);
            return Err(Error::NoPoses { photographs, reason, warnings });
        }
    };
    let Posed { views, observations } = shapes.posed(photographs, &estimate);
    let mut scene = Scene::from_views(SceneFormat::Photographs, name, &views)?;
    scene.points = Some(estimate.points.iter().map(|p| p.position).collect());
    for (index, point) in observations.iter().enumerate() {
        for (frame, _) in point {
            if let (Some(frame), Ok(index)) = (scene.frames.get_mut(*frame), u32::try_from(index)) {
                frame.visible.push(index);
            }
        }
    }
    scene.warnings.extend(warnings);
    let file = |photo: usize| photographs[photo].display().to_string();
    scene.warnings.extend(estimate.left_out_sentences(file));
    scene.warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok(EstimatedScene { scene, observations, estimate, lenses })
}

/// Returns the known part of a photograph's lens, and its source.
pub(super) fn lens(photograph: &Photograph, known: Option<KnownLens>) -> (Lens, LensSource) {
    let (w, h) = (photograph.image.width, photograph.image.height);
    match (known, photograph.camera.focal) {
        (Some(known), _) => (Lens::known(known.intrinsics(w, h)), LensSource::Given),
        (None, Some(focal)) => {
            (Lens::stated(focal.px as f32, w, h), LensSource::Exif(focal.source))
        }
        (None, None) => (Lens::unknown(w, h), LensSource::Assumed),
    }
}

/// Names photographs in a message.
fn photographs_of(name: &Path, photographs: &[&Path]) -> String {
    match photographs {
        [a, b] => format!("{} and {}", a.display(), b.display()),
        _ => format!("{} ({} photographs)", name.display(), photographs.len()),
    }
}
