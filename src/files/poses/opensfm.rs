//! OpenSfM's `reconstruction.json`: a list of reconstructions, of which the one with most pictures is read.
//!
//! Poses are camera-from-world: a rotation vector and a translation, OpenCV axes. Focal lengths and principal
//! points are in units of the picture's larger side, the principal point from the middle. Camera models read:
//! `perspective`, `simple_radial`, `radial`, `brown`, `fisheye`, `fisheye_opencv`. Coefficients are those of
//! OpenCV. Cameras refer to the stored pixels. Layout: OpenSfM, `doc/source/dataset.rst` and `geometry.rst`.

use super::assemble::{Draft, Lens, assemble};
use super::cameras_json::side;
use super::json;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::{Error, Result, read};
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

const MODELS_READ: &str =
    "a projection_type among perspective, simple_radial, radial, brown, fisheye, fisheye_opencv";

#[derive(Deserialize)]
#[serde(expecting = "a reconstruction: cameras, shots")]
struct Reconstruction {
    cameras: BTreeMap<String, Optics>,
    shots: BTreeMap<String, Shot>,
    #[serde(default)]
    points: BTreeMap<String, Point>,
}

#[derive(Deserialize)]
#[serde(expecting = "a camera: projection_type, width, height, focal")]
struct Optics {
    projection_type: String,
    width: f64,
    height: f64,
    focal: Option<f64>,
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    c_x: Option<f64>,
    c_y: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
#[serde(expecting = "a shot: camera, rotation, translation")]
struct Shot {
    camera: String,
    #[serde(deserialize_with = "json::numbers")]
    rotation: Vec<f64>,
    #[serde(deserialize_with = "json::numbers")]
    translation: Vec<f64>,
}

#[derive(Deserialize)]
#[serde(expecting = "a point: coordinates")]
struct Point {
    #[serde(deserialize_with = "json::numbers")]
    coordinates: Vec<f64>,
}

/// Size, intrinsics and distortion of a camera.
struct Camera {
    size: (usize, usize),
    lens: Lens,
    distortion: Distortion,
}

impl Optics {
    /// The camera in pixels.
    ///
    /// # Errors
    /// Expected and found values.
    fn camera(&self) -> std::result::Result<Camera, (String, String)> {
        let (Some(w), Some(h)) = (side(self.width), side(self.height)) else {
            let got = format!("{}x{}", self.width, self.height);
            return Err(("width and height in whole pixels".to_owned(), got));
        };
        let larger = w.max(h) as f64;
        let fx = self.focal_x.or(self.focal);
        let fy = self.focal_y.or(fx);
        let (Some(fx), Some(fy)) = (fx, fy) else {
            return Err(("focal, or focal_x and focal_y".to_owned(), "none".to_owned()));
        };
        let [cx, cy] = [self.c_x, self.c_y].map(|c| larger * c.unwrap_or(0.0));
        let k = [self.k1, self.k2, self.k3, self.k4].map(|k| k.unwrap_or(0.0));
        let p = [self.p1, self.p2].map(|p| p.unwrap_or(0.0));
        let distortion = match self.projection_type.as_str() {
            "perspective" | "radial" => {
                Distortion::brown([k[0], k[1], 0.0, 0.0, 0.0, 0.0], [0.0; 2])
            }
            "simple_radial" => Distortion::brown([k[0], 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
            "brown" => Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], p),
            "fisheye" => Distortion::fisheye([k[0], k[1], 0.0, 0.0]),
            "fisheye_opencv" => Distortion::fisheye(k),
            other => return Err((MODELS_READ.to_owned(), format!("`{other}`"))),
        };
        let center = [0.5 * w as f64 + cx, 0.5 * h as f64 + cy];
        let lens = Lens::Pixels([larger * fx, larger * fy, center[0], center[1]]);
        Ok(Camera { size: (w, h), lens, distortion })
    }
}

/// Number of pictures in the largest reconstruction.
pub(super) fn count(value: &serde_json::Value) -> usize {
    let shots = |one: &serde_json::Value| one["shots"].as_object().map_or(0, serde_json::Map::len);
    value.as_array().into_iter().flatten().map(shots).max().unwrap_or(0)
}

/// Reads the largest reconstruction. Pictures may lie beside the file, in its parent, and in an `images` folder
/// of either.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let expected = "a list of OpenSfM's reconstructions (cameras, shots)";
    let mut all: Vec<Reconstruction> = json::parse(path, &read(path)?, expected)?;
    let sizes: Vec<usize> = all.iter().map(|one| one.shots.len()).collect();
    let Some(largest) = (0..all.len()).max_by_key(|&i| (sizes[i], std::cmp::Reverse(i))) else {
        return Err(Error::format(path, expected, "an empty list"));
    };
    let Reconstruction { cameras, shots, points } = all.swap_remove(largest);
    let folder = path.parent().unwrap_or(Path::new(""));
    let roots = [folder, folder.parent().unwrap_or(folder)];
    let drafts = shots.into_iter().map(|(name, shot)| {
        draft(path, &name, &shot, &cameras).map_or_else(
            |error| Draft::refused(name.clone(), error),
            |draft| Draft { image: reading.find(&roots, &name), ..draft },
        )
    });
    let mut scene = assemble(path, SceneFormat::OpenSfm, reading, drafts.collect())?;
    let position = |p: Point| (p.coordinates.len() == 3).then(|| DVec3::from_slice(&p.coordinates));
    let finite = points.into_values().filter_map(position).filter(|p| p.is_finite());
    let points: Vec<_> = finite.map(|p| (p - scene.origin).as_vec3()).collect();
    scene.points = (!points.is_empty()).then_some(points);
    if sizes.len() > 1 {
        let others: Vec<String> =
            (0..sizes.len()).filter(|&i| i != largest).map(|i| sizes[i].to_string()).collect();
        scene.warnings.push(format!(
            "{}: the largest of {} reconstructions is read, with {} pictures; the others have {}",
            path.display(),
            sizes.len(),
            sizes[largest],
            others.join(", ")
        ));
    }
    Ok(scene)
}

fn draft(
    path: &Path,
    name: &str,
    shot: &Shot,
    cameras: &BTreeMap<String, Optics>,
) -> Result<Draft> {
    let place = format!(" shot {name}");
    let bad = |expected: &str, got: String| Error::format(path, expected, got).at(&place);
    let optics = cameras
        .get(&shot.camera)
        .ok_or_else(|| bad("the name of a camera", format!("`{}`", shot.camera)))?;
    let Camera { size, lens, distortion } =
        optics.camera().map_err(|(expected, got)| bad(&expected, got))?;
    let three = |v: &[f64]| (v.len() == 3).then(|| DVec3::from_slice(v)).filter(|v| v.is_finite());
    let (Some(turn), Some(translation)) = (three(&shot.rotation), three(&shot.translation)) else {
        let got = format!("{:?}, {:?}", shot.rotation, shot.translation);
        return Err(bad("rotation and translation of three finite numbers", got));
    };
    // The inverse of (R, t): (Rᵀ, −Rᵀt).
    let back = DQuat::from_scaled_axis(-turn);
    let pose = DMat4::from_rotation_translation(back, -(back * translation));
    Ok(Draft { size: Some(size), distortion, ..Draft::new(place, name.to_owned(), lens, pose) })
}
