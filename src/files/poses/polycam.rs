//! Polycam's raw data: a JSON file of each key frame in `keyframes/corrected_cameras` or `keyframes/cameras`.
//!
//! The entries `t_00` to `t_23` are the rows of a 3×4 matrix, camera-to-world in ARKit's axes: x to the right of
//! the picture as it is stored, y up, z backward, metres. Intrinsics are in pixels. The corrected cameras and
//! pictures, which have no lens distortion, are read where both exist.
//!
//! Sources: PolyCam/polyform, `README.md` and `convertors/instant_ngp.py` (the rows go to `transform_matrix` of
//! instant-ngp as they are); Apple, `ARCamera.transform`.

use super::assemble::{Draft, Lens, assemble, files};
use super::cameras_json::{matrix, side};
use super::json;
use super::matrices::PoseConvention;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat, Units};
use crate::files::{Error, Result, read};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Folders of cameras, each with the folder of its pictures; corrected ones first.
const FOLDERS: [[&str; 2]; 2] = [["corrected_cameras", "corrected_images"], ["cameras", "images"]];

/// Folder of the key frames in `folder`, with the folders of cameras and pictures that are read.
fn key_frames(folder: &Path) -> Option<[PathBuf; 2]> {
    let bases = [folder.join("keyframes"), folder.to_owned()];
    // A folder with the plain name `cameras` may be another program's.
    let named = |base: &Path| base.ends_with("keyframes") || base.join(FOLDERS[0][0]).is_dir();
    let base = bases.into_iter().find(|base| named(base) && base.is_dir())?;
    let pairs = FOLDERS.map(|pair| pair.map(|name| base.join(name)));
    let has = |pair: &&[PathBuf; 2]| !cameras_in(&pair[0]).is_empty();
    let with_pictures = |pair: &&[PathBuf; 2]| has(pair) && pair[1].is_dir();
    pairs.iter().find(with_pictures).or(pairs.iter().find(has)).cloned()
}

fn cameras_in(folder: &Path) -> Vec<PathBuf> {
    let mut all = files(folder);
    all.retain(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")));
    all
}

/// Number of cameras in `folder`, 0 where it is not Polycam's.
pub(super) fn count(folder: &Path) -> usize {
    key_frames(folder).map_or(0, |[cameras, _]| cameras_in(&cameras).len())
}

/// Reads the key frames of `folder`.
pub(super) fn load(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let Some([cameras, pictures]) = key_frames(folder) else {
        return Err(Error::format(folder, "keyframes/cameras of Polycam", "none"));
    };
    let drafts = cameras_in(&cameras).into_iter().map(|file| {
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        match draft(&file, &name, reading) {
            Ok(draft) => Draft { image: reading.find_exact(&[pictures.as_path()], &name), ..draft },
            Err(error) => Draft::refused(name, error),
        }
    });
    let mut scene = assemble(&cameras, SceneFormat::Polycam, reading, drafts.collect())?;
    scene.name = super::assemble::scene_name(folder);
    scene.units = Units::Metres;
    Ok(scene)
}

fn draft(file: &Path, name: &str, reading: &Reading<'_>) -> Result<Draft> {
    let expected = "a camera of Polycam (fx, fy, cx, cy, width, height, t_00 … t_23)";
    let camera: Value = json::parse(file, &read(file)?, expected)?;
    let number = |key: &str| {
        let value = camera.get(key).and_then(Value::as_f64);
        value.ok_or_else(|| Error::format(file, format!("a number `{key}`"), "none"))
    };
    let row = |i: usize| (0..4).map(|j| number(&format!("t_{i}{j}"))).collect::<Result<Vec<f64>>>();
    let pose = matrix(&[row(0)?, row(1)?, row(2)?])
        .map_err(|got| Error::format(file, "t_00 to t_23", got))?;
    let lens = Lens::Pixels([number("fx")?, number("fy")?, number("cx")?, number("cy")?]);
    let (width, height) = (number("width")?, number("height")?);
    let (Some(w), Some(h)) = (side(width), side(height)) else {
        let got = format!("{width}x{height}");
        return Err(Error::format(file, "width and height in whole pixels", got));
    };
    let place = format!(" frame {name}");
    let pose = reading.pose(pose, PoseConvention::WorldFromCameraOpenGl);
    let draft = Draft::new(place, name.to_owned(), lens, pose);
    Ok(Draft { size: Some((w, h)), ..draft })
}
