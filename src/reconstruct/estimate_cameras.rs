//! Estimates the cameras of photographs without a pose file: decodes them, takes what is known of
//! their lenses, estimates the poses ([`crate::cameras::estimation`]), and returns photographs or a scene.
//!
//! Where the photographs show that their lens bends straight lines, they are straightened and their cameras estimated
//! again ([`RadialLens`]).

use super::projections::{self, Posed, Prepared, Projection, Shapes};
use super::{Error, Photo, Result};
use crate::cameras::estimation::{
    Confidence, LeftOut, Lens, PoseEstimate, PoseOptions, PosePhoto, PoseWarning, RadialLens,
    estimate_poses,
};
use crate::files::photos::exif::FocalSource;
use crate::files::photos::image::LoadOptions;
use crate::files::photos::notes::grouped;
use crate::files::photos::photograph::Photograph;
use crate::files::photos::views::Cut;
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
    /// [`EstimateOptions::lens`] has no effect. [`estimate_cameras`] reads [`Projection::Pinhole`] alone: lenses do not
    /// bend lines.
    pub projection: Projection,
    /// Makes a photograph that [`estimate_cameras_of_files`] cannot use an error. By default such a photograph is left
    /// out where two others remain.
    pub strict: bool,
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
    /// Origin of each photograph's focal length; [`LensSource::Assumed`] of one that cannot be read.
    pub lenses: Vec<LensSource>,
    /// The lens whose bend was taken out of the photographs: the frames are straight views of them.
    pub straightened: Option<RadialLens>,
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
    /// The lens whose bend was taken out of the photographs.
    pub straightened: Option<RadialLens>,
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
    let first = estimate_poses(&pose_photos, &pose_options(options)).map_err(|reason| {
        let warnings = photographs.iter().flat_map(|p| p.warnings.clone()).collect();
        let photographs = format!("{} photographs", photographs.len());
        Error::NoPoses { photographs, reason, warnings }
    })?;
    let straight = |radial| -> Result<(Vec<PosePhoto>, Vec<Cut>)> {
        let one = |photograph| -> Result<(PosePhoto, Cut)> {
            let cut = projections::straight_view(photograph, options.lens, radial)?;
            let photo = projections::straight_photo(photograph, &cut, options.lens, features)?.0;
            Ok((photo, cut))
        };
        Ok(photographs.iter().map(one).collect::<Result<Vec<_>>>()?.into_iter().unzip())
    };
    let (estimate, straightened) = straight_estimate(first, options, straight);
    let cuts = straightened.as_ref().map(|(_, cuts)| cuts);
    let mut photos = Vec::new();
    for (i, (photograph, camera)) in photographs.into_iter().zip(&estimate.cameras).enumerate() {
        let Some(camera) = *camera else { continue };
        let Photograph { image, mask, .. } = photograph;
        let (image, mask) = match cuts.map(|cuts| cuts[i]) {
            Some(cut) => cut.apply(&image, mask.as_ref()),
            None => (image, mask),
        };
        let photo = Photo::new(image, camera)?;
        photos.push(match mask {
            Some(mask) => photo.with_mask(mask)?,
            None => photo,
        });
    }
    let straightened = straightened.map(|(radial, _)| radial);
    Ok(EstimatedPhotos { photos, estimate, lenses, straightened })
}

/// Options of the first estimate: photographs of known projections have lenses that do not bend lines.
fn pose_options(options: &EstimateOptions) -> PoseOptions {
    let may_bend = options.poses.may_bend && options.projection == Projection::Detected;
    options.poses.with_may_bend(may_bend)
}

