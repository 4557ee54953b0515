//! Record3D's metadata: `metadata` of an unpacked .r3d, or `metadata.json` of an export, with the pictures
//! `rgbd/N.jpg` or `rgb/N.…`.
//!
//! A pose has seven numbers: a quaternion xyzw and a position, camera-to-world in ARKit's axes (x right, y up,
//! z backward), metres. `K` has the 3×3 intrinsics by columns, in pixels of `w`×`h`. `perFrameIntrinsicCoeffs`
//! (fx, fy, cx, cy) takes precedence. The picture N belongs to pose N, from 0.
//!
//! Source: nerfstudio, `process_data/record3d_utils.py`, whose poses go to a `transforms.json` as they are.

use super::assemble::{Draft, Lens, assemble};
use super::cameras_json::side;
use super::json;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat, Units};
use super::transforms::opengl_to_opencv;
use crate::files::{Error, Result, read};
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

#[derive(Deserialize)]
#[serde(expecting = "Record3D's metadata: K, w, h, poses")]
struct File {
    #[serde(rename = "K", deserialize_with = "json::numbers")]
    k: Vec<f64>,
    w: f64,
    h: f64,
    #[serde(deserialize_with = "json::rows")]
    poses: Vec<Vec<f64>>,
    #[serde(default, rename = "perFrameIntrinsicCoeffs", deserialize_with = "json::rows")]
    coefficients: Vec<Vec<f64>>,
}

/// fx, fy, cx, cy of a 3×3 matrix by columns; by rows too, which the place of the centre shows.
fn intrinsics(k: &[f64]) -> Option<[f64; 4]> {
    let &[fx, _, x, _, fy, y, cx, cy, _] = k else { return None };
    Some(if (cx, cy) == (0.0, 0.0) { [fx, fy, x, y] } else { [fx, fy, cx, cy] })
}

/// Reads the metadata and finds its pictures.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let file: File = json::parse(path, &read(path)?, "Record3D's metadata (K, w, h, poses)")?;
    let (Some(w), Some(h)) = (side(file.w), side(file.h)) else {
        let got = format!("{}x{}", file.w, file.h);
        return Err(Error::format(path, "w and h in whole pixels", got));
    };
    let Some(k) = intrinsics(&file.k) else {
        return Err(Error::format(path, "K of 9 numbers", file.k.len().to_string()));
    };
    let folder = path.parent().unwrap_or(Path::new(""));
    let places = ["rgbd", "rgb", "images"].map(|name| folder.join(name));
    let pictures = by_number(reading.list(&places));
    let drafts = file.poses.iter().enumerate().map(|(i, pose)| {
        let image = pictures.get(&i).cloned();
        let named = image.as_deref().and_then(Path::file_name);
        let name = named.map_or_else(|| i.to_string(), |n| n.to_string_lossy().into_owned());
        let place = format!(" pose {i}");
        let Some(pose) = matrix(pose) else {
            let expected = "seven finite numbers: a quaternion xyzw above 0 and a position";
            let error = Error::format(path, expected, format!("{pose:?}"));
            return Draft::refused(name, error.at(place));
        };
        let own = file.coefficients.get(i).and_then(|k| k.get(..4)?.try_into().ok());
        let lens = Lens::Pixels(own.unwrap_or(k));
        let draft = Draft::new(place, name, lens, opengl_to_opencv(pose));
        Draft { image, size: Some((w, h)), ..draft }
    });
    let mut scene = assemble(path, SceneFormat::Record3d, reading, drafts.collect())?;
    scene.units = Units::Metres;
    Ok(scene)
}

/// Pictures by the number that is their name; others (`12(3).jpg`) are left out, as nerfstudio does.
fn by_number(pictures: Vec<PathBuf>) -> HashMap<usize, PathBuf> {
    let number = |path: &PathBuf| path.file_stem()?.to_str()?.parse().ok();
    pictures.into_iter().filter_map(|path| Some((number(&path)?, path))).collect()
}

fn matrix(pose: &[f64]) -> Option<DMat4> {
    let &[x, y, z, w, tx, ty, tz] = pose else { return None };
    let (q, t) = (DQuat::from_xyzw(x, y, z, w), DVec3::new(tx, ty, tz));
    let valid = q.is_finite() && q.length() > 1e-6 && t.is_finite();
    valid.then(|| DMat4::from_rotation_translation(q.normalize(), t))
}
