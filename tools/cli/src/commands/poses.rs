//! `subsplat poses`: cameras of photographs that come without any.

use super::args::{PosesArgs, ReadArgs};
use super::clip;
use super::pair::{self, EstimateRequest};
use crate::report::{Answer, Progress, peak_memory_bytes, print_warning};
use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use std::path::{Component, Path, PathBuf};
use subsplat::EstimatedScene;
use subsplat::cameras::estimation::Confidence;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::save_cameras_and_points;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera};
use subsplat::files::poses::colmap::{SparsePoint, save_colmap};
use subsplat::files::poses::scene::{Frame, Pixels, Units, distinct_names};
use subsplat_kernels::camera::Camera;

/// Runs the command.
pub fn poses(args: &PosesArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    let of_video = clip::of_poses(args, &mut progress)?;
    let args = of_video.as_ref().map_or(args, |of_video| &of_video.args);
    let read = ReadArgs { strict: args.strict, ..Default::default() };
    let photographs = pair::photographs(&args.input, &read)?.with_context(|| {
        format!("{}: expected photographs, got a scene with cameras", args.input[0].display())
    })?;
    check_names(&photographs, folder_of(&cameras_file(&args.out)))?;
    let request = EstimateRequest {
        fov: args.fov,
        intrinsics: args.intrinsics.as_deref(),
        force: args.force,
        projection: args.lens.unwrap_or_default(),
        strict: args.strict,
    };
    let estimated = progress
        .stage("cameras", |bar| pair::estimate(&args.input[0], &photographs, &request, bar))?;
    estimated.scene.warnings.iter().for_each(print_warning);
    pair::print_estimate(&estimated);
    let files = progress.stage("writing", |_| write(&args.out, &estimated))?;
    files.iter().for_each(|f| answer.line(f.display()));
    answer.finish(&report(&photographs, &estimated, &files, &progress))
}

/// The file of the cameras.
fn cameras_file(out: &Path) -> PathBuf {
    let is_file = out.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if is_file { out.to_owned() } else { out.join("cameras.json") }
}

