//! Cameras of NeuS, IDR and VolSDF (DTU, BlendedMVS): `cameras_sphere.npz` or `cameras.npz`, a zip of NumPy arrays.
//!
//! `world_mat_N` is the projection K·[R | t] of the world into picture N, 3×4 or with a fourth row: `scale_mat_N`,
//! which moves the scene into a sphere, is not applied, so that the cameras keep the world's unit. The pictures lie
//! in `image`, and picture N is the N-th in the order of Python's `sorted`, that is, by bytes. Masks lie in `mask`. Where
//! pictures are missing, the numbers in the names of the others say which.
//!
//! The decomposition: the rows of R come from those of the left 3×3 matrix M, from the last one upwards (Gram and
//! Schmidt), and the factors are K. A projection is known up to its sign; that of det M makes R a rotation. The
//! position is −M⁻¹·p, with the fourth column p.
//!
//! Sources: lioryariv/idr and lioryariv/volsdf, `DATA_CONVENTION.md`; Totoro97/NeuS, `models/dataset.py`; R. Hartley
//! and A. Zisserman, Multiple View Geometry, 6.2.4.

use super::assemble::{Draft, Lens, assemble, list_images, scene_name};
use super::npy;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::{Error, Result, archive, read};
use glam::{DMat3, DMat4, DVec3};
use std::collections::BTreeSet;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// Names of the archive, in the order of preference.
pub(super) const NAMES: [&str; 2] = ["cameras_sphere.npz", "cameras.npz"];
/// Folders of pictures beside the archive, in the order of preference.
const FOLDERS: [&str; 3] = ["image", "images", "rgb"];
/// Folders of masks beside the archive.
const MASKS: [&str; 2] = ["mask", "masks"];
/// Start of the name of a projection.
const WORLD: &str = "world_mat_";
/// Longest array, bytes: a 4×4 matrix of f64 with the longest header.
const ARRAY_MAX: u64 = 1 << 13;
/// Largest skew that is rounding, in units of the focal length.
const SKEW: f64 = 1e-3;

/// Camera of a projection.
#[derive(Clone, Debug, PartialEq)]
pub struct NeusCamera {
    /// fx, fy, cx, cy, px.
    pub focal_and_center: [f64; 4],
    /// Skew in units of fx.
    pub skew: f64,
    /// OpenCV pose.
    pub world_from_camera: DMat4,
}

/// Decomposes a projection of 3×4 numbers by rows; `None` for one that is no camera's.
pub fn decompose(p: &[f64; 12]) -> Option<NeusCamera> {
    let column = |i: usize| DVec3::new(p[i], p[4 + i], p[8 + i]);
    let m = DMat3::from_cols(column(0), column(1), column(2));
    let sign = m.determinant().signum();
    let position = -(m.inverse() * column(3));
    let rows = (m * sign).transpose();
    let (first, second, third) = (rows.x_axis, rows.y_axis, rows.z_axis);
    let scale = third.length();
    let forward = third / scale;
    let cy = second.dot(forward);
    let down = second - cy * forward;
    let fy = down.length();
    let down = down / fy;
    let (cx, skew) = (first.dot(forward), first.dot(down));
    let right = first - cx * forward - skew * down;
    let fx = right.length();
    let pose = DMat4::from_cols(
        (right / fx).extend(0.0),
        down.extend(0.0),
        forward.extend(0.0),
        position.extend(1.0),
    );
    let focal_and_center = [fx, fy, cx, cy].map(|v| v / scale);
    let finite = pose.is_finite() && focal_and_center.iter().all(|v| v.is_finite());
    finite.then_some(NeusCamera { focal_and_center, skew: skew / fx, world_from_camera: pose })
}

/// Reads the cameras of an archive, each an error where it is none; `path` is for messages.
///
/// # Errors
/// No zip; no `world_mat_N`.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Vec<Result<NeusCamera>>> {
    cameras(path.as_ref(), bytes)
}

fn cameras(path: &Path, bytes: &[u8]) -> Result<Vec<Result<NeusCamera>>> {
    let (mut archive, numbers) = open(path, bytes)?;
    let count = numbers.len();
    if count == 0 || numbers.last() != Some(&(count - 1)) {
        let expected = format!("{WORLD}0.npy, {WORLD}1.npy and so on in the archive, none missing");
        return Err(Error::format(path, expected, format!("{count} of them")));
    }
    let camera = |i: usize| {
        let name = format!("{WORLD}{i}");
        let bad = |expected: String, got: String| {
            Error::format(path, expected, got).at(format!(" {name}"))
        };
        let bytes = archive::entry(&mut archive, &format!("{name}.npy"), ARRAY_MAX)
            .map_err(|(expected, got)| bad(expected, got))?;
        let array = npy::parse(path, &bytes).map_err(|error| error.at(format!(" {name}")))?;
        let first = array.numbers.first_chunk::<12>();
        let Some(p) = first.filter(|_| array.columns == 4 && (3..=4).contains(&array.rows)) else {
            return Err(bad("a matrix of 3x4 or 4x4".to_owned(), array.shape()));
        };
        let expected = "a projection K·[R | t] of finite numbers".to_owned();
        decompose(p).ok_or_else(|| bad(expected, format!("{p:?}")))
    };
    Ok((0..count).map(camera).collect())
}

