//! A text file with the pose matrix of each picture, as data sets have it:
//!
//! | data set | poses | intrinsics | pictures |
//! |---|---|---|---|
//! | ScanNet | `pose/0.txt` | `intrinsic/intrinsic_color.txt` | `color/0.jpg` |
//! | NSVF | `pose/0_0000.txt` | `intrinsics.txt` | `rgb/0_0000.png` |
//! | NeRF++ | `pose/NAME.txt` | `intrinsics/NAME.txt`, one for each picture | `rgb/NAME.png` |
//! | 7-Scenes, 3DMatch | `frame-000000.pose.txt` | none, or `camera-intrinsics.txt` | `frame-000000.color.png` |
//!
//! Poses are camera-to-world in OpenCV axes: 12 or 16 numbers by rows, on one line or on several. ScanNet has -inf
//! where the pose of a frame is not known. Intrinsics are a 3×3 or 4×4 matrix by rows in pixels, or NSVF's first line
//! `f cx cy 0` above lines of other content. ScanNet's and 7-Scenes' unit is the metre.
//!
//! 7-Scenes states no intrinsics of its colour camera. Its authors call both cameras uncalibrated and name focal
//! length 585 and centre (320, 240) of the depth camera at 640×480; these are used, with a warning.
//!
//! Sources: ScanNet/ScanNet, `SensReader/python/SensorData.py` (`export_poses`, `export_intrinsics`);
//! facebookresearch/NSVF, `fairnr/data/data_utils.py` (`load_intrinsics`); Kai-46/nerfplusplus, `README.md`, "Data
//! format"; the words of 7-Scenes' authors in naver/kapture, `tools/kapture_import_7scenes.py`.

use super::assemble::{Draft, Lens, assemble, files, scene_name};
use super::json::utf8;
use super::matrices::{PoseConvention, parse_intrinsics, parse_matrix, text};
use super::reading::Reading;
use super::scene::{Scene, SceneFormat, Units};
use crate::files::{Error, Result, first_bytes};
use std::path::{Path, PathBuf};

/// Folders of pictures in the scene's folder, in the order of preference.
const PICTURES: [&str; 5] = ["color", "rgb", "images", "image", ""];
/// ScanNet's intrinsics of the colour camera.
const SCANNET: &str = "intrinsic/intrinsic_color.txt";
/// Intrinsics of all pictures in the scene's folder, in the order of preference.
const INTRINSICS: [&str; 5] =
    [SCANNET, "intrinsic_color.txt", "intrinsics.txt", "camera-intrinsics.txt", "K.txt"];
/// End of the name of a pose of 7-Scenes.
const POSE: &str = ".pose.txt";
/// Intrinsics that 7-Scenes' authors name, and the size of their pictures.
const KINECT: Optics = Optics { k: [585.0, 585.0, 320.0, 240.0], size: Some((640, 480)) };
/// Longest pose file, bytes.
const POSE_MAX: usize = 4096;

/// Intrinsics of a picture.
#[derive(Clone, Copy)]
struct Optics {
    /// fx, fy, cx, cy, px.
    k: [f64; 4],
    /// Size to which they belong; `None` for that of the picture on disk.
    size: Option<(usize, usize)>,
}

/// Folder of the poses of a scene, and the names of poses and pictures.
struct Layout {
    poses: PathBuf,
    /// End of the name of a pose.
    pose: &'static str,
    /// End of the name of its picture, without the extension.
    picture: &'static str,
}

impl Layout {
    fn of(folder: &Path) -> Option<Self> {
        let layouts = [
            Self { poses: folder.join("pose"), pose: ".txt", picture: "" },
            Self { poses: folder.to_owned(), pose: POSE, picture: ".color" },
        ];
        layouts.into_iter().find(|layout| {
            let first = layout.files().into_iter().next();
            let start = first.and_then(|file| first_bytes(&file, POSE_MAX).ok());
            start.is_some_and(|start| parse_matrix(&String::from_utf8_lossy(&utf8(&start))).is_ok())
        })
    }

    fn files(&self) -> Vec<PathBuf> {
        let mut all = files(&self.poses);
        all.retain(|path| path.to_string_lossy().ends_with(self.pose));
        all
    }

    fn is_7_scenes(&self) -> bool {
        self.pose == POSE
    }

    /// The file with the intrinsics of all pictures.
    fn intrinsics(&self, folder: &Path) -> Option<PathBuf> {
        let in_folder = |base: &Path| INTRINSICS.map(|name| base.join(name)).into_iter();
        let own = in_folder(folder).find(|file| file.is_file());
        // A sequence of 7-Scenes and 3DMatch lies in a folder of its own, below that of the intrinsics.
        let above = folder.parent().filter(|_| self.is_7_scenes());
        own.or_else(|| in_folder(above?).find(|file| file.is_file()))
    }
}

/// Intrinsics of the pictures of a scene.
struct Lenses {
    /// Folder of the files for one picture each.
    of_each: PathBuf,
    /// Those of all pictures.
    shared: Option<Optics>,
    /// Those that the data set's authors name.
    stated: Option<Optics>,
}

