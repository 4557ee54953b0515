//! Photographs of a call: files, pixels, a folder, or a scene with cameras.

use crate::arrays::{array, borrow};
use crate::camera::Camera;
use crate::error;
use crate::work::{self, Report};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyString;
use std::path::{Path, PathBuf};
use subsplat::files::photos::folder::find_photographs;
use subsplat::files::poses::scene::{LoadedFrame, SceneFormat, has_scene};
use subsplat::reconstruct::inputs::pair::choose_photographs;
use subsplat::scene::pictures::Rgb;
use subsplat::{
    DepthBounds, Error, EstimateOptions, EstimatedPhotos, EstimatedScene, LoadOptions, Photo,
    Photograph, Result, Scene, estimate_cameras, estimate_cameras_of_files, load_photograph,
    load_scene,
};

/// Stage of the estimation of cameras.
const ESTIMATING: &str = "estimating the cameras";

/// A photograph: a file or its pixels.
pub(crate) enum Picture {
    File(PathBuf),
    Pixels(Rgb),
}

/// The photographs of a call.
pub(crate) enum Source {
    /// A folder, or a file of cameras.
    Path(PathBuf),
    /// Photographs in files and in memory.
    Pictures(Vec<Picture>),
}

/// Photographs with cameras, and what is known about them.
pub(crate) struct Posed {
    pub(crate) photos: Vec<Photo>,
    pub(crate) depth: Option<DepthBounds>,
    pub(crate) warnings: Vec<String>,
}

impl Source {
    /// Reads the argument: a path, or a list of paths and of arrays `[H, W, 3]` of uint8.
    pub(crate) fn new(photos: &Bound<'_, PyAny>) -> PyResult<Self> {
        if photos.is_instance_of::<PyString>() {
            return Ok(Self::Path(photos.extract()?));
        }
        let picture = |item: PyResult<Bound<'_, PyAny>>| {
            let item = item?;
            if item.is_instance_of::<PyString>() {
                return Ok(Picture::File(item.extract()?));
            }
            let array = borrow::<u8>("photos", "[H, W, 3]", &item)?;
            array.expect("[H, W, 3]", &[None, None, Some(3)])?;
            let (height, width) = (array.shape()[0], array.shape()[1]);
            if width == 0 || height == 0 {
                return Err(array.misfit("[H, W, 3] with pixels"));
            }
            Ok(Picture::Pixels(Rgb { width, height, data: array.slice()?.to_vec() }))
        };
        Ok(Self::Pictures(photos.try_iter()?.map(picture).collect::<PyResult<_>>()?))
    }

    /// The cameras of the argument `cameras`, one for each picture of a list.
    pub(crate) fn cameras(
        &self,
        cameras: Option<Vec<PyRef<'_, Camera>>>,
    ) -> PyResult<Option<Vec<subsplat::Camera>>> {
        let Some(cameras) = cameras else { return Ok(None) };
        match self {
            Self::Pictures(pictures) if pictures.len() == cameras.len() => {
                Ok(Some(cameras.iter().map(|camera| camera.0).collect()))
            }
            Self::Pictures(pictures) => {
                let expected = format!("{} cameras, one for each photograph", pictures.len());
                Err(error::value("cameras", expected, cameras.len()))
            }
            Self::Path(path) => {
                let expected = "photographs in a list, with cameras";
                Err(error::value("photos", expected, path.display()))
            }
        }
    }

    /// Reads the photographs, and estimates their cameras where they have none. Of a folder and of a scene
    /// with cameras at most `most` photographs that overlap are read; of a list all.
    pub(crate) fn posed(
        self,
        cameras: Option<Vec<subsplat::Camera>>,
        most: usize,
        report: &mut Report<'_>,
    ) -> Result<Posed> {
        if let Self::Path(path) = &self
            && has_scene(path)
        {
            return of_scene(load_scene(path)?, most, report);
        }
        if let Some(cameras) = cameras {
            return with_cameras(self.photographs(report)?, cameras);
        }
        if let Some((name, files)) = self.files()? {
            let most = if matches!(self, Self::Path(_)) { most } else { files.len() };
            return of_scene(estimate_of_files(&name, &files, report)?.scene, most, report);
        }
        let (estimated, warnings) = estimate(self.photographs(report)?, report)?;
        Ok(Posed { photos: estimated.photos, depth: None, warnings })
    }

    /// The files of the photographs, and a name for all; `None` where pixels are among them.
    ///
    /// # Errors
    /// A folder of fewer than two photographs.
    pub(crate) fn files(&self) -> Result<Option<(PathBuf, Vec<PathBuf>)>> {
        let pictures = match self {
            Self::Pictures(pictures) => pictures,
            Self::Path(path) => {
                let found = find_photographs(path).photographs;
                if found.len() < 2 {
                    let expected = "a folder of at least 2 photographs, or a scene with cameras";
                    let got = format!("{} photographs", found.len());
                    return Err(Error::argument(path.display().to_string(), expected, got));
                }
                return Ok(Some((path.clone(), found)));
            }
        };
        let file = |picture: &Picture| match picture {
            Picture::File(path) => Some(path.clone()),
            Picture::Pixels(_) => None,
        };
        let files: Option<Vec<PathBuf>> = pictures.iter().map(file).collect();
        Ok(files.map(|files| (PathBuf::from("photographs"), files)))
    }

    /// Decodes the photographs.
    pub(crate) fn photographs(self, report: &mut Report<'_>) -> Result<Vec<Photograph>> {
        let pictures = match (self.files()?, self) {
            (Some((_, files)), _) => files.into_iter().map(Picture::File).collect(),
            (None, Self::Pictures(pictures)) => pictures,
            (None, Self::Path(_)) => Vec::new(),
        };
        let mut photographs = Vec::with_capacity(pictures.len());
        for picture in pictures {
            step(report, "reading the photographs")?;
            photographs.push(match picture {
                Picture::File(path) => load_photograph(path, &LoadOptions::default())?,
                Picture::Pixels(pixels) => Photograph::from_pixels(pixels),
            });
        }
        Ok(photographs)
    }
}

