//! Bundler's `bundle.out` with `list.txt`, whose lines name the pictures in the cameras' order.
//!
//! A camera is camera-from-world in axes x right, y up, −z forward: `f k1 k2`, a 3×3 rotation by rows, a
//! translation. The focal length is in pixels of the picture, whose middle is the principal point. Radial
//! factor: 1 + k1·r² + k2·r⁴ of the undistorted point, as OpenCV has it. A camera that Bundler did not place
//! has the focal length 0.
//!
//! Source: snavely/bundler_sfm, `README.md`, "Output format".

use super::assemble::{Draft, Lens, assemble};
use super::json::utf8;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use super::transforms::opengl_to_opencv;
use crate::files::photos::distortion::Distortion;
use crate::files::{Error, Result, read};
use glam::{DMat3, DMat4, DVec3};
use std::path::{Path, PathBuf};

/// First words of the file.
pub(super) const MAGIC: &str = "# Bundle file";
/// Names of the list of pictures, beside the file or in the folder above.
const LISTS: [&str; 3] = ["list.txt", "list.rd.txt", "list_focal.txt"];

/// Camera of a `bundle.out`.
#[derive(Clone, Debug, PartialEq)]
pub struct BundlerCamera {
    /// Line of the file, from 1.
    pub line: usize,
    /// Focal length, px; 0 where the picture has no camera.
    pub focal: f64,
    /// Radial distortion k1, k2.
    pub radial: [f64; 2],
    /// Rotation, camera from world.
    pub rotation: DMat3,
    /// Translation, camera from world.
    pub translation: DVec3,
    /// Indices of the points that the picture shows.
    pub points: Vec<u32>,
}

/// Content of a `bundle.out`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bundle {
    /// Cameras in the order of the list of pictures.
    pub cameras: Vec<BundlerCamera>,
    /// Positions of the points, world units.
    pub points: Vec<DVec3>,
}

/// The numbers of a text with their lines.
struct Numbers<'a, I> {
    path: &'a Path,
    words: I,
    line: usize,
}

impl<'a, I: Iterator<Item = (usize, &'a str)>> Numbers<'a, I> {
    fn error(&self, expected: &str, got: impl Into<String>) -> Error {
        Error::format(self.path, expected, got).at(format!(":{}", self.line))
    }

    fn next(&mut self, what: &str) -> Result<f64> {
        let Some((line, word)) = self.words.next() else {
            return Err(self.error(what, "the end of the file"));
        };
        self.line = line;
        let start: String = word.chars().take(40).collect();
        word.parse().map_err(|_| self.error(what, format!("`{start}`")))
    }

    fn count(&mut self, what: &str) -> Result<usize> {
        let value = self.next(what)?;
        let valid = value >= 0.0 && value.fract() == 0.0 && value <= f64::from(u32::MAX);
        if valid { Ok(value as usize) } else { Err(self.error(what, value.to_string())) }
    }

    fn three(&mut self, what: &str) -> Result<DVec3> {
        Ok(DVec3::new(self.next(what)?, self.next(what)?, self.next(what)?))
    }
}

/// Reads a `bundle.out`; `path` is for messages.
///
/// # Errors
/// Another start, a word that is no number, fewer numbers than the counts state.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Bundle> {
    bundle(path.as_ref(), bytes)
}

fn bundle(path: &Path, bytes: &[u8]) -> Result<Bundle> {
    let bytes = utf8(bytes);
    let text = String::from_utf8_lossy(&bytes);
    if !text.starts_with(MAGIC) {
        let start: String = text.chars().take(40).collect();
        return Err(Error::format(path, format!("`{MAGIC} v0.3`"), format!("{start:?}")));
    }
    let lines = text.lines().enumerate().skip(1);
    let words = lines.flat_map(|(i, line)| line.split_ascii_whitespace().map(move |w| (i + 1, w)));
    let mut numbers = Numbers { path, words, line: 1 };
    let cameras = numbers.count("the number of cameras")?;
    let points = numbers.count("the number of points")?;
    let mut bundle = Bundle::default();
    for _ in 0..cameras {
        let focal = numbers.next("a focal length")?;
        let line = numbers.line;
        let what = "a number of a camera (f k1 k2, 3x3 rotation, translation)";
        let radial = [numbers.next(what)?, numbers.next(what)?];
        let rows = [numbers.three(what)?, numbers.three(what)?, numbers.three(what)?];
        let rotation = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        let translation = numbers.three(what)?;
        let points = Vec::new();
        bundle.cameras.push(BundlerCamera { line, focal, radial, rotation, translation, points });
    }
    for index in 0..points {
        let what = "a number of a point (position, colour, views)";
        let position = numbers.three(what)?;
        numbers.three(what)?;
        for _ in 0..numbers.count("the number of a point's views")? {
            let camera = numbers.count("the index of a camera")?;
            numbers.three(what)?;
            let Some(camera) = bundle.cameras.get_mut(camera) else {
                let expected = format!("the index of one of {cameras} cameras");
                return Err(numbers.error(&expected, camera.to_string()));
            };
            camera.points.push(index as u32);
        }
        bundle.points.push(position);
    }
    Ok(bundle)
}

