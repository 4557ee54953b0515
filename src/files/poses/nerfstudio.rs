//! nerfstudio's exports of cameras beside `transforms.json`.
//!
//! * `ns-export cameras`: a list of `file_path` and `transform`, a 3×4 matrix. The list has no focal lengths: they
//!   come from the pictures' EXIF data.
//! * `camera_path.json` of the viewer: `camera_path` with `camera_to_world` (16 numbers by rows) and `fov`, the
//!   angle of view from top to bottom in degrees; `render_width` and `render_height`. It has no pictures. Paths of
//!   fisheye and equirectangular views are refused.
//!
//! Matrices are OpenGL camera-to-world. Source: nerfstudio, `scripts/exporter.py` (`ExportCameraPoses`),
//! `exporter/exporter_utils.py` (`collect_camera_poses_for_dataset`) and `cameras/camera_paths.py`
//! (`get_path_from_json`).

use super::assemble::{Draft, Lens, Pictures, assemble};
use super::cameras_json::{matrix, side};
use super::json;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use super::transforms::opengl_to_opencv;
use crate::files::photos::photograph::probe_photograph;
use crate::files::{Error, Result, read};
use serde::Deserialize;
use std::path::Path;

#[derive(Deserialize)]
#[serde(expecting = "a pose: file_path, transform")]
struct Pose {
    file_path: String,
    #[serde(deserialize_with = "json::rows")]
    transform: Vec<Vec<f64>>,
}

#[derive(Deserialize)]
#[serde(expecting = "a path: camera_path, render_width, render_height")]
struct CameraPath {
    camera_path: Vec<PathCamera>,
    render_width: f64,
    render_height: f64,
    camera_type: Option<String>,
}

#[derive(Deserialize)]
#[serde(expecting = "a camera of a path: camera_to_world, fov")]
struct PathCamera {
    #[serde(deserialize_with = "json::numbers")]
    camera_to_world: Vec<f64>,
    fov: f64,
}

/// Reports whether the first picture of a list states its focal length.
pub(super) fn has_focal_lengths(path: &Path) -> bool {
    let list = || -> Option<bool> {
        let value = json::value(&read(path).ok()?).ok()?;
        let name = value.get(0)?.get("file_path")?.as_str()?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let image = Reading::new(Pictures::Needed).find(&[folder], name)?;
        Some(probe_photograph(image).ok()?.intrinsics().is_some())
    };
    list().unwrap_or(false)
}

/// Reads a list or a path.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let bytes = read(path)?;
    if json::is_list(&bytes) {
        let poses: Vec<Pose> = json::parse(path, &bytes, "a list of file_path and transform")?;
        let drafts = poses.into_iter().enumerate().map(|(i, pose)| {
            let name = pose.file_path.clone();
            of_list(path, i, pose, reading).unwrap_or_else(|e| Draft::refused(name, e))
        });
        let drafts: Vec<Draft> = drafts.collect();
        return assemble(path, SceneFormat::Nerfstudio, &reading.needed(), drafts);
    }
    let file: CameraPath = json::parse(path, &bytes, "a camera path of nerfstudio's viewer")?;
    // get_path_from_json takes every other word for a perspective.
    let kind = file.camera_type.as_deref().unwrap_or_default();
    if matches!(kind, "fisheye" | "equirectangular") {
        let expected = "a path with the camera_type perspective";
        return Err(Error::format(path, expected, format!("`{kind}`")));
    }
    let (Some(w), Some(h)) = (side(file.render_width), side(file.render_height)) else {
        let got = format!("{}x{}", file.render_width, file.render_height);
        return Err(Error::format(path, "render_width and render_height in whole pixels", got));
    };
    let drafts = file.camera_path.iter().enumerate().map(|(i, camera)| {
        of_path(path, i, camera, [w, h]).unwrap_or_else(|e| Draft::refused(i.to_string(), e))
    });
    assemble(path, SceneFormat::Nerfstudio, reading, drafts.collect())
}

fn of_list(path: &Path, index: usize, pose: Pose, reading: &Reading<'_>) -> Result<Draft> {
    let place = format!(" pose {index}");
    let matrix = matrix(&pose.transform)
        .map_err(|got| Error::format(path, "transform of 3x4 numbers", got).at(&place))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let image = reading.find(&[folder], &pose.file_path);
    let header = image.as_ref().map(probe_photograph).transpose()?;
    let lens = match header {
        None => Lens::Centred(1.0),
        Some(header) => {
            let focal = header.camera.focal.map(|focal| focal.px);
            Lens::Centred(focal.ok_or_else(|| {
                let expected =
                    "a focal length in the EXIF data of the picture, which the list lacks";
                Error::format(path, expected, "none").at(&place)
            })?)
        }
    };
    let draft = Draft::new(place, pose.file_path, lens, opengl_to_opencv(matrix));
    Ok(Draft { image, ..draft })
}

fn of_path(path: &Path, index: usize, camera: &PathCamera, size: [usize; 2]) -> Result<Draft> {
    let place = format!(" camera {index}");
    let bad = |expected: &str, got: String| Error::format(path, expected, got).at(&place);
    let rows: Vec<Vec<f64>> = camera.camera_to_world.chunks(4).map(<[f64]>::to_vec).collect();
    let pose = matrix(&rows).map_err(|got| bad("camera_to_world of 16 numbers", got))?;
    if !(camera.fov > 0.0 && camera.fov < 180.0) {
        return Err(bad("fov between 0 and 180 degrees", camera.fov.to_string()));
    }
    let [w, h] = size.map(|side| side as f64);
    let focal = 0.5 * h / (0.5 * camera.fov.to_radians()).tan();
    let lens = Lens::Pixels([focal, focal, 0.5 * w, 0.5 * h]);
    let draft = Draft::new(place, format!("{index:04}"), lens, opengl_to_opencv(pose));
    Ok(Draft { size: Some((size[0], size[1])), ..draft })
}
