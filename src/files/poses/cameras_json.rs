//! `cameras.json`: the layout of this project and of `subsplat run`, and the list of 3DGS
//! training under the same name.
//!
//! ```json
//! {"convention": "...", "units": "metres",
//!  "frames": [{"file": "images/0.png", "width": 512, "height": 512,
//!              "fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0,
//!              "c2w": [[…], […], […], [0, 0, 0, 1]]}]}
//! ```
//!
//! `c2w` is OpenCV camera-to-world; intrinsics are in pixels of the stored picture, without
//! distortion. Optional keys of a frame are `timestamp_us`, `depth`, `mask` (a grey picture, 0 is masked), and `pixels`: `"upright"`
//! if the camera refers to the picture with its EXIF orientation applied (default: `"stored"`).
//! Optional keys of the file are `units` (`metres`, `re10k`) or `metric: true`, `near` and `far` (camera z in
//! world units, for all frames), and `points`, a list of `[x, y, z]` of sparse points. Unknown
//! keys are ignored.
//!
//! The list of 3DGS has `img_name, width, height, fx, fy, rotation` (camera to world),
//! `position` (of the camera): the same axes, principal point in the middle.

use super::assemble::{Draft, Lens, assemble, camera_error, origin_of};
use super::json;
use super::reading::Reading;
use super::rotations::orthonormal;
use super::scene::{Frame, Pixels, Scene, SceneFormat, Units};
use crate::files::{Error, Result, read, write_atomic};
use glam::{DMat4, DVec3, DVec4, Vec3};
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::Path;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

const CONVENTION: &str = "OpenCV camera-to-world (x right, y down, z forward); pixel intrinsics at \
                          the stored resolution; pinhole";

/// Value of the key `pixels` for [`Pixels::Upright`].
const UPRIGHT: &str = "upright";

/// A camera with the name of its picture, which need not exist.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedCamera {
    /// Path of the picture, relative to the folder of the file.
    pub file: String,
    /// Pixels to which the camera refers.
    pub pixels: Pixels,
    /// The camera.
    pub camera: Camera,
    /// Time stamp, microseconds.
    pub timestamp: Option<i64>,
    /// Path of the depth map, relative to the folder of the file.
    pub depth: Option<String>,
    /// Path of the mask, relative to the folder of the file ([`Frame::mask`]).
    pub mask: Option<String>,
}

/// Content of a `cameras.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraFile {
    /// Cameras in the file's order.
    pub cameras: Vec<NamedCamera>,
    /// Unit of length.
    pub units: Units,
    /// Nearest and farthest depth of the scene, camera z in world units.
    pub near_far: Option<NearFar>,
    /// Point of another world that is the origin of these cameras ([`Scene::origin`]).
    pub origin: DVec3,
}

/// Fields of the file that concern all frames.
#[derive(Clone, Default)]
struct FileInfo {
    units: Units,
    near_far: Option<NearFar>,
    points: Option<Vec<DVec3>>,
    /// Point of the first world that is the origin of this file's.
    origin: DVec3,
}

#[derive(Deserialize)]
#[serde(expecting = "an object with frames")]
struct InFile {
    units: Option<String>,
    #[serde(default)]
    metric: bool,
    near: Option<f32>,
    far: Option<f32>,
    points: Option<Vec<[f64; 3]>>,
    origin: Option<[f64; 3]>,
    frames: Vec<InFrame>,
}

#[derive(Deserialize)]
#[serde(expecting = "a frame: file, width, height, fx, fy, cx, cy, c2w")]
struct InFrame {
    file: String,
    width: f64,
    height: f64,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(deserialize_with = "json::rows")]
    c2w: Vec<Vec<f64>>,
    timestamp_us: Option<i64>,
    re10k_frame: Option<i64>,
    depth: Option<String>,
    mask: Option<String>,
    pixels: Option<String>,
}

#[derive(Deserialize)]
#[serde(expecting = "a camera: img_name, width, height, fx, fy, rotation, position")]
struct SplatFrame {
    img_name: String,
    width: f64,
    height: f64,
    fx: f64,
    fy: f64,
    rotation: [[f64; 3]; 3],
    position: [f64; 3],
}

