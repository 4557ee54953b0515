//! Plain matrices: `poses.txt`, one pose per line (12 or 16 numbers, row by row), and
//! `K.txt`, the intrinsics in pixels of the stored pictures (3×3, or fx fy cx cy). The
//! pictures of `images/`, sorted by name with numbers in numeric order, belong to the lines.
//!
//! White space, commas and brackets separate numbers; `#` begins a comment.

use super::assemble::{Draft, Lens, Pictures, assemble};
use super::json::utf8;
use super::reading::{Reading, SceneOptions};
use super::scene::{Scene, SceneFormat};
use super::transforms::opengl_to_opencv;
use crate::files::{Error, Result, read};
use glam::{DMat4, DVec4};
use std::path::Path;

/// Calibration of KITTI's odometry.
const KITTI: &str = "calib.txt";

/// Direction and axes of a pose matrix.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PoseConvention {
    /// Camera to world, OpenCV axes (x right, y down, z forward).
    #[default]
    WorldFromCameraOpenCv,
    /// Camera to world, OpenGL axes (x right, y up, −z forward).
    WorldFromCameraOpenGl,
    /// World to camera, OpenCV axes.
    CameraFromWorldOpenCv,
}

impl PoseConvention {
    /// Converts a pose to this crate's convention.
    pub fn to_world_from_camera(self, matrix: DMat4) -> DMat4 {
        match self {
            Self::WorldFromCameraOpenCv => matrix,
            Self::WorldFromCameraOpenGl => opengl_to_opencv(matrix),
            Self::CameraFromWorldOpenCv => matrix.inverse(),
        }
    }
}

/// Parses the numbers of a text; an error is the first word that is not a number.
pub(super) fn numbers(text: &str) -> std::result::Result<Vec<f64>, String> {
    let text = text.split('#').next().unwrap_or("");
    text.split(|c: char| c.is_whitespace() || ",;[]()".contains(c))
        .filter(|w| !w.is_empty())
        .map(|w| w.parse().map_err(|_| format!("`{}`", w.chars().take(40).collect::<String>())))
        .collect()
}

/// Parses a matrix of 12 (3×4) or 16 (4×4) numbers, row by row, such as a line of
/// `poses.txt` or a command-line argument.
///
/// # Errors
/// A description of the text found.
pub fn parse_matrix(text: &str) -> std::result::Result<DMat4, String> {
    let v = numbers(text)?;
    if v.len() != 12 && v.len() != 16 {
        return Err(format!("{} numbers", v.len()));
    }
    let row = |i: usize| v.get(4 * i..4 * i + 4).map_or(DVec4::W, DVec4::from_slice);
    Ok(DMat4::from_cols(row(0), row(1), row(2), row(3)).transpose())
}

/// Parses fx, fy, cx, cy from 9 (3×3, row by row, no skew), 16 (4×4) or 4 numbers.
///
/// # Errors
/// A description of the text found.
pub fn parse_intrinsics(text: &str) -> std::result::Result<[f64; 4], String> {
    let lines: Vec<&str> = text.lines().map(|l| l.split('#').next().unwrap_or("")).collect();
    intrinsics(&numbers(&lines.join(" "))?)
}

/// fx, fy, cx, cy of the numbers of [`parse_intrinsics`].
pub(super) fn intrinsics(v: &[f64]) -> std::result::Result<[f64; 4], String> {
    match *v {
        [fx, fy, cx, cy] => Ok([fx, fy, cx, cy]),
        [fx, skew, cx, below, fy, cy, z0, z1, one] => {
            let shape_ok = below == 0.0 && z0 == 0.0 && z1 == 0.0 && one == 1.0;
            if !shape_ok || skew.abs() > 1e-3 * fx.abs() {
                return Err(format!("a matrix with skew, or no intrinsic matrix: {v:?}"));
            }
            Ok([fx, fy, cx, cy])
        }
        [a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0, 0.0, 0.0, 0.0, 1.0] => {
            intrinsics(&[a, b, c, d, e, f, g, h, i])
        }
        _ if v.len() == 16 => Err(format!("a 4x4 matrix that is no intrinsic matrix: {v:?}")),
        _ => Err(format!("{} numbers", v.len())),
    }
}

/// The text of a file.
pub(super) fn text(path: &Path) -> Result<String> {
    String::from_utf8(utf8(&read(path)?).into_owned()).map_err(|e| {
        let at = format!(" at byte {}", e.utf8_error().valid_up_to());
        Error::format(path, "UTF-8 text", "other bytes").at(at)
    })
}

/// Reads `poses.txt`, `K.txt` and `images/` of a folder.
///
/// # Errors
/// A file that is missing or malformed (the error names the line); a number of pictures that
/// is not the number of poses.
pub fn load(folder: impl AsRef<Path>, convention: PoseConvention) -> Result<Scene> {
    let options = SceneOptions { convention: Some(convention), ..SceneOptions::default() };
    load_with(folder.as_ref(), &Reading::with(Pictures::Needed, &options, None))
}

/// Reads a folder as [`load`] does, with the options of `reading`.
pub(super) fn load_with(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let (poses_path, k_path) = (folder.join("poses.txt"), folder.join("K.txt"));
    if !k_path.is_file() {
        let expected = "intrinsics beside poses.txt: fx fy cx cy, or a 3x3 matrix";
        let got = if folder.join(KITTI).is_file() {
            "none; calib.txt is KITTI's: write the 1st, 6th, 3rd and 7th number of its line P0 into K.txt, \
             and name the folder of its pictures, such as --images image_2"
        } else {
            "none"
        };
        return Err(Error::format(&k_path, expected, got));
    }
    let k = parse_intrinsics(&text(&k_path)?)
        .map_err(|got| Error::format(&k_path, "a 3x3 intrinsic matrix, or fx fy cx cy", got))?;
    let mut poses = Vec::new();
    for (i, line) in text(&poses_path)?.lines().enumerate() {
        if line.split('#').next().unwrap_or("").trim().is_empty() {
            continue;
        }
        let place = format!(":{}", i + 1);
        let matrix = parse_matrix(line).map_err(|got| {
            Error::format(&poses_path, "a pose of 12 or 16 numbers", got).at(&place)
        })?;
        poses.push((place, reading.pose(matrix, PoseConvention::default())));
    }
    let images = reading.list(&[folder.join("images")]);
    if images.len() != poses.len() {
        let expected = format!("{} pictures in images/, one for each pose", poses.len());
        return Err(Error::format(&poses_path, expected, images.len().to_string()));
    }
    let drafts = poses.into_iter().zip(images).map(|((place, pose), image)| {
        let file = image.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Draft { image: Some(image), ..Draft::new(place, file, Lens::Pixels(k), pose) }
    });
    assemble(&poses_path, SceneFormat::Matrices, &reading.needed(), drafts.collect())
}