impl Lenses {
    /// Intrinsics of the picture of a pose `name`.
    fn of(&self, name: &str) -> Result<Optics> {
        let own = self.of_each.join(format!("{name}.txt"));
        if own.is_file() {
            return intrinsics(&own);
        }
        let expected = || Error::format(own, "intrinsics of this picture", "no such file");
        self.shared.or(self.stated).ok_or_else(expected)
    }

    fn are_missing(&self) -> bool {
        self.shared.is_none() && self.stated.is_none() && !self.of_each.is_dir()
    }
}

/// Number of poses in `folder` where it has a folder of pictures; 0 where it is none of these layouts.
pub(super) fn count(folder: &Path) -> usize {
    let Some(layout) = Layout::of(folder) else { return 0 };
    let has_pictures = PICTURES[..4].iter().any(|name| folder.join(name).is_dir());
    if layout.is_7_scenes() || has_pictures { layout.files().len() } else { 0 }
}

/// The first pose in `folder`.
pub(super) fn first(folder: &Path) -> Option<PathBuf> {
    Layout::of(folder)?.files().into_iter().next()
}

/// The folder of the scene of which `file` is a pose.
pub(super) fn scene_of(file: &Path) -> Option<&Path> {
    let poses = file.parent()?;
    let mut scenes = [poses.parent(), Some(poses)].into_iter().flatten();
    scenes.find(|scene| Layout::of(scene).is_some_and(|layout| layout.poses == poses))
}

/// Reports whether `folder` has one of these layouts.
pub(super) fn is_scene(folder: &Path) -> bool {
    Layout::of(folder).is_some()
}

/// Reads the matrices of `folder`.
pub(super) fn load(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let Some(layout) = Layout::of(folder) else {
        return Err(Error::format(folder, "pose/NAME.txt or NAME.pose.txt of a matrix", "none"));
    };
    let shared = layout.intrinsics(folder);
    let lenses = Lenses {
        of_each: folder.join("intrinsics"),
        shared: shared.as_deref().map(intrinsics).transpose()?,
        stated: layout.is_7_scenes().then_some(KINECT),
    };
    if lenses.are_missing() {
        let expected = "intrinsics of the pictures in intrinsics.txt (3x3 or 4x4), in intrinsics/NAME.txt or in \
                        intrinsic/intrinsic_color.txt";
        return Err(Error::format(folder, expected, "none"));
    }
    let places = reading.places(PICTURES.iter().map(|name| folder.join(name)).collect());
    let places: Vec<&Path> = places.iter().map(PathBuf::as_path).collect();
    let drafts = layout.files().into_iter().map(|file| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = name.strip_suffix(layout.pose).unwrap_or(&name);
        let picture = format!("{name}{}", layout.picture);
        match draft(&file, name, &lenses, reading) {
            Ok(draft) => {
                Draft { image: reading.find_exact(&places, &picture), file: picture, ..draft }
            }
            Err(error) => Draft::refused(picture, error),
        }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(&layout.poses, SceneFormat::MatrixFiles, &reading.needed(), drafts)?;
    scene.name = scene_name(folder);
    if layout.is_7_scenes() || shared.is_some_and(|file| file.ends_with(SCANNET)) {
        scene.units = Units::Metres;
    }
    if let (None, Some(Optics { k: [focal, ..], .. })) = (lenses.shared, lenses.stated) {
        scene.warnings.push(format!(
            "{}: no intrinsics: the focal length is {focal} px at 640x480, which the authors of 7-Scenes name for the \
             depth camera of a Kinect; a 3x3 matrix in intrinsics.txt there takes precedence",
            folder.display()
        ));
    }
    Ok(scene)
}

fn draft(file: &Path, name: &str, lenses: &Lenses, reading: &Reading<'_>) -> Result<Draft> {
    let matrix = parse_matrix(&text(file)?)
        .map_err(|got| Error::format(file, "a pose of 12 or 16 numbers", got))?;
    if !matrix.is_finite() {
        let expected = "a pose of finite numbers, which a frame has whose pose is known";
        return Err(Error::format(file, expected, "numbers that are not finite"));
    }
    let Optics { k, size } = lenses.of(name)?;
    let pose = reading.pose(matrix, PoseConvention::WorldFromCameraOpenCv);
    let draft = Draft::new(format!(" frame {name}"), String::new(), Lens::Pixels(k), pose);
    Ok(Draft { size, ..draft })
}

/// Intrinsics of a file.
fn intrinsics(file: &Path) -> Result<Optics> {
    let text = text(file)?;
    let first: Vec<&str> = text.lines().next().unwrap_or("").split_ascii_whitespace().collect();
    let found = match (parse_intrinsics(&text), first.as_slice()) {
        (Ok(k), _) => Ok(k),
        // NSVF: `f cx cy 0`, then barycentre, nearest depth, scale, height and width.
        (Err(_), [f, cx, cy, zero]) if zero.parse() == Ok(0.0) => {
            parse_intrinsics(&format!("{f} {f} {cx} {cy}"))
        }
        (Err(got), _) => Err(got),
    };
    let k = found.map_err(|got| {
        Error::format(file, "an intrinsic matrix of 3x3 or 4x4, or f cx cy 0", got)
    })?;
    Ok(Optics { k, size: None })
}
