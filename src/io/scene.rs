//! Posed photographs: one type for every pose format, and the detection of formats.
//!
//! Whatever the file's own conventions, a [`Scene`] has OpenCV cameras
//! (`world_from_camera`) and intrinsics in pixels of the stored picture, pixel
//! centres at +0.5 (`camera.rs`). A folder with several pose files is read by this
//! precedence: `cameras.json`, `transforms.json`, COLMAP, RealEstate10K txt,
//! `poses.txt` with `K.txt`; naming the file itself chooses another.
//!
//! EXIF orientation is never applied: pose files speak of the stored pixels. Where
//! it is set, a warning says so.

use super::assemble::{Draft, Lens, assemble};
use super::image::Rgb;
use super::undistort::{Distortion, pinhole, undistort};
use super::{Error, Result, cameras_json, colmap, matrices, re10k, transforms};
use crate::camera::Camera;
use glam::Vec3;
use std::path::{Path, PathBuf};

/// Where a scene's cameras came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFormat {
    /// `cameras.json` as `run` writes it, or the list that 3DGS writes.
    CamerasJson,
    /// nerfstudio's and instant-ngp's `transforms.json`.
    Transforms,
    /// COLMAP's sparse model, binary or text.
    Colmap,
    /// RealEstate10K's camera txt.
    RealEstate10k,
    /// `poses.txt` with `K.txt`.
    Matrices,
    /// Two pictures with cameras from the command line.
    Pair,
}

impl SceneFormat {
    /// For messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::CamerasJson => "cameras.json",
            Self::Transforms => "transforms.json",
            Self::Colmap => "COLMAP",
            Self::RealEstate10k => "RealEstate10K txt",
            Self::Matrices => "poses.txt with K.txt",
            Self::Pair => "two pictures with given cameras",
        }
    }
}

/// What is known of the scene's unit of length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Units {
    /// Nothing.
    #[default]
    Unknown,
    /// Metres.
    Metres,
    /// RealEstate10K's own scale, for which near 1 and far 100 are the field's habit.
    RealEstate10k,
}

/// One posed photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The picture's path in the pose file, without leading `images/` and extension.
    pub name: String,
    /// The picture on disk.
    pub image: PathBuf,
    /// Camera of the stored picture, before [`Frame::distortion`].
    pub camera: Camera,
    /// Lens distortion that the stored picture still has.
    pub distortion: Distortion,
    /// Time stamp of a video frame, microseconds (RealEstate10K).
    pub timestamp: Option<i64>,
    /// 16-bit depth map of the stored picture, where the pose file names one.
    pub depth: Option<PathBuf>,
    /// Indices into [`Scene::points`] of the points that this frame observed.
    pub visible: Vec<u32>,
}

impl Frame {
    /// Camera of the picture that [`Frame::load`] gives.
    ///
    /// # Errors
    /// A distortion that cannot be removed.
    pub fn pinhole(&self) -> Result<Camera> {
        let intrinsics = pinhole(&self.camera.intrinsics, &self.distortion).map_err(|got| {
            Error::format(&self.image, "a lens distortion that can be undone", got)
        })?;
        Ok(Camera { intrinsics, ..self.camera })
    }

    /// Decodes the picture and removes the lens distortion.
    ///
    /// # Errors
    /// Everything of [`super::image::load`]; a size that is not the camera's.
    pub fn load(&self) -> Result<(Rgb, Camera)> {
        let picture = super::image::load(&self.image)?;
        let k = &self.camera.intrinsics;
        if (picture.width, picture.height) != (k.width, k.height) {
            let got = format!("{}x{}", picture.width, picture.height);
            return Err(Error::format(&self.image, format!("{}x{}", k.width, k.height), got));
        }
        let camera = self.pinhole()?;
        if self.distortion == Distortion::None {
            return Ok((picture, camera));
        }
        Ok((undistort(&picture, k, &self.distortion, &camera.intrinsics), camera))
    }
}