#[derive(Serialize)]
struct OutFile<'a> {
    convention: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    units: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    near: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    far: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    origin: Option<[f64; 3]>,
    frames: Vec<OutFrame<'a>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    points: Vec<[f32; 3]>,
}

#[derive(Serialize)]
struct OutFrame<'a> {
    file: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pixels: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    timestamp_us: Option<i64>,
    width: usize,
    height: usize,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    c2w: [[f32; 4]; 4],
}

/// Converts a JSON number to the side of a picture.
pub(super) fn side(value: f64) -> Option<usize> {
    (value >= 1.0 && value <= f64::from(1 << 20) && value.fract() == 0.0).then_some(value as usize)
}

/// Converts the rows of a 3×4 or 4×4 matrix.
pub(super) fn matrix(rows: &[Vec<f64>]) -> std::result::Result<DMat4, String> {
    let shape_ok = (3..=4).contains(&rows.len()) && rows.iter().all(|r| r.len() == 4);
    if !shape_ok {
        let lengths: Vec<usize> = rows.iter().map(Vec::len).collect();
        return Err(format!("rows of {lengths:?} numbers"));
    }
    let row = |i: usize| rows.get(i).map_or(DVec4::W, |r| DVec4::new(r[0], r[1], r[2], r[3]));
    Ok(DMat4::from_cols(row(0), row(1), row(2), row(3)).transpose())
}

/// Reports whether a pose file has this layout: a JSON file whose frames have `c2w`, or a list of cameras. The
/// content decides. The name does where the content has no frames of this layout or of `transforms.json`.
///
/// # Errors
/// A file of another name than these two that is not JSON.
pub fn is_cameras_json(path: impl AsRef<Path>) -> Result<bool> {
    has_this_layout(path.as_ref())
}

fn has_this_layout(path: &Path) -> Result<bool> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    if !name.ends_with(".json") {
        return Ok(false);
    }
    let by_name = name == "cameras.json";
    let value = match json::value(&read(path)?) {
        Ok(value) => value,
        // Its reader names the place of the error.
        Err(_) if by_name || name == "transforms.json" => return Ok(by_name),
        Err(e) => return Err(json::error(path, "a JSON file with cameras", &e)),
    };
    let has = |key: &str| {
        let frames = value.get("frames").and_then(serde_json::Value::as_array);
        frames.is_some_and(|frames| frames.iter().any(|frame| frame.get(key).is_some()))
    };
    let cameras = |list: &Vec<_>| list.iter().any(|c: &serde_json::Value| c.is_object());
    let list = value.as_array().is_some_and(|list| name != "transforms.json" || cameras(list));
    Ok(list || has("c2w") || (by_name && !has("transform_matrix")))
}

fn drafts(path: &Path) -> Result<(Vec<Draft>, FileInfo)> {
    let bytes = read(path)?;
    if json::is_list(&bytes) {
        let frames: Vec<SplatFrame> =
            json::parse(path, &bytes, "a list of 3DGS cameras (img_name, rotation, …)")?;
        let drafts = frames.into_iter().enumerate().map(|(i, f)| {
            let name = f.img_name.clone();
            splat_draft(path, i, f).unwrap_or_else(|e| Draft::refused(name, e))
        });
        return Ok((drafts.collect(), FileInfo::default()));
    }
    let file: InFile = json::parse(path, &bytes, "cameras.json (frames with file, fx, …, c2w)")?;
    let re10k = |f: &InFrame| f.timestamp_us.is_some() || f.re10k_frame.is_some();
    let units = match file.units.as_deref() {
        Some("metres" | "meters" | "m") => Units::Metres,
        Some("re10k") => Units::RealEstate10k,
        None if file.metric => Units::Metres,
        None if !file.frames.is_empty() && file.frames.iter().all(re10k) => Units::RealEstate10k,
        _ => Units::Unknown,
    };
    let near_far = match (file.near, file.far) {
        (Some(near), Some(far)) if NearFar::new(near, far).is_valid() => {
            Some(NearFar::new(near, far))
        }
        (None, None) => None,
        (near, far) => {
            let got = format!("near {near:?}, far {far:?}");
            return Err(Error::format(path, "both near and far, 0 < near < far", got));
        }
    };
    let points = file.points.map(|p| p.into_iter().map(DVec3::from).collect::<Vec<_>>());
    if let Some(bad) = points.iter().flatten().find(|p| !p.is_finite()) {
        return Err(Error::format(path, "finite points", format!("{bad}")));
    }
    let drafts = file.frames.into_iter().enumerate().map(|(i, f)| {
        let name = f.file.clone();
        draft(path, i, f).unwrap_or_else(|e| Draft::refused(name, e))
    });
    let origin = file.origin.map_or(DVec3::ZERO, DVec3::from);
    Ok((drafts.collect(), FileInfo { units, near_far, points, origin }))
}

