//! Estimates the cameras of photographs without a pose file: decodes them, takes what is known of
//! their lenses, estimates the poses ([`crate::cameras::estimation`]), and returns photographs or a scene.

use super::{Error, Photo, Result};
use crate::cameras::estimation::{Lens, PoseEstimate, PoseOptions, PosePhoto, estimate_poses};
use crate::files::photos::exif::FocalSource;
use crate::files::photos::image::LoadOptions;
use crate::files::photos::notes::grouped;
use crate::files::photos::photograph::{Photograph, load_photograph};
use crate::files::poses::scene::{Scene, SceneFormat};
use std::fmt;
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::{Camera, Intrinsics};

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
}

impl fmt::Display for LensSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Given => f.write_str("as given"),
            Self::Exif(source) => write!(f, "from EXIF ({source})"),
            Self::Assumed => {
                f.write_str("not stated: estimated from a start of 0.75 of the longer side")
            }
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
}

/// Result of [`estimate_cameras_of_files`]: a scene with estimated cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct EstimatedScene {
    /// The photographs that have a camera, and the sparse points.
    pub scene: Scene,
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
        Error::NoPoses { photographs: format!("{} photographs", photographs.len()), reason }
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
/// Those of [`load_photograph`]; a lens that is no valid camera; [`Error::NoPoses`]; the error of
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
    let mut warnings = Vec::new();
    let (mut photos, mut lenses) = (Vec::new(), Vec::new());
    for (i, path) in photographs.iter().enumerate() {
        photograph(i)?;
        let loaded = load_photograph(path, &options.load)?;
        warnings.push(loaded.warnings.clone());
        let (lens, source) = lens(&loaded, options.lens);
        lenses.push(source);
        let Photograph { image, mask, .. } = loaded;
        photos.push(PosePhoto::from_picture(&image, mask.as_ref(), lens, features)?);
    }
    let estimate = estimate_poses(&photos, &options.poses).map_err(|reason| Error::NoPoses {
        photographs: photographs_of(name, photographs),
        reason,
    })?;
    let placed: Vec<(PathBuf, Camera)> = photographs
        .iter()
        .zip(&estimate.cameras)
        .filter_map(|(path, camera)| Some((path.to_path_buf(), (*camera)?)))
        .collect();
    let mut scene = Scene::from_photographs(SceneFormat::Photographs, name, &placed)?;
    scene.points = Some(estimate.points.iter().map(|p| p.position).collect());
    for (index, point) in estimate.points.iter().enumerate() {
        for (photo, _) in &point.observations {
            let before = estimate.cameras[..*photo].iter().flatten().count();
            if let (Some(frame), Ok(index)) = (scene.frames.get_mut(before), u32::try_from(index)) {
                frame.visible.push(index);
            }
        }
    }
    let warnings = warnings.iter().map(Vec::as_slice);
    scene.warnings.extend(grouped(photographs.iter().copied().zip(warnings)));
    let file = |photo: usize| photographs[photo].display().to_string();
    scene.warnings.extend(estimate.left_out_sentences(file));
    scene.warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok(EstimatedScene { scene, estimate, lenses })
}

/// Returns the known part of a photograph's lens, and its source.
fn lens(photograph: &Photograph, known: Option<KnownLens>) -> (Lens, LensSource) {
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