/// A set of posed photographs.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The folder's name.
    pub name: String,
    /// At least one; in the pose file's order (COLMAP: by name).
    pub frames: Vec<Frame>,
    /// Sparse points of a reconstruction, world coordinates.
    pub points: Option<Vec<Vec3>>,
    /// Format of the pose file.
    pub source: SceneFormat,
    /// Unit of length.
    pub units: Units,
    /// Nearest and farthest depth that the pose file gives, world units of camera z.
    pub near_far: Option<(f32, f32)>,
    /// Harmless oddities, one line each, for the user.
    pub warnings: Vec<String>,
}

impl Scene {
    /// Two pictures with known cameras. A camera's size must be its picture's.
    ///
    /// # Errors
    /// A picture that is missing, broken or of another size.
    pub fn from_pair(a: &Path, b: &Path, camera_a: Camera, camera_b: Camera) -> Result<Self> {
        let draft = |path: &Path, camera: Camera| {
            let k = camera.intrinsics;
            Draft {
                size: Some((k.width, k.height)),
                image: Some(path.to_owned()),
                ..Draft::new(
                    String::new(),
                    path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                    Lens::Pixels([k.fx, k.fy, k.cx, k.cy].map(f64::from)),
                    camera.world_from_camera.as_dmat4(),
                )
            }
        };
        let drafts = vec![draft(a, camera_a), draft(b, camera_b)];
        assemble(a, SceneFormat::Pair, drafts)
    }
}

/// Where COLMAP's model is looked for in a scene's folder.
const MODEL_FOLDERS: [&str; 4] = ["sparse/0", "sparse", "colmap/sparse/0", ""];

/// Reads the scene in a folder, or behind one pose file.
///
/// # Errors
/// No pose file; a pose file that is broken (file and line or byte are named); no
/// picture at all; a picture whose size does not fit its camera.
pub fn load_scene(path: &Path) -> Result<Scene> {
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if metadata.is_file() {
        return load_file(path);
    }
    for name in ["cameras.json", "transforms.json"] {
        let file = path.join(name);
        if file.is_file() {
            return load_file(&file);
        }
    }
    for folder in MODEL_FOLDERS {
        let model = path.join(folder);
        if colmap::is_model(&model) {
            return colmap::load(&model);
        }
    }
    if let Some(file) = re10k::find(path)? {
        return re10k::load(&file);
    }
    if path.join("poses.txt").is_file() {
        return matrices::load(path, matrices::PoseConvention::default());
    }
    Err(Error::format(
        path,
        "cameras.json, transforms.json, a COLMAP model (sparse/0), a RealEstate10K txt, or \
         poses.txt with K.txt",
        "a folder with none of them",
    ))
}

/// Whether `path` is a folder with a pose file that [`load_scene`] takes.
pub fn is_scene(path: &Path) -> bool {
    let file = |name: &str| path.join(name).is_file();
    ["cameras.json", "transforms.json", "poses.txt"].into_iter().any(file)
        || MODEL_FOLDERS.iter().any(|f| colmap::is_model(&path.join(f)))
        || re10k::find(path).is_ok_and(|f| f.is_some())
}

fn load_file(path: &Path) -> Result<Scene> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let folder = path.parent().unwrap_or(Path::new(""));
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match (name.as_str(), extension.as_str()) {
        (_, "json") if cameras_json::is_cameras_json(path)? => cameras_json::load(path),
        (_, "json") => transforms::load(path),
        ("cameras.txt" | "images.txt" | "points3d.txt", _) | (_, "bin") => colmap::load(folder),
        ("poses.txt" | "k.txt", _) => matrices::load(folder, matrices::PoseConvention::default()),
        (_, "txt") => re10k::load(path),
        _ => Err(Error::format(
            path,
            "a folder or a pose file (.json, .txt, .bin)",
            format!("a file with extension `{extension}`"),
        )),
    }
}
