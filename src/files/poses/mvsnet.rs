//! Cameras of MVSNet and its successors (CasMVSNet, Vis-MVSNet, BlendedMVS, `colmap2mvsnet.py`): a text file of each
//! picture, `cams/00000000_cam.txt`.
//!
//! The word `extrinsic` and a 4×4 matrix by rows, world-to-camera in OpenCV axes; the word `intrinsic` and a 3×3
//! matrix in pixels of the picture; a line of depths: the nearest one, the interval of the planes, their number, and
//! the farthest depth. The last one or two may be missing. Without the number the line is no range: it is a parameter
//! of the network. The picture has the number of the camera as its name.
//!
//! Sources: YoYo000/MVSNet, `README.md`, "Camera Files", and `mvsnet/preprocess.py` (`load_cam`: two, three
//! or four depths); YoYo000/BlendedMVS, `README.md` (`blended_images`; a nearest depth may be below zero).

use super::assemble::{Draft, Lens, assemble, files};
use super::json::utf8;
use super::matrices::{PoseConvention, intrinsics};
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::{Error, Result, first_bytes, read};
use glam::DMat4;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::NearFar;

/// Folders of cameras in the scene's folder, in the order of preference; the last one is the folder itself.
const CAMERAS: [&str; 4] = ["cams", "cams_1", "Cameras", ""];
/// Folders of pictures beside that of the cameras, in the order of preference.
const PICTURES: [&str; 7] =
    ["images", "blended_images", "image", "rgb", "rectified", "Rectified", ""];
/// End of the name of a camera's file.
pub(super) const ENDING: &str = "_cam.txt";
/// Bytes from the start of a file in which its first word lies.
const START: usize = 64;

/// Camera of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct MvsNetCamera {
    /// 4×4 matrix, world to camera.
    pub camera_from_world: DMat4,
    /// fx, fy, cx, cy, px.
    pub focal_and_center: [f64; 4],
    /// Range of depths, where the file has one.
    pub near_far: Option<NearFar>,
}

/// Reads the file of a camera; `path` is for messages.
///
/// # Errors
/// Another word than `extrinsic` or `intrinsic` in its place, fewer numbers, a number that is not finite, an intrinsic
/// matrix with skew.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<MvsNetCamera> {
    camera(path.as_ref(), bytes)
}

fn camera(path: &Path, bytes: &[u8]) -> Result<MvsNetCamera> {
    let bytes = utf8(bytes);
    let text = String::from_utf8_lossy(&bytes);
    let mut words = text.split_ascii_whitespace();
    let rows: [f64; 16] = matrix(path, &mut words, "extrinsic")?;
    let k: [f64; 9] = matrix(path, &mut words, "intrinsic")?;
    let focal_and_center = intrinsics(&k)
        .map_err(|got| Error::format(path, "an intrinsic matrix without skew", got))?;
    let depths: Vec<f64> = words.map_while(|word| word.parse().ok()).collect();
    let near_far = match *depths.as_slice() {
        [near, _, _, far, ..] => Some(NearFar::new(near as f32, far as f32)),
        [near, step, planes] => Some(NearFar::new(near as f32, (near + step * planes) as f32)),
        _ => None,
    };
    Ok(MvsNetCamera {
        camera_from_world: DMat4::from_cols_array(&rows).transpose(),
        focal_and_center,
        near_far: near_far.filter(|range| range.is_valid()),
    })
}

/// The `N` numbers after the word `name`.
fn matrix<'a, const N: usize>(
    path: &Path,
    words: &mut impl Iterator<Item = &'a str>,
    name: &str,
) -> Result<[f64; N]> {
    let shown = |word: &str| format!("`{}`", word.chars().take(40).collect::<String>());
    let bad = |got: String| {
        let expected = format!("the word `{name}` and {N} finite numbers");
        Err(Error::format(path, expected, got))
    };
    let end = || "the end of the file".to_owned();
    match words.next() {
        Some(word) if word == name => {}
        other => return bad(other.map_or_else(end, shown)),
    }
    let mut numbers = [0.0; N];
    for number in &mut numbers {
        let Some(word) = words.next() else { return bad(end()) };
        match word.parse::<f64>() {
            Ok(value) if value.is_finite() => *number = value,
            _ => return bad(shown(word)),
        }
    }
    Ok(numbers)
}

/// The folder of cameras of the scene in `folder`.
pub(super) fn cameras_of(folder: &Path) -> Option<PathBuf> {
    CAMERAS.map(|name| folder.join(name)).into_iter().find(|cameras| {
        let first = in_folder(cameras).into_iter().next();
        let start = first.and_then(|file| first_bytes(&file, START).ok()).unwrap_or_default();
        String::from_utf8_lossy(&utf8(&start)).trim_start().starts_with("extrinsic")
    })
}

/// The cameras' files in a folder.
fn in_folder(cameras: &Path) -> Vec<PathBuf> {
    let mut all = files(cameras);
    all.retain(|path| path.to_string_lossy().ends_with(ENDING));
    all
}

/// Number of cameras in a folder of cameras.
pub(super) fn count(cameras: &Path) -> usize {
    in_folder(cameras).len()
}

/// Reads the cameras of a folder of cameras, and finds the pictures beside it.
pub(super) fn load(cameras: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let above = cameras.parent().unwrap_or(Path::new(""));
    let places: Vec<PathBuf> =
        [above, cameras].iter().flat_map(|base| PICTURES.map(|name| base.join(name))).collect();
    let places = reading.places(places);
    let folders: Vec<&Path> = places.iter().map(PathBuf::as_path).collect();
    let numbered: HashMap<u64, PathBuf> = reading
        .list(&places)
        .into_iter()
        .filter_map(|path| Some((path.file_stem()?.to_str()?.parse().ok()?, path)))
        .collect();
    let mut range: Option<NearFar> = None;
    let drafts = in_folder(cameras).into_iter().map(|file| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = name.strip_suffix(ENDING).unwrap_or(&name).to_owned();
        let camera = match read(&file).and_then(|bytes| parse(&file, &bytes)) {
            Ok(camera) => camera,
            Err(error) => return Draft::refused(name, error),
        };
        if let Some(own) = camera.near_far {
            let all = range.unwrap_or(own);
            range = Some(NearFar::new(all.near.min(own.near), all.far.max(own.far)));
        }
        let pose = reading.pose(camera.camera_from_world, PoseConvention::CameraFromWorldOpenCv);
        let image = reading.find_exact(&folders, &name);
        let image = image.or_else(|| numbered.get(&name.parse().ok()?).cloned());
        let lens = Lens::Pixels(camera.focal_and_center);
        Draft { image, ..Draft::new(format!(" camera {name}"), name, lens, pose) }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(cameras, SceneFormat::MvsNet, &reading.needed(), drafts)?;
    scene.name = super::assemble::scene_name(above);
    scene.near_far = range;
    Ok(scene)
}
