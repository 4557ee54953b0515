//! 3D Scanner App (iOS), export "All data": a JSON file of each frame, `frame_00000.json`, with the picture
//! `frame_00000.jpg` beside it. Not every frame has a picture.
//!
//! `cameraPoseARFrame` has 16 numbers, camera-to-world in ARKit's axes (x to the right of the picture as it is
//! stored, y up, z backward), metres. They are rows; columns too, which the place of 0 0 0 1 shows. `intrinsics` has
//! the 3×3 matrix by rows or by columns, in pixels of the picture.
//!
//! Sources: PSegs, `psegs/datasets/ios_lidar.py` (rows, OpenGL's axes as rtabmap has them), and other public readers of
//! these files, which agree on the rows; Apple, `ARCamera.transform`.

use super::assemble::{Draft, Lens, assemble, files, scene_name};
use super::json;
use super::matrices::{PoseConvention, intrinsics};
use super::reading::Reading;
use super::scene::{Scene, SceneFormat, Units};
use crate::files::{Error, Result, lower_extension, read};
use glam::DMat4;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Start of the name of a frame's file.
const FRAME: &str = "frame_";

#[derive(Deserialize)]
#[serde(expecting = "a frame: cameraPoseARFrame, intrinsics")]
struct Frame {
    #[serde(rename = "cameraPoseARFrame", deserialize_with = "json::numbers")]
    pose: Vec<f64>,
    #[serde(deserialize_with = "json::numbers")]
    intrinsics: Vec<f64>,
}

fn frames(folder: &Path) -> Vec<PathBuf> {
    let mut all = files(folder);
    all.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with(FRAME) && lower_extension(path) == "json"
    });
    all
}

/// Number of frames in `folder`; 0 where the first has no pose.
pub(super) fn count(folder: &Path) -> usize {
    let all = frames(folder);
    let is_frame = all.first().is_some_and(|file| parse(file).is_ok());
    if is_frame { all.len() } else { 0 }
}

/// The first frame's file in `folder`.
pub(super) fn first(folder: &Path) -> Option<PathBuf> {
    frames(folder).into_iter().next()
}

/// Returns whether a file is that of a frame.
pub(super) fn is_frame(file: &Path) -> bool {
    parse(file).is_ok()
}

fn parse(file: &Path) -> Result<Frame> {
    let expected = "a frame of 3D Scanner App (cameraPoseARFrame, intrinsics)";
    json::parse(file, &read(file)?, expected)
}

/// Reads the frames of `folder`.
pub(super) fn load(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let drafts = frames(folder).into_iter().map(|file| {
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        match draft(&file, &name, reading) {
            Ok(draft) => Draft { image: reading.find_exact(&[folder], &name), ..draft },
            Err(error) => Draft::refused(name, error),
        }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(folder, SceneFormat::ScannerApp, &reading.needed(), drafts)?;
    scene.name = scene_name(folder);
    scene.units = Units::Metres;
    Ok(scene)
}

fn draft(file: &Path, name: &str, reading: &Reading<'_>) -> Result<Draft> {
    let Frame { pose, intrinsics: k } = parse(file)?;
    let numbers: Option<[f64; 16]> = pose.try_into().ok();
    let Some(numbers) = numbers.filter(|numbers| numbers.iter().all(|v| v.is_finite())) else {
        return Err(Error::format(file, "cameraPoseARFrame of 16 finite numbers", "others"));
    };
    let columns = DMat4::from_cols_array(&numbers);
    let last_row = [3, 7, 11, 15].map(|i| numbers[i]);
    let pose = if last_row == [0.0, 0.0, 0.0, 1.0] { columns } else { columns.transpose() };
    let k = match *k.as_slice() {
        // Columns: the centre stands in the last one.
        [fx, 0.0, 0.0, skew, fy, 0.0, cx, cy, 1.0] => [fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        [a, b, c, d, e, f, g, h, i] => [a, b, c, d, e, f, g, h, i],
        _ => return Err(Error::format(file, "intrinsics of 9 numbers", k.len().to_string())),
    };
    let k = intrinsics(&k).map_err(|got| Error::format(file, "an intrinsic matrix", got))?;
    let pose = reading.pose(pose, PoseConvention::WorldFromCameraOpenGl);
    Ok(Draft::new(format!(" frame {name}"), name.to_owned(), Lens::Pixels(k), pose))
}