/// The estimate of straightened photographs where `first` found a lens that bends, with that lens and what
/// `straightened` made beside the photographs; else `first`, which is doubtful where straightening failed.
fn straight_estimate<T>(
    mut first: PoseEstimate,
    options: &EstimateOptions,
    straightened: impl FnOnce(RadialLens) -> Result<(Vec<PosePhoto>, T)>,
) -> (PoseEstimate, Option<(RadialLens, T)>) {
    let Some(radial) = first.radial else { return (first, None) };
    let placed = |estimate: &PoseEstimate| estimate.cameras.iter().flatten().count();
    if let Ok((photos, made)) = straightened(radial)
        && let Ok(estimate) = estimate_poses(&photos, &options.poses.with_may_bend(false))
        && placed(&estimate) >= placed(&first)
    {
        return (estimate, Some((radial, made)));
    }
    first.warnings.push(PoseWarning::BentLines);
    first.confidence = Confidence::Low;
    (first, None)
}

/// Makes the indices of photographs in `estimate` count `count` photographs, of which those of the estimate are `of_all`, and
/// the others are `left_out`.
fn count_among(
    estimate: &mut PoseEstimate,
    of_all: &[usize],
    count: usize,
    left_out: Vec<LeftOut>,
) {
    let mut cameras = vec![None; count];
    for (&photo, camera) in of_all.iter().zip(&estimate.cameras) {
        cameras[photo] = *camera;
    }
    estimate.cameras = cameras;
    for (photo, _) in estimate.points.iter_mut().flat_map(|point| &mut point.observations) {
        *photo = of_all[*photo];
    }
    estimate.left_out.iter_mut().for_each(|left| left.photo = of_all[left.photo]);
    estimate.left_out.extend(left_out);
    estimate.left_out.sort_by_key(|left| left.photo);
}

/// Estimates the cameras of photographs in files. `name` names the scene in messages.
/// `photograph` is called with the index of each photograph before it is decoded.
///
/// One photograph is decoded at a time, so that memory holds one at its full size.
///
/// # Errors
/// Those of [`load_photograph`](crate::load_photograph) where fewer than two photographs are without one, or with
/// [`EstimateOptions::strict`], but panoramas are accepted; a lens that is no valid camera; [`Error::NoPoses`]; the error
/// of `photograph`.
pub fn estimate_cameras_of_files(
    name: impl AsRef<Path>,
    photographs: &[impl AsRef<Path>],
    options: &EstimateOptions,
    photograph: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<EstimatedScene> {
    let photographs: Vec<&Path> = photographs.iter().map(AsRef::as_ref).collect();
    estimate_scene(name.as_ref(), &photographs, options, photograph)
}

/// The photographs that can be used.
struct Usable<'a> {
    prepared: Vec<Prepared>,
    paths: Vec<&'a Path>,
    /// Index of each among all photographs.
    of_all: Vec<usize>,
    /// The others, with their errors.
    left_out: Vec<LeftOut>,
    /// Warnings about each.
    said: Vec<Vec<String>>,
}

