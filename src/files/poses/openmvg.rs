//! OpenMVG's `sfm_data.json`, with poses (`extrinsics`): that of a reconstruction, not the list of photographs.
//!
//! A pose is a rotation from the world to the camera, 3×3 by rows in OpenCV axes, and the camera's `center`.
//! Intrinsics are in pixels. Models read: `pinhole`, `pinhole_radial_k1`, `pinhole_radial_k3`, `pinhole_brown_t2` (K1
//! K2 K3 T1 T2; T1, T2 are OpenCV's p1, p2) and `fisheye` (OpenCV's). `spherical` is not read: its axes are x right, y
//! up, z forward, so that the world is mirrored. A view without a pose or intrinsics was not placed. Cameras refer to
//! the stored pixels.
//!
//! The library cereal writes the name of a model once: `polymorphic_id` has its highest bit set there, and later
//! entries have the rest of the number alone.
//!
//! Sources: openMVG/openMVG, `src/openMVG/geometry/pose3_io.hpp`, `cameras/Camera_*.hpp` and `cameras/*_io.hpp`,
//! `sfm/sfm_view_io.hpp`; USCiLab/cereal, `include/cereal/types/polymorphic.hpp`.

use super::assemble::{Draft, Lens, assemble};
use super::cameras_json::side;
use super::json;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::{Error, Result, read};
use glam::{DMat3, DMat4, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use std::collections::HashMap;
use std::path::Path;

/// Files from the folder of the scene, in the order of preference.
pub(super) const FILES: [&str; 4] = [
    "sfm_data.json",
    "reconstruction/sfm_data.json",
    "reconstruction_sequential/sfm_data.json",
    "reconstruction_global/sfm_data.json",
];
const MODELS_READ: &str =
    "a model among pinhole, pinhole_radial_k1, pinhole_radial_k3, pinhole_brown_t2, fisheye";
/// Bit of a `polymorphic_id` that a name follows.
const NAMED: u64 = 1 << 31;

/// An entry of a map.
#[derive(Deserialize)]
#[serde(expecting = "an entry: key, value")]
struct Entry<T> {
    key: u64,
    value: T,
}

/// A pointer to a value of one of several types.
#[derive(Deserialize)]
#[serde(expecting = "a pointer: polymorphic_id, ptr_wrapper")]
struct Pointer {
    #[serde(default)]
    polymorphic_id: u64,
    polymorphic_name: Option<String>,
    ptr_wrapper: Wrapper,
}

#[derive(Deserialize)]
#[serde(expecting = "a pointer's content: data")]
struct Wrapper {
    #[serde(default)]
    data: Value,
}

#[derive(Deserialize)]
#[serde(expecting = "a pose: rotation, center")]
struct Pose {
    #[serde(deserialize_with = "json::rows")]
    rotation: Vec<Vec<f64>>,
    #[serde(deserialize_with = "json::numbers")]
    center: Vec<f64>,
}

#[derive(Deserialize)]
#[serde(expecting = "a point: X")]
struct Point {
    #[serde(rename = "X", deserialize_with = "json::numbers")]
    position: Vec<f64>,
}

#[derive(Deserialize)]
#[serde(expecting = "OpenMVG's data: views, intrinsics, extrinsics")]
struct File {
    #[serde(default)]
    root_path: String,
    views: Vec<Entry<Pointer>>,
    intrinsics: Vec<Entry<Pointer>>,
    extrinsics: Vec<Entry<Pose>>,
    #[serde(default)]
    structure: Vec<Entry<Point>>,
}

/// The parts that say whether a file has cameras.
#[derive(Deserialize)]
struct Outline {
    views: Vec<Entry<Pointer>>,
    extrinsics: Vec<IgnoredAny>,
}

/// Number of poses; 0 where the file has none, or is another program's.
pub(super) fn count(path: &Path) -> usize {
    let outline = read(path).and_then(|bytes| json::parse::<Outline>(path, &bytes, ""));
    outline.map_or(0, |o| if o.views.is_empty() { 0 } else { o.extrinsics.len() })
}

/// Size, intrinsics and distortion of a camera.
#[derive(Clone)]
struct Camera {
    size: (usize, usize),
    lens: Lens,
    distortion: Distortion,
}

/// The camera of an entry with its model; errors are what is expected and what is found.
fn camera(model: &str, data: &Value) -> std::result::Result<Camera, (String, String)> {
    let [w, h] = ["width", "height"].map(|key| data[key].as_f64().and_then(side));
    let (Some(w), Some(h)) = (w, h) else {
        return Err(("width and height in whole pixels".to_owned(), "none".to_owned()));
    };
    let list = |key: &str| -> Vec<f64> {
        let values = data[key].as_array().into_iter().flatten();
        values.map(|value| value.as_f64().unwrap_or(f64::NAN)).collect()
    };
    let several = |key: &str, count: usize| {
        let values = list(key);
        let expected = || (format!("{key} of {count} numbers"), values.len().to_string());
        if values.len() == count { Ok(values) } else { Err(expected()) }
    };
    let distortion = match model {
        "pinhole" => Distortion::None,
        "pinhole_radial_k1" => {
            let k = several("disto_k1", 1)?;
            Distortion::brown([k[0], 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])
        }
        "pinhole_radial_k3" => {
            let k = several("disto_k3", 3)?;
            Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], [0.0; 2])
        }
        "pinhole_brown_t2" => {
            let k = several("disto_t2", 5)?;
            Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], [k[3], k[4]])
        }
        "fisheye" => {
            let k = several("fisheye", 4)?;
            Distortion::fisheye([k[0], k[1], k[2], k[3]])
        }
        other => return Err((MODELS_READ.to_owned(), format!("`{other}`"))),
    };
    let focal = data["focal_length"].as_f64();
    let focal = focal.ok_or_else(|| ("focal_length".to_owned(), "none".to_owned()))?;
    let center = several("principal_point", 2)?;
    let lens = [focal, focal, center[0], center[1]];
    Ok(Camera { size: (w, h), lens: Lens::Pixels(lens), distortion })
}

