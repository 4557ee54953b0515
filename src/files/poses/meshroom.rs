//! Meshroom's and AliceVision's scene as JSON: `cameras.sfm`, `sfm.json` or any `.sfm` with poses.
//!
//! A pose has a rotation of nine numbers by columns, from the world to the camera in OpenCV axes, and the camera's
//! `center`. By rows the nine numbers are the rotation from the camera to the world. Numbers are texts.
//!
//! `version` decides how intrinsics are read. Before 1.2.1 the principal point is from the picture's corner, later
//! from its middle. Before 1.2.2 the focal length is `pxFocalLength` in pixels, one number or two; later it is
//! `focalLength` in mm of `sensorWidth`, and fy = fx·`pixelRatio`, before 1.2.5 fx/`pixelRatio`. Before 1.2.8 `type`
//! names the distortion, later `distortionType`. Distortions read: none, radial K1 and K3, Brown (K1 K2 K3 T1 T2; T1,
//! T2 are OpenCV's p1, p2) and fisheye (OpenCV's). A view without a pose was not placed. Cameras refer to the stored
//! pixels.
//!
//! Source: alicevision/AliceVision, `src/aliceVision/sfmDataIO/jsonIO.hpp` (`saveMatrix` writes Eigen's matrices,
//! which are stored by columns), `jsonIO.cpp` (`loadIntrinsic`), `camera/cameraCommon.hpp` (names),
//! `camera/Distortion*.cpp`, `geometry/Pose3.hpp`.

use super::assemble::{Draft, Lens, assemble};
use super::cameras_json::side;
use super::json::{self, number_of};
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

const DISTORTIONS_READ: &str =
    "a pinhole with a distortion among none, radialk1, radialk3, brown, fisheye";
/// Width of a sensor where the file has none, mm.
const SENSOR: f64 = 36.0;

#[derive(Deserialize)]
#[serde(expecting = "Meshroom's scene: views, intrinsics, poses")]
struct File {
    #[serde(default)]
    version: Value,
    views: Vec<Value>,
    intrinsics: Vec<Value>,
    poses: Vec<Value>,
    #[serde(default)]
    structure: Vec<Point>,
}

#[derive(Deserialize)]
#[serde(expecting = "a point: X")]
struct Point {
    #[serde(rename = "X", default)]
    position: Value,
}

/// The parts that say whether a file has cameras.
#[derive(Deserialize)]
struct Outline {
    views: Vec<IgnoredAny>,
    poses: Vec<IgnoredAny>,
}

/// Number of poses; 0 where the file has none, or is another program's.
pub(super) fn count(path: &Path) -> usize {
    let outline = read(path).and_then(|bytes| json::parse::<Outline>(path, &bytes, ""));
    outline.map_or(0, |o| if o.views.is_empty() { 0 } else { o.poses.len() })
}

/// Reports whether a file has cameras of Meshroom.
pub(super) fn has_cameras(path: &Path) -> bool {
    count(path) > 0
}

/// The numbers of a list of numbers or texts; empty where it is no list.
fn numbers(value: &Value) -> Vec<f64> {
    let values = value.as_array().into_iter().flatten();
    values.map(|value| number_of(value).unwrap_or(f64::NAN)).collect()
}