/// Reports a stage without a measure of its own.
fn step(report: &mut Report<'_>, stage: &str) -> Result<()> {
    if report(stage, 0.0).is_break() { Err(Error::Cancelled) } else { Ok(()) }
}

/// Photographs with the cameras of the caller.
fn with_cameras(photographs: Vec<Photograph>, cameras: Vec<subsplat::Camera>) -> Result<Posed> {
    let mut warnings = Vec::new();
    let photo = |(photograph, camera): (Photograph, subsplat::Camera)| {
        warnings.extend(photograph.warnings);
        let photo = Photo::new(photograph.image, camera)?;
        match photograph.mask {
            Some(mask) => photo.with_mask(mask),
            None => Ok(photo),
        }
    };
    let photos = photographs.into_iter().zip(cameras).map(photo).collect::<Result<_>>()?;
    Ok(Posed { photos, depth: None, warnings })
}

/// Estimates the cameras of photographs in memory; with the warnings.
pub(crate) fn estimate(
    photographs: Vec<Photograph>,
    report: &mut Report<'_>,
) -> Result<(EstimatedPhotos, Vec<String>)> {
    let mut warnings: Vec<String> =
        photographs.iter().flat_map(|photograph| photograph.warnings.clone()).collect();
    step(report, ESTIMATING)?;
    let estimated = estimate_cameras(photographs, &EstimateOptions::default())?;
    let estimate = &estimated.estimate;
    warnings.extend(estimate.left_out_sentences(|photo| format!("photograph {photo}")));
    warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok((estimated, warnings))
}

/// Estimates the cameras of photographs in files. The memory holds one photograph at a time.
pub(crate) fn estimate_of_files(
    name: &Path,
    files: &[PathBuf],
    report: &mut Report<'_>,
) -> Result<EstimatedScene> {
    let options = EstimateOptions::default();
    estimate_cameras_of_files(name, files, &options, &mut |_| step(report, ESTIMATING))
}

/// Reads at most `most` photographs of a scene that overlap.
fn of_scene(scene: Scene, most: usize, report: &mut Report<'_>) -> Result<Posed> {
    let count = scene.frames.len();
    let all = count == 2 || scene.source == SceneFormat::Photographs && count <= most;
    let chosen = if all { Some((0..count).collect()) } else { choose_photographs(&scene, most) };
    let Some(chosen): Option<Vec<usize>> = chosen else {
        let expected = "two photographs taken from different places";
        return Err(Error::argument(scene.name, expected, format!("{count} from one place")));
    };
    let mut photos = Vec::with_capacity(chosen.len());
    for &i in &chosen {
        step(report, "reading the photographs")?;
        photos.push(Photo::from_frame(&scene.frames[i])?);
    }
    let depth = DepthBounds::of_scene(&scene, &chosen)?;
    Ok(Posed { photos, depth, warnings: scene.warnings })
}

/// Name, pixels `[H, W, 3]` of uint8 and camera of a photograph.
type Named<'py> = (String, Bound<'py, PyArrayDyn<u8>>, Camera);

/// The photographs of a scene with cameras, without lens distortion.
#[pyfunction]
pub(crate) fn photographs<'py>(
    py: Python<'py>,
    path: PathBuf,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Vec<Named<'py>>> {
    let loaded = work::run(py, progress, move |report| {
        let scene = load_scene(path)?;
        let mut loaded = Vec::with_capacity(scene.frames.len());
        for i in scene.usable() {
            step(report, "reading the photographs")?;
            let frame = &scene.frames[i];
            let LoadedFrame { picture, camera, .. } = frame.load_with(&LoadOptions::default())?;
            loaded.push((frame.name.clone(), picture, camera));
        }
        Ok(loaded)
    })?;
    let named = |(name, Rgb { width, height, data }, camera): (String, Rgb, subsplat::Camera)| {
        Ok((name, array(py, data, &[height, width, 3])?, Camera(camera)))
    };
    loaded.into_iter().map(named).collect()
}