/// Number of cameras that the file states; 0 where it cannot be read.
pub(super) fn count(path: &Path) -> usize {
    let bytes = read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let line = text.lines().nth(1).unwrap_or_default();
    line.split_ascii_whitespace().next().and_then(|word| word.parse().ok()).unwrap_or(0)
}

/// Reads the file and its list of pictures.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let Bundle { cameras, points } = parse(path, &read(path)?)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let roots = [folder, folder.parent().unwrap_or(folder)];
    let names = names(path, &roots)?;
    if names.len() < cameras.len() {
        let expected = format!("a list of {} pictures, one for each camera", cameras.len());
        return Err(Error::format(path, expected, names.len().to_string()));
    }
    let drafts = cameras.into_iter().zip(names).map(|(camera, name)| {
        let place = format!(":{}", camera.line);
        if !(camera.focal > 0.0) {
            let expected = "a focal length above 0, which a picture that Bundler placed has";
            let error = Error::format(path, expected, camera.focal.to_string());
            return Draft::refused(name, error.at(place));
        }
        // The inverse of (R, t): (Rᵀ, −Rᵀt).
        let back = camera.rotation.transpose();
        let position = -(back * camera.translation);
        let pose = DMat4::from_cols(
            back.x_axis.extend(0.0),
            back.y_axis.extend(0.0),
            back.z_axis.extend(0.0),
            position.extend(1.0),
        );
        let [k1, k2] = camera.radial;
        let mut visible = camera.points;
        visible.dedup();
        Draft {
            image: reading.find(&roots, &name),
            distortion: Distortion::brown([k1, k2, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
            visible,
            ..Draft::new(place, name, Lens::Centred(camera.focal), opengl_to_opencv(pose))
        }
    });
    let drafts: Vec<Draft> = drafts.collect();
    let mut scene = assemble(path, SceneFormat::Bundler, &reading.needed(), drafts)?;
    // The frames' indices of points need every point.
    if !points.is_empty() && points.iter().all(|p| p.is_finite()) {
        scene.points = Some(points.iter().map(|p| (*p - scene.origin).as_vec3()).collect());
    } else {
        scene.frames.iter_mut().for_each(|frame| frame.visible.clear());
    }
    Ok(scene)
}

/// Paths of the pictures, from the list beside the file or in the folder above.
fn names(path: &Path, roots: &[&Path]) -> Result<Vec<String>> {
    let places = roots.iter().flat_map(|root| LISTS.iter().map(|list| root.join(list)));
    let Some(list) = places.into_iter().find(|place: &PathBuf| place.is_file()) else {
        return Err(Error::format(path, "list.txt beside it, which names the pictures", "none"));
    };
    let bytes = read(&list)?;
    let text = utf8(&bytes);
    let text = String::from_utf8_lossy(&text);
    Ok(text.lines().map(str::trim).filter(|line| !line.is_empty()).map(name_of).collect())
}

/// The picture of a line `NAME`, or `NAME 0 FOCAL`. A name may have spaces.
fn name_of(line: &str) -> String {
    let mut words = line.rsplitn(3, char::is_whitespace);
    let (focal, zero, name) = (words.next(), words.next(), words.next());
    match (name, zero, focal.map(str::parse::<f64>)) {
        (Some(name), Some("0"), Some(Ok(_))) => name.trim_end().to_owned(),
        _ => line.to_owned(),
    }
}
