//! LLFF's `poses_bounds.npy`: an array N×17 of floats, one row for each picture.
//!
//! The first 15 numbers are a 3×5 matrix by rows: the camera's axes *down, right, backward* in the world as
//! columns, its position, and height, width and focal length in pixels. The last two are the nearest and the
//! farthest depth. Rows belong to the pictures in the order of Python's `sorted`, that is, by bytes. Where the
//! pictures are in reduced copies alone (`images_4`), the intrinsics are scaled.
//!
//! Source: Fyusion/LLFF, `llff/poses/pose_utils.py` (`load_colmap_data`, `save_poses`, `load_data`).

use super::assemble::{Draft, Lens, Pictures, assemble, list_images};
use super::cameras_json::side;
use super::npy;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::{Error, Result, read};
use glam::{DMat4, DVec3};
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::NearFar;

const COLUMNS: usize = 17;
/// Folders of pictures below the scene's, in the order of preference.
const FOLDERS: [&str; 5] = ["images", "images_2", "images_4", "images_8", ""];

/// Reads the rows of an array N×17; `path` is for messages.
///
/// # Errors
/// Those of a NumPy array; another shape, no row.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Vec<[f64; COLUMNS]>> {
    rows(path.as_ref(), bytes)
}

fn rows(path: &Path, bytes: &[u8]) -> Result<Vec<[f64; COLUMNS]>> {
    let array = npy::parse(path, bytes)?;
    if array.columns != COLUMNS || array.rows == 0 {
        let expected = format!("an array N x {COLUMNS} of at least one row");
        return Err(Error::format(path, expected, array.shape()));
    }
    let rows = array.numbers.chunks_exact(COLUMNS);
    Ok(rows.filter_map(|row| row.try_into().ok()).collect())
}

/// Number of cameras; 0 where the file cannot be read.
pub(super) fn count(path: &Path) -> usize {
    read(path).and_then(|bytes| parse(path, &bytes)).map_or(0, |rows| rows.len())
}

/// Reads an array and its pictures.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let rows = parse(path, &read(path)?)?;
    let pictures = pictures(path, rows.len(), reading)?;
    let drafts = rows.iter().enumerate().map(|(i, row)| {
        let image = pictures.get(i).cloned();
        let named = image.as_deref().and_then(Path::file_name);
        let name = named.map_or_else(|| format!("row {i}"), |n| n.to_string_lossy().into_owned());
        match draft(path, i, row) {
            Ok(draft) => Draft { image, file: name, ..draft },
            Err(error) => Draft::refused(name, error),
        }
    });
    let mut scene = assemble(path, SceneFormat::Llff, reading, drafts.collect())?;
    scene.near_far = near_far(&rows);
    Ok(scene)
}

/// The pictures of `count` rows, of the first folder that has as many.
fn pictures(path: &Path, count: usize, reading: &Reading<'_>) -> Result<Vec<PathBuf>> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let places = reading.places(FOLDERS.iter().map(|name| folder.join(name)).collect());
    let mut all: Vec<Vec<PathBuf>> = places.iter().map(|place| list_images(place)).collect();
    if let Some(i) = all.iter().position(|pictures| pictures.len() == count) {
        let mut pictures = all.swap_remove(i);
        pictures.sort();
        return Ok(pictures);
    }
    if reading.pictures == Pictures::Unread {
        return Ok(Vec::new());
    }
    let lengths: Vec<String> = all.iter().map(|pictures| pictures.len().to_string()).collect();
    let expected = format!("{count} pictures in images or images_4, one for each row");
    Err(Error::format(path, expected, format!("{} of them", lengths.join(", "))))
}

fn draft(path: &Path, index: usize, row: &[f64; COLUMNS]) -> Result<Draft> {
    let place = format!(" row {index}");
    let column = |j: usize| DVec3::new(row[j], row[5 + j], row[10 + j]);
    let (height, width, focal) = (row[4], row[9], row[14]);
    let (Some(w), Some(h)) = (side(width), side(height)) else {
        let got = format!("{width}x{height}");
        return Err(Error::format(path, "a picture size in whole pixels", got).at(place));
    };
    let (down, right, backward) = (column(0), column(1), column(2));
    let pose = DMat4::from_cols(
        right.extend(0.0),
        down.extend(0.0),
        (-backward).extend(0.0),
        column(3).extend(1.0),
    );
    let lens = Lens::Pixels([focal, focal, 0.5 * width, 0.5 * height]);
    Ok(Draft { size: Some((w, h)), ..Draft::new(place, String::new(), lens, pose) })
}

/// Nearest and farthest depth of all rows, where they are a range.
fn near_far(rows: &[[f64; COLUMNS]]) -> Option<NearFar> {
    let near = rows.iter().map(|row| row[15]).fold(f64::INFINITY, f64::min);
    let far = rows.iter().map(|row| row[16]).fold(0.0, f64::max);
    Some(NearFar::new(near as f32, far as f32)).filter(|range| range.is_valid())
}