/// The folder of a file.
fn folder_of(file: &Path) -> &Path {
    file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes the cameras; returns the files.
fn write(out: &Path, estimated: &EstimatedScene) -> Result<Vec<PathBuf>> {
    let file = cameras_file(out);
    let is_file = file == out;
    let folder = folder_of(&file);
    std::fs::create_dir_all(folder)
        .with_context(|| format!("output folder {}", folder.display()))?;
    let frames = &estimated.scene.frames;
    let pictures = pictures(folder, frames)?;
    let cameras = frames
        .iter()
        .zip(&pictures)
        .map(|(frame, picture)| {
            let named = NamedCamera::of_frame(frame, path_from(folder, picture)?);
            // A view that was written is not turned again.
            Ok(match frame.cut {
                Some(_) => NamedCamera { pixels: Pixels::Stored, ..named },
                None => named,
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let content =
        CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() };
    let points = estimated.scene.points.as_deref().unwrap_or_default();
    save_cameras_and_points(&file, &content, points)?;
    let model = folder.join("sparse/0");
    let mut files = vec![file];
    if !is_file {
        let (images, points) = colmap(estimated, &pictures);
        save_colmap(&model, &images, &points)?;
        files.push(model);
    }
    Ok(files)
}

/// The picture of each frame: its photograph, or a view of it, which is written to `views/` in the folder.
fn pictures(folder: &Path, frames: &[Frame]) -> Result<Vec<PathBuf>> {
    let picture = |frame: &Frame| {
        if frame.cut.is_none() {
            return Ok(frame.image.clone());
        }
        let path = folder.join("views").join(format!("{}.png", frame.name));
        let parent = path.parent().unwrap_or(folder);
        std::fs::create_dir_all(parent)
            .with_context(|| format!("output folder {}", parent.display()))?;
        save_png(&path, &frame.load()?.0)?;
        Ok(path)
    };
    frames.iter().map(picture).collect()
}

/// Path of a picture from a folder, which need not exist: relative where it lies inside, else absolute; relative
/// too where a folder outside of both has a name that is not UTF-8.
///
/// # Errors
/// A path that is not UTF-8 in each way.
fn path_from(folder: &Path, picture: &Path) -> Result<String> {
    let (folder, picture) = (real(folder)?, real(picture)?);
    let path = picture.strip_prefix(&folder).unwrap_or(&picture);
    let around = || relative(&folder, &picture);
    let path = path.to_str().map(str::to_owned).or_else(|| Some(around().to_str()?.to_owned()));
    let path = path.with_context(|| {
        format!(
            "{}: expected folders with names in UTF-8, which pose files can hold; rename them, or choose an --out \
             beside the photographs",
            picture.display()
        )
    })?;
    Ok(path.replace('\\', "/"))
}

/// The absolute path without links, of a path that need not exist.
fn real(path: &Path) -> Result<PathBuf> {
    let context = || path.display().to_string();
    let whole = std::path::absolute(path).with_context(context)?;
    let existing = whole.ancestors().find(|part| part.exists()).unwrap_or(&whole);
    let rest = whole.strip_prefix(existing).unwrap_or(Path::new(""));
    let mut real = std::fs::canonicalize(existing).with_context(context)?;
    // Joined as a whole, an empty rest would add a slash.
    real.extend(rest.components());
    Ok(real)
}

/// The path from a folder to a file, both absolute.
fn relative(folder: &Path, file: &Path) -> PathBuf {
    let shared = folder.components().zip(file.components()).take_while(|(a, b)| a == b).count();
    let up = folder.components().skip(shared).map(|_| Component::ParentDir);
    up.chain(file.components().skip(shared)).collect()
}

/// Refuses names that a pose file in `folder` cannot hold, before the work.
fn check_names(photographs: &[PathBuf], folder: &Path) -> Result<()> {
    for path in photographs {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let holds = path.to_str().is_some()
            && name.trim() == name
            && !name.contains(['\n', '\r'])
            && (cfg!(windows) || !name.contains('\\'));
        ensure!(
            holds,
            "{}: expected a name in UTF-8 without backslashes, line breaks and spaces at its ends, which pose \
             files can hold; rename the photograph",
            path.display()
        );
        path_from(folder, path)?;
    }
    Ok(())
}

/// Images and points of COLMAP's model. Names are those of the files, or paths below the folder that all
/// photographs have in common: COLMAP's programs get that folder as their image path.
fn colmap(
    estimated: &EstimatedScene,
    pictures: &[PathBuf],
) -> (Vec<(String, Camera)>, Vec<SparsePoint>) {
    let frames = &estimated.scene.frames;
    let names = distinct_names(pictures.iter().map(PathBuf::as_path));
    let name = |name: PathBuf| name.to_string_lossy().replace('\\', "/");
    let images = names.into_iter().map(name).zip(frames.iter().map(|f| f.camera)).collect();
    let points = estimated.estimate.points.iter().zip(&estimated.observations);
    // Points above and below all views of a panorama.
    let points = points.filter(|(_, observations)| observations.len() >= 2);
    let points = points.map(|(p, observations)| SparsePoint {
        position: p.position,
        colour: p.colour,
        error_px: p.error_px,
        track: observations.clone(),
    });
    (images, points.collect())
}

fn report(
    photographs: &[PathBuf],
    estimated: &EstimatedScene,
    files: &[PathBuf],
    progress: &Progress,
) -> Value {
    let estimate = &estimated.estimate;
    let cameras = photographs.iter().zip(&estimate.cameras).zip(&estimated.lenses);
    let photographs: Vec<Value> = cameras
        .map(|((path, camera), source)| {
            json!({
                "file": path.display().to_string(),
                "fx": camera.map(|c| c.intrinsics().fx),
                "focal_from": source.to_string(),
                "placed": camera.is_some(),
            })
        })
        .collect();
    json!({
        "photographs": photographs,
        "points": estimate.points.len(),
        "confidence": match estimate.confidence {
            Confidence::High => "high",
            Confidence::Low => "low",
        },
        "rotation_deviation_deg": estimate.rotation_error_deg,
        "direction_deviation_deg": estimate.direction_error_deg,
        "focal_deviation": estimate.focal.deviation,
        "warnings": estimated.scene.warnings,
        "files": files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>(),
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak_memory_bytes(),
    })
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    #[test]
    fn paths_below_a_folder_whose_name_is_not_utf_8() {
        let place = tempfile::tempdir().unwrap();
        let latin = place.path().join(OsStr::from_bytes(b"K\xfcche"));
        std::fs::create_dir_all(latin.join("photos")).unwrap();
        let picture = latin.join("photos/a.jpg");
        std::fs::write(&picture, "").unwrap();
        assert_eq!(path_from(&latin.join("photos"), &picture).unwrap(), "a.jpg");
        assert_eq!(path_from(&latin.join("out"), &picture).unwrap(), "../photos/a.jpg");
        let error = path_from(&place.path().join("out"), &picture).unwrap_err().to_string();
        assert!(error.contains("names in UTF-8"), "{error}");
        // Elsewhere the path is absolute, without links and `..`.
        let plain = place.path().join("plain");
        std::fs::create_dir(&plain).unwrap();
        std::fs::write(plain.join("a.jpg"), "").unwrap();
        let expected = std::fs::canonicalize(plain.join("a.jpg")).unwrap();
        let found = path_from(&place.path().join("out"), &plain.join("../plain/a.jpg")).unwrap();
        assert_eq!(Path::new(&found), expected);
    }
}
