//! Calls on photographs: a scene, their cameras, the check of their cameras.

use crate::arrays::array;
use crate::camera::Camera;
use crate::error;
use crate::numbers::{optional_whole, whole};
use crate::photographs::{Posed, Source, estimate, estimate_of_files};
use crate::scene::Scene;
use crate::work;
use numpy::PyArrayDyn;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::path::PathBuf;
use subsplat::cameras::estimation::Confidence;
use subsplat::network::model::trunk::UPSCALE_MAX;
use subsplat::reconstruct::stages::check_pairs;
use subsplat::{
    Backend, Density, Error, Options, Photo, Poses, Quality, Reconstructor, Refine, Renderer,
};

/// Most photographs of a scene with cameras, at `fast` and `normal`, and above: those of `subsplat run`.
const PHOTOGRAPHS_MAX: [usize; 2] = [12, 6];

/// Longest refinement, seconds.
const SECONDS_MAX: usize = 1_000_000;

/// Options of a reconstruction.
struct Request {
    quality: Quality,
    upscale: usize,
    weights: Option<PathBuf>,
    options: Options,
}

/// Reconstructs the scene of photographs.
#[pyfunction]
#[pyo3(signature = (photos, cameras, quality, gaussians, refine_seconds, upscale, adjust_poses, weights,
    progress))]
#[allow(clippy::too_many_arguments, reason = "the arguments of the Python function")]
pub(crate) fn reconstruct(
    py: Python<'_>,
    photos: &Bound<'_, PyAny>,
    cameras: Option<Vec<PyRef<'_, Camera>>>,
    quality: &str,
    gaussians: Option<&Bound<'_, PyAny>>,
    refine_seconds: Option<&Bound<'_, PyAny>>,
    upscale: &Bound<'_, PyAny>,
    adjust_poses: Option<bool>,
    weights: Option<PathBuf>,
    progress: Option<&Bound<'_, PyAny>>,
) -> PyResult<Scene> {
    let source = Source::new(photos)?;
    let cameras = source.cameras(cameras)?;
    let level = match quality {
        "fast" => Quality::Fast,
        "normal" => Quality::Normal,
        "high" => Quality::High,
        "best" => Quality::Best,
        other => return Err(error::value("quality", "fast, normal, high or best", other)),
    };
    let mut options = Options::default().with_quality(level);
    if let Some(adjusts) = adjust_poses {
        options = options.with_poses(if adjusts { Poses::Adjusted } else { Poses::Given });
    }
    if let Some(count) = optional_whole("gaussians", gaussians, 1..=usize::MAX)? {
        options = options.with_density(Density::Count(count));
    }
    match optional_whole("refine_seconds", refine_seconds, 0..=SECONDS_MAX)? {
        None => {}
        Some(0) => options = options.with_refine(Refine::Off),
        Some(seconds) => options = options.with_refine(Refine::Seconds(seconds as u32)),
    }
    let upscale = whole("upscale", upscale, 1..=UPSCALE_MAX)?;
    let request = Request { quality: level, upscale, weights, options };
    work::run(py, progress, move |report| run(source, cameras, request, report))
}

fn run(
    source: Source,
    cameras: Option<Vec<subsplat::Camera>>,
    request: Request,
    report: &mut work::Report<'_>,
) -> subsplat::Result<Scene> {
    let Request { quality, upscale, weights, options } = request;
    let model = match weights {
        Some(path) => Reconstructor::load(path, None)?,
        None => Reconstructor::shipped(upscale)?,
    };
    let most = PHOTOGRAPHS_MAX[usize::from(quality > Quality::Normal)];
    let Posed { photos, depth, warnings } = source.posed(cameras, most, report)?;
    let options = options.with_depth_prior(depth);
    let mut show = |p: subsplat::Progress| report(p.stage.description(), p.fraction);
    let prepared = model.prepare_with(&photos, &options, &mut show)?;
    drop(photos);
    let result = prepared.reconstruct_with(&mut show)?;
    let verdict =
        result.assess(&mut Renderer::new(&Backend::Cpu), result.raster_options())?.verdict;
    Ok(Scene::of(result, verdict, warnings))
}

/// Cameras, points `[M, 3]`, reliability and warnings.
type Estimated<'py> = (Vec<Option<Camera>>, Bound<'py, PyArrayDyn<f32>>, bool, Vec<String>);

/// Estimates the cameras of photographs.
#[pyfunction]
pub(crate) fn estimate_cameras<'py>(
    py: Python<'py>,
    photos: &Bound<'py, PyAny>,
    progress: Option<&Bound<'py, PyAny>>,
) -> PyResult<Estimated<'py>> {
    let source = Source::new(photos)?;
    let (estimate, warnings) = work::run(py, progress, move |report| {
        if let Some((name, files)) = source.files()? {
            let found = estimate_of_files(&name, &files, report)?;
            return Ok((found.estimate, found.scene.warnings));
        }
        let (found, warnings) = estimate(source.photographs(report)?, report)?;
        Ok((found.estimate, warnings))
    })?;
    let points: Vec<f32> = estimate.points.iter().flat_map(|p| p.position.to_array()).collect();
    let count = estimate.points.len();
    let cameras = estimate.cameras.into_iter().map(|camera| camera.map(Camera)).collect();
    let reliable = estimate.confidence == Confidence::High;
    Ok((cameras, array(py, points, &[count, 3])?, reliable, warnings))
}

/// Checks the cameras of consecutive photographs: a list in JSON.
#[pyfunction]
pub(crate) fn check(
    py: Python<'_>,
    photos: &Bound<'_, PyAny>,
    cameras: Option<Vec<PyRef<'_, Camera>>>,
    progress: Option<&Bound<'_, PyAny>>,
) -> PyResult<String> {
    let source = Source::new(photos)?;
    let cameras = source.cameras(cameras)?;
    let reports = work::run(py, progress, move |report| {
        let photos: Vec<Photo> = source.posed(cameras, PHOTOGRAPHS_MAX[0], report)?.photos;
        check_pairs(&photos, |part| {
            let stop = report("comparing the photographs", part).is_break();
            if stop { Err(Error::Cancelled) } else { Ok(()) }
        })
    })?;
    serde_json::to_string(&reports).map_err(|e| PyRuntimeError::new_err(e.to_string()))
}