/// The cameras of a file by their keys.
fn cameras(path: &Path, entries: Vec<Entry<Pointer>>) -> HashMap<u64, Result<Camera>> {
    let mut names: HashMap<u64, String> = HashMap::new();
    let entry = |Entry { key, value }: Entry<Pointer>| {
        let Pointer { polymorphic_id: id, polymorphic_name, ptr_wrapper } = value;
        if let Some(name) = polymorphic_name {
            names.insert(id & !NAMED, name);
        }
        let model = names.get(&(id & !NAMED)).map_or("none", String::as_str);
        let camera = camera(model, &ptr_wrapper.data).map_err(|(expected, got)| {
            Error::format(path, expected, got).at(format!(" intrinsic {key}"))
        });
        (key, camera)
    };
    entries.into_iter().map(entry).collect()
}

/// Reads a file. Pictures may lie in its `root_path`, beside it, in the two folders above, and in an `images` folder of
/// each.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let expected = "OpenMVG's data (views, intrinsics, extrinsics)";
    let File { root_path, views, intrinsics, extrinsics, structure } =
        json::parse(path, &read(path)?, expected)?;
    let cameras = cameras(path, intrinsics);
    let poses: HashMap<u64, Pose> = extrinsics.into_iter().map(|e| (e.key, e.value)).collect();
    let folder = path.parent().unwrap_or(Path::new(""));
    let above = folder.parent().unwrap_or(folder);
    let root = Path::new(&root_path);
    let roots = [root, folder, above, above.parent().unwrap_or(above)];
    // The program's own folder of pictures is often that of another machine.
    let roots = if root_path.is_empty() { &roots[1..] } else { &roots[..] };
    let drafts = views.into_iter().map(|Entry { key, value }| {
        let data = value.ptr_wrapper.data;
        let text = |key: &str| data[key].as_str().unwrap_or_default().to_owned();
        let (local, file) = (text("local_path"), text("filename"));
        let name = if local.is_empty() { file } else { format!("{local}/{file}") };
        match draft(path, key, &name, &data, &cameras, &poses) {
            Ok(draft) => {
                let image = reading.find_of_scene(roots, &[folder, above], &name);
                Draft { image, ..draft }
            }
            Err(error) => Draft::refused(name, error),
        }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(path, SceneFormat::OpenMvg, reading, drafts)?;
    let position = |point: Entry<Point>| {
        let position = point.value.position;
        (position.len() == 3).then(|| DVec3::from_slice(&position))
    };
    let finite = structure.into_iter().filter_map(position).filter(|p| p.is_finite());
    let points: Vec<_> = finite.map(|p| (p - scene.origin).as_vec3()).collect();
    scene.points = (!points.is_empty()).then_some(points);
    Ok(scene)
}

fn draft(
    path: &Path,
    key: u64,
    name: &str,
    data: &Value,
    cameras: &HashMap<u64, Result<Camera>>,
    poses: &HashMap<u64, Pose>,
) -> Result<Draft> {
    let place = format!(" view {key}");
    let bad = |expected: &str, got: String| Error::format(path, expected, got).at(&place);
    let id = |key: &str| data[key].as_u64();
    let Some(pose) = id("id_pose").and_then(|id| poses.get(&id)) else {
        return Err(bad("a pose, which a view that OpenMVG placed has", "none".to_owned()));
    };
    let Camera { size, lens, distortion } = match id("id_intrinsic").and_then(|id| cameras.get(&id))
    {
        Some(Ok(camera)) => camera.clone(),
        Some(Err(error)) => return Err(error.copy()),
        None => return Err(bad("the key of an intrinsic", "none".to_owned())),
    };
    let rotation: Option<[f64; 9]> = pose.rotation.concat().try_into().ok();
    let (Some(rotation), &[x, y, z]) = (rotation, pose.center.as_slice()) else {
        let got = format!("{:?}, {:?}", pose.rotation, pose.center);
        return Err(bad("a rotation of 3x3 and a center of three numbers", got));
    };
    // The rows of the rotation from the world are the columns of its inverse.
    let rotation = DMat3::from_cols_array(&rotation);
    let mut pose = DMat4::from_mat3(rotation);
    pose.w_axis = DVec3::new(x, y, z).extend(1.0);
    Ok(Draft { size: Some(size), distortion, ..Draft::new(place, name.to_owned(), lens, pose) })
}