fn size(path: &Path, place: &str, width: f64, height: f64) -> Result<Option<(usize, usize)>> {
    match (side(width), side(height)) {
        (Some(w), Some(h)) => Ok(Some((w, h))),
        _ => {
            let got = format!("{width}x{height}");
            Err(Error::format(path, "a picture size in whole pixels", got).at(place))
        }
    }
}

fn draft(path: &Path, index: usize, f: InFrame) -> Result<Draft> {
    let place = format!(" frame {index}");
    let pose =
        matrix(&f.c2w).map_err(|got| Error::format(path, "c2w of 4x4 numbers", got).at(&place))?;
    let size = size(path, &place, f.width, f.height)?;
    let lens = Lens::Pixels([f.fx, f.fy, f.cx, f.cy]);
    let pixels = match f.pixels.as_deref() {
        None | Some("stored") => Pixels::Stored,
        Some(UPRIGHT) => Pixels::Upright,
        Some(other) => {
            let expected = "pixels `stored` or `upright`";
            return Err(Error::format(path, expected, format!("`{other}`")).at(place));
        }
    };
    let [depth, mask] = [f.depth, f.mask].map(|file| file.map(|file| folder(path).join(file)));
    let draft = Draft::new(place, f.file, lens, pose);
    Ok(Draft { size, pixels, timestamp: f.timestamp_us, depth, mask, ..draft })
}

fn splat_draft(path: &Path, index: usize, f: SplatFrame) -> Result<Draft> {
    let place = format!(" frame {index}");
    let rows: Vec<Vec<f64>> =
        (0..3).map(|i| [&f.rotation[i][..], &[f.position[i]]].concat()).collect();
    let pose = matrix(&rows)
        .map_err(|got| Error::format(path, "rotation of 3x3 numbers", got).at(&place))?;
    let size = size(path, &place, f.width, f.height)?;
    let lens = Lens::Pixels([f.fx, f.fy, 0.5 * f.width, 0.5 * f.height]);
    Ok(Draft { size, ..Draft::new(place, f.img_name, lens, pose) })
}

fn folder(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

/// Reads a scene. Frames without a picture are left out with a warning.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let (mut drafts, info) = drafts(path)?;
    for d in &mut drafts {
        d.image = reading.find(&[folder(path)], &d.file);
    }
    let mut scene = assemble(path, SceneFormat::CamerasJson, reading, drafts)?;
    scene.units = info.units;
    scene.near_far = info.near_far;
    scene.points =
        info.points.map(|points| points.iter().map(|p| (*p - scene.origin).as_vec3()).collect());
    scene.origin += info.origin;
    Ok(scene)
}

/// Reads the cameras; their pictures need not exist.
///
/// # Errors
/// Another layout; an invalid camera (the error names its frame).
pub fn load_cameras_json(path: impl AsRef<Path>) -> Result<CameraFile> {
    read_cameras(path.as_ref())
}