/// Reads the photographs and leaves out those that cannot be used.
///
/// # Errors
/// The first error of a photograph where fewer than two can be used; any with [`EstimateOptions::strict`].
fn usable<'a>(
    photographs: &[&'a Path],
    options: &EstimateOptions,
    photograph: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<Usable<'a>> {
    let features = features_of(photographs.len());
    let mut usable = Usable {
        prepared: Vec::new(),
        paths: Vec::new(),
        of_all: Vec::new(),
        left_out: Vec::new(),
        said: Vec::new(),
    };
    let mut first_error = None;
    for (photo, path) in photographs.iter().enumerate() {
        photograph(photo)?;
        match projections::prepare(path, options, features) {
            Ok(mut one) => {
                usable.said.push(std::mem::take(&mut one.warnings));
                usable.prepared.push(one);
                usable.paths.push(path);
                usable.of_all.push(photo);
            }
            Err(Error::Io(error)) if !options.strict => {
                usable.left_out.push(LeftOut { photo, reason: error.reason() });
                first_error.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    match first_error {
        Some(error) if usable.prepared.len() < 2 => Err(error.into()),
        _ => Ok(usable),
    }
}

fn estimate_scene(
    name: &Path,
    all: &[&Path],
    options: &EstimateOptions,
    photograph: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<EstimatedScene> {
    let features = features_of(all.len());
    let Usable { prepared, paths: photographs, of_all, left_out, said } =
        usable(all, options, photograph)?;
    let photographs = photographs.as_slice();
    let mut warnings = grouped(photographs.iter().copied().zip(said.iter().map(Vec::as_slice)));
    let split = |prepared: Vec<Prepared>| {
        let shapes = Shapes::new(&prepared);
        let (photos, lenses): (Vec<PosePhoto>, Vec<LensSource>) =
            prepared.into_iter().map(|p| (p.photo, p.source)).unzip();
        (photos, (shapes, lenses))
    };
    let (photos, (mut shapes, lenses)) = split(prepared);
    warnings.extend(shapes.warning(&lenses));
    let first = match estimate_poses(&photos, &pose_options(options)) {
        Ok(estimate) => estimate,
        Err(reason) => {
            let photographs = photographs_of(name, photographs);
            return Err(Error::NoPoses { photographs, reason, warnings });
        }
    };
    drop(photos);
    let straight = |radial| -> Result<_> {
        let one = |path: &&Path| projections::prepare_straight(path, options, radial, features);
        let mut prepared = photographs.iter().map(one).collect::<Result<Vec<_>>>()?;
        let said: Vec<_> = prepared.iter_mut().map(|p| std::mem::take(&mut p.warnings)).collect();
        let (photos, (shapes, _)) = split(prepared);
        Ok((photos, (shapes, said)))
    };
    let (mut estimate, straightened) = straight_estimate(first, options, straight);
    let straightened = straightened.map(|(radial, (of_views, said))| {
        shapes = of_views;
        warnings.extend(grouped(photographs.iter().copied().zip(said.iter().map(Vec::as_slice))));
        radial
    });
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
    let mut lenses_of_all = vec![LensSource::Assumed; all.len()];
    of_all.iter().zip(lenses).for_each(|(&photo, lens)| lenses_of_all[photo] = lens);
    count_among(&mut estimate, &of_all, all.len(), left_out);
    let file = |photo: usize| all[photo].display().to_string();
    scene.warnings.extend(estimate.left_out_sentences(file));
    scene.warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok(EstimatedScene { scene, observations, estimate, lenses: lenses_of_all, straightened })
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::estimation::FocalEstimate;
    use crate::files::Error as FileError;

    #[test]
    fn cameras_of_a_lens_that_cannot_be_straightened_are_doubtful() {
        let radial = RadialLens { k: -0.3, focal_scale: 0.9 };
        let mut first = PoseEstimate {
            cameras: vec![None; 3],
            points: Vec::new(),
            left_out: Vec::new(),
            focal: FocalEstimate { scale: 1.0, deviation: 0.0 },
            radial: None,
            confidence: Confidence::High,
            rotation_error_deg: 0.0,
            direction_error_deg: 0.0,
            warnings: Vec::new(),
        };
        let options = EstimateOptions::default();
        let found = straight_estimate(first.clone(), &options, |_| Ok((Vec::new(), ())));
        assert_eq!(found, (first.clone(), None));
        first.radial = Some(radial);
        // No photographs have no cameras.
        let (estimate, straightened) =
            straight_estimate(first.clone(), &options, |lens| Ok((Vec::new(), lens)));
        assert_eq!((estimate.confidence, straightened), (Confidence::Low, None));
        assert_eq!(estimate.warnings, [PoseWarning::BentLines]);
        let failed = |_| Err(FileError::format("a.png", "a lens", "none".to_owned()).into());
        let (estimate, straightened) = straight_estimate::<()>(first, &options, failed);
        assert_eq!((estimate.confidence, straightened), (Confidence::Low, None));
    }
}