/// An archive, and the numbers of its projections.
type Opened<'a> = (ZipArchive<Cursor<&'a [u8]>>, BTreeSet<usize>);

fn open<'a>(path: &Path, bytes: &'a [u8]) -> Result<Opened<'a>> {
    let archive = ZipArchive::new(Cursor::new(bytes))
        .map_err(|e| Error::format(path, "a whole zip archive of arrays (.npz)", e.to_string()))?;
    let number = |name: &str| name.strip_prefix(WORLD)?.strip_suffix(".npy")?.parse().ok();
    let numbers = archive.file_names().filter_map(|name| number(&name.ok()?)).collect();
    Ok((archive, numbers))
}

/// Number of cameras; 0 where the file cannot be read.
pub(super) fn count(path: &Path) -> usize {
    let bytes = read(path).unwrap_or_default();
    open(path, &bytes).map_or(0, |(_, numbers)| numbers.len())
}

/// Reads an archive, and finds pictures and masks beside it.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let cameras = parse(path, &read(path)?)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let pictures = pictures(folder, path, cameras.len(), reading)?;
    let masks = MASKS.map(|name| sorted(&folder.join(name)));
    let masks = masks.iter().find_map(|masks| of_cameras(masks, cameras.len())).unwrap_or_default();
    let drafts = cameras.into_iter().enumerate().map(|(i, camera)| {
        let image = pictures.get(i).cloned().flatten();
        let named = image.as_deref().and_then(Path::file_name);
        let name = named.map_or_else(|| i.to_string(), |n| n.to_string_lossy().into_owned());
        let camera = match camera {
            Ok(camera) => camera,
            Err(error) => return Draft::refused(name, error),
        };
        let NeusCamera { focal_and_center, skew, world_from_camera } = camera;
        let skew = if skew.abs() > SKEW { skew } else { 0.0 };
        let distortion = Distortion::polynomial([0.0; 4], [0.0; 2], skew);
        let (place, lens) = (format!(" {WORLD}{i}"), Lens::Pixels(focal_and_center));
        let mask = masks.get(i).cloned().flatten();
        Draft { image, mask, distortion, ..Draft::new(place, name, lens, world_from_camera) }
    });
    let drafts = drafts.collect();
    let mut scene = assemble(path, SceneFormat::Neus, &reading.needed(), drafts)?;
    scene.name = scene_name(folder);
    Ok(scene)
}

/// The pictures of `count` cameras: of the first folder that has as many, else of the first whose names say which are
/// missing.
fn pictures(
    folder: &Path,
    path: &Path,
    count: usize,
    reading: &Reading<'_>,
) -> Result<Vec<Option<PathBuf>>> {
    let places = reading.places(FOLDERS.iter().map(|name| folder.join(name)).collect());
    let mut all: Vec<Vec<PathBuf>> = places.iter().map(|place| sorted(place)).collect();
    // Stable: the order of preference stays among the others.
    all.sort_by_key(|pictures| pictures.len() != count);
    if let Some(pictures) = all.iter().find_map(|pictures| of_cameras(pictures, count)) {
        return Ok(pictures);
    }
    let lengths: Vec<String> = all.iter().map(|pictures| pictures.len().to_string()).collect();
    let expected = format!(
        "{count} pictures in image or images, one for each {WORLD}N, or names with the numbers of their cameras"
    );
    Err(Error::format(path, expected, format!("{} of them", lengths.join(", "))))
}

/// The file of each of `count` cameras among `files`, sorted: all of them in their order. Of fewer, the numbers that end
/// their names say which they are, from 0 where one is 0, from 1 where one is `count`; `None` where they do not.
fn of_cameras(files: &[PathBuf], count: usize) -> Option<Vec<Option<PathBuf>>> {
    if files.len() == count {
        return Some(files.iter().cloned().map(Some).collect());
    }
    let numbers = files.iter().map(|file| end_number(file)).collect::<Option<Vec<usize>>>()?;
    let first = match [0, count].map(|number| numbers.contains(&number)) {
        [true, false] => 0,
        [false, true] => 1,
        _ => return None,
    };
    let mut of = vec![None; count];
    for (file, number) in files.iter().zip(numbers) {
        let place = of.get_mut(number.checked_sub(first)?)?;
        if place.replace(file.clone()).is_some() {
            return None;
        }
    }
    Some(of)
}

/// The number that ends the name of a file, without its extension.
fn end_number(file: &Path) -> Option<usize> {
    let stem = file.file_stem()?.to_str()?;
    let start = stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    stem[start..].parse().ok()
}

/// The pictures of a folder in the order of bytes.
fn sorted(folder: &Path) -> Vec<PathBuf> {
    let mut pictures = list_images(folder);
    pictures.sort();
    pictures
}