fn read_cameras(path: &Path) -> Result<CameraFile> {
    let (drafts, info) = drafts(path)?;
    let moved = origin_of(&drafts);
    let mut cameras = Vec::with_capacity(drafts.len());
    for mut d in drafts {
        d.world_from_camera.w_axis -= moved.extend(0.0);
        if let Some(error) = d.refused {
            return Err(error);
        }
        let (Some((width, height)), Lens::Pixels(k)) = (d.size, d.lens) else { continue };
        let [fx, fy, cx, cy] = k.map(|v| v as f32);
        let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
        let pose = orthonormal(d.world_from_camera).pose;

        let camera = Camera::new(intrinsics, pose.as_mat4())
            .map_err(|e| camera_error(path, &d.place, &e))?;
        let inside = |p: std::path::PathBuf| {
            p.strip_prefix(folder(path)).unwrap_or(&p).to_string_lossy().into_owned()
        };
        let (depth, mask) = (d.depth.map(inside), d.mask.map(inside));
        let (file, pixels, timestamp) = (d.file, d.pixels, d.timestamp);
        cameras.push(NamedCamera { file, pixels, camera, timestamp, depth, mask });
    }
    let FileInfo { units, near_far, origin, .. } = info;
    Ok(CameraFile { cameras, units, near_far, origin: origin + moved })
}

/// Writes this layout. Floats have enough digits to read back exactly.
///
/// # Errors
/// Errors of [`write_atomic`].
pub fn save_cameras_json(path: impl AsRef<Path>, content: &CameraFile) -> Result<()> {
    save_cameras_and_points(path, content, &[])
}

/// Writes this layout with sparse points, world units, from which [`super::scene::load_scene`]'s
/// callers take near and far.
///
/// # Errors
/// Errors of [`write_atomic`].
pub fn save_cameras_and_points(
    path: impl AsRef<Path>,
    content: &CameraFile,
    points: &[Vec3],
) -> Result<()> {
    write_cameras_and_points(path.as_ref(), content, points)
}

fn write_cameras_and_points(path: &Path, content: &CameraFile, points: &[Vec3]) -> Result<()> {
    let frame = |c: &'_ NamedCamera| {
        let Intrinsics { fx, fy, cx, cy, width, height } = c.camera.intrinsics();
        let c2w = c.camera.world_from_camera().transpose().to_cols_array_2d();
        (fx, fy, cx, cy, width, height, c2w)
    };
    let frames = content.cameras.iter().map(|c| {
        let (fx, fy, cx, cy, width, height, c2w) = frame(c);
        let file = c.file.as_str();
        let (depth, mask) = (c.depth.as_deref(), c.mask.as_deref());
        let timestamp_us = c.timestamp;
        let pixels = (c.pixels == Pixels::Upright).then_some(UPRIGHT);
        OutFrame { file, pixels, depth, mask, timestamp_us, width, height, fx, fy, cx, cy, c2w }
    });
    let units = match content.units {
        Units::Unknown => None,
        Units::Metres => Some("metres"),
        Units::RealEstate10k => Some("re10k"),
    };
    let (near, far) = content.near_far.map(|range| (range.near, range.far)).unzip();
    let frames = frames.collect();
    let points = points.iter().map(Vec3::to_array).collect();
    let origin = Some(content.origin.to_array()).filter(|origin| *origin != [0.0; 3]);
    let out = OutFile { convention: CONVENTION, units, near, far, origin, frames, points };
    let text = serde_json::to_string_pretty(&out)
        .map_err(|e| Error::io(path, std::io::Error::other(e)))?;
    write_atomic(path, |f| writeln!(f, "{text}"))
}

impl NamedCamera {
    /// Makes a named camera of a stored picture at the path `file`, without time stamp,
    /// depth map and mask.
    pub fn new(file: impl Into<String>, camera: Camera) -> Self {
        let (file, pixels) = (file.into(), Pixels::Stored);
        Self { file, pixels, camera, timestamp: None, depth: None, mask: None }
    }

    /// Makes a named camera of a frame's camera and the new path `file` of its picture. A file
    /// that is written anew has upright pixels, for which both values of [`Pixels`] agree.
    pub fn of_frame(frame: &Frame, file: impl Into<String>) -> Self {
        let (pixels, timestamp) = (frame.pixels, frame.timestamp);
        Self { pixels, timestamp, ..Self::new(file, frame.camera) }
    }
}