/// An identifier, which is a text or a number.
fn id_of(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

/// Size, intrinsics and distortion of a camera.
struct Camera {
    size: (usize, usize),
    lens: Lens,
    distortion: Distortion,
}

/// The camera of an intrinsic; errors are what is expected and what is found.
fn camera(version: [u32; 3], value: &Value) -> std::result::Result<Camera, (String, String)> {
    let none = |expected: &str| (expected.to_owned(), "none".to_owned());
    let number = |key: &str| number_of(&value[key]);
    let [w, h] = ["width", "height"].map(|key| number(key).and_then(side));
    let (Some(width), Some(height)) = (w, h) else {
        return Err(none("width and height in whole pixels"));
    };
    let [w, h] = [width, height].map(|side| side as f64);
    let (fx, fy) = if version < [1, 2, 2] {
        let focal = match &value["pxFocalLength"] {
            list @ Value::Array(_) => numbers(list),
            one => number_of(one).into_iter().collect(),
        };
        match *focal.as_slice() {
            [f] => (f, f),
            [fx, fy] => (fx, fy),
            _ => return Err(none("pxFocalLength of one or two numbers")),
        }
    } else {
        let focal = number("focalLength").ok_or_else(|| none("focalLength, mm"))?;
        let fx = focal / number("sensorWidth").unwrap_or(SENSOR) * w;
        let ratio = number("pixelRatio").unwrap_or(1.0);
        (fx, if version < [1, 2, 5] { fx / ratio } else { fx * ratio })
    };
    let &[x, y] = numbers(&value["principalPoint"]).as_slice() else {
        return Err(none("principalPoint of two numbers"));
    };
    let from_middle = version >= [1, 2, 1];
    let [cx, cy] = if from_middle { [0.5 * w + x, 0.5 * h + y] } else { [x, y] };
    let lens = Lens::Pixels([fx, fy, cx, cy]);
    Ok(Camera { size: (width, height), lens, distortion: distortion(version, value)? })
}

fn distortion(
    version: [u32; 3],
    value: &Value,
) -> std::result::Result<Distortion, (String, String)> {
    let text = |key: &str| value[key].as_str().unwrap_or("none").to_ascii_lowercase();
    let (model, undistortion) = (text("type"), text("undistortionType"));
    let name = if version < [1, 2, 8] { model.clone() } else { text("distortionType") };
    let is_pinhole = version < [1, 2, 8] || model == "pinhole";
    if !is_pinhole || undistortion != "none" {
        let got = format!("type `{model}`, undistortionType `{undistortion}`");
        return Err((DISTORTIONS_READ.to_owned(), got));
    }
    let k = numbers(&value["distortionParams"]);
    let (count, radial): (usize, _) = match name.as_str() {
        "none" | "pinhole" => (0, true),
        "radial1" | "radialk1" => (1, true),
        "radial3" | "radialk3" => (3, true),
        "brown" => (5, true),
        "fisheye4" | "fisheye" => (4, false),
        _ => return Err((DISTORTIONS_READ.to_owned(), format!("`{name}`"))),
    };
    // AliceVision takes zeros where the number differs.
    let term = |i: usize| if k.len() == count { k.get(i).copied().unwrap_or(0.0) } else { 0.0 };
    Ok(if radial {
        Distortion::brown([term(0), term(1), term(2), 0.0, 0.0, 0.0], [term(3), term(4)])
    } else {
        Distortion::fisheye([0, 1, 2, 3].map(term))
    })
}

/// Reads a file. Pictures have their paths; they may lie beside the file, in its parent, and in an `images` folder of
/// either.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let expected = "Meshroom's scene (views, intrinsics, poses)";
    let file: File = json::parse(path, &read(path)?, expected)?;
    let version = match *numbers(&file.version).as_slice() {
        [a, b, c] => [a, b, c].map(|part| part as u32),
        _ => return Err(Error::format(path, "a version of three numbers", "none")),
    };
    let by_id = |list: &[Value], key: &str| -> HashMap<String, Value> {
        list.iter().filter_map(|value| Some((id_of(&value[key])?, value.clone()))).collect()
    };
    let intrinsics = by_id(&file.intrinsics, "intrinsicId");
    let poses = by_id(&file.poses, "poseId");
    let folder = path.parent().unwrap_or(Path::new(""));
    let roots = [folder, folder.parent().unwrap_or(folder)];
    let drafts = file.views.iter().map(|view| {
        let name = view["path"].as_str().unwrap_or_default().to_owned();
        match draft(path, version, &name, view, &intrinsics, &poses) {
            Ok(draft) => Draft { image: reading.find(&roots, &name), ..draft },
            Err(error) => Draft::refused(name, error),
        }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(path, SceneFormat::Meshroom, reading, drafts)?;
    let position = |point: &Point| {
        let position = numbers(&point.position);
        (position.len() == 3).then(|| DVec3::from_slice(&position))
    };
    let finite = file.structure.iter().filter_map(position).filter(|p| p.is_finite());
    let points: Vec<_> = finite.map(|p| (p - scene.origin).as_vec3()).collect();
    scene.points = (!points.is_empty()).then_some(points);
    Ok(scene)
}

fn draft(
    path: &Path,
    version: [u32; 3],
    name: &str,
    view: &Value,
    intrinsics: &HashMap<String, Value>,
    poses: &HashMap<String, Value>,
) -> Result<Draft> {
    let place = format!(" view {}", id_of(&view["viewId"]).unwrap_or_default());
    let bad = |expected: &str, got: &str| Error::format(path, expected, got).at(&place);
    if view["isPoseIndependant"].as_str() == Some("false") || view["isPoseIndependant"] == false {
        return Err(bad("a view with a pose of its own", "one of a rig"));
    }
    let Some(pose) = id_of(&view["poseId"]).and_then(|id| poses.get(&id)) else {
        return Err(bad("a pose, which a view that Meshroom placed has", "none"));
    };
    let Some(intrinsic) = id_of(&view["intrinsicId"]).and_then(|id| intrinsics.get(&id)) else {
        return Err(bad("the intrinsicId of an intrinsic", "none"));
    };
    let Camera { size, lens, distortion } =
        camera(version, intrinsic).map_err(|(expected, got)| bad(&expected, &got))?;
    let transform = &pose["pose"]["transform"];
    let rotation: Option<[f64; 9]> = numbers(&transform["rotation"]).try_into().ok();
    let center: Option<[f64; 3]> = numbers(&transform["center"]).try_into().ok();
    let (Some(rotation), Some(center)) = (rotation, center) else {
        return Err(bad("a rotation of nine numbers and a center of three", "others"));
    };
    let mut pose = DMat4::from_mat3(DMat3::from_cols_array(&rotation).transpose());
    pose.w_axis = DVec3::from_array(center).extend(1.0);
    Ok(Draft { size: Some(size), distortion, ..Draft::new(place, name.to_owned(), lens, pose) })
}
