//! RealEstate10K camera files with their frames.
//!
//! The first line is the video's address. Each further line is a frame of 19 columns: time
//! stamp in microseconds; fx, fy, cx, cy divided by the frame's width and height; 0 0; the
//! 3×4 matrix camera-from-world, row by row, OpenCV axes. Frames are whole video frames at
//! any scale: fx = fx_norm · W of the *stored* frame, fy = fy_norm · H. A squeezed copy has
//! fx ≠ fy.
//!
//! Frames may lie in `images/`, `frames/`, a folder with the txt's name, or beside the txt.
//! The first rule that applies matches them with lines:
//!
//! 1. by time stamp, if all names are time stamps of the file (as downloaders write);
//! 2. by number, if every name is the index of a line, from 0;
//! 3. by order, if there are as many as lines (numbers in names in numeric order);
//! 4. by time stamp, if some names are time stamps.

use super::assemble::{Draft, Lens, assemble};
use super::json::utf8;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat, Units};
use crate::files::{Error, Result, read};
use glam::{DMat4, DVec4};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

const COLUMNS: usize = 19;

/// One line: a camera without a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Re10kCamera {
    /// Line of the file, from 1.
    pub line: usize,
    /// Time stamp, microseconds.
    pub timestamp: i64,
    /// fx/W, fy/H, cx/W, cy/H.
    pub normalised: [f64; 4],
    /// Inverse of the line's matrix.
    pub world_from_camera: DMat4,
}

/// Reads the text; `path` is for messages.
///
/// # Errors
/// Not UTF-8, a line that has not 19 numbers, no camera at all.
pub fn parse(
    path: impl AsRef<Path>,
    bytes: &[u8],
    warnings: &mut Vec<String>,
) -> Result<Vec<Re10kCamera>> {
    cameras(path.as_ref(), &utf8(bytes), warnings)
}

fn cameras(path: &Path, bytes: &[u8], warnings: &mut Vec<String>) -> Result<Vec<Re10kCamera>> {
    let text = std::str::from_utf8(bytes).map_err(|e| {
        Error::format(path, "UTF-8 text", "other bytes").at(format!(" at byte {}", e.valid_up_to()))
    })?;
    let mut cameras = Vec::new();
    let mut bent = 0;
    for (i, line) in text.lines().enumerate() {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        // The first line is an address; some files lack it.
        let address = i == 0 && words.first().is_some_and(|w| w.parse::<f64>().is_err());
        if words.is_empty() || address {
            continue;
        }
        let bad = |expected: &str, got: String| {
            Error::format(path, expected, got).at(format!(":{}", i + 1))
        };
        if words.len() != COLUMNS {
            return Err(bad("19 columns (time, fx fy cx cy, 0 0, 3x4)", words.len().to_string()));
        }
        let timestamp = words[0]
            .parse()
            .map_err(|_| bad("a time stamp in microseconds", format!("`{}`", words[0])))?;
        let mut v = [0.0f64; COLUMNS];
        for (v, word) in v.iter_mut().zip(&words).skip(1) {
            *v = word.parse().map_err(|_| bad("a number", format!("`{word}`")))?;
        }
        bent += usize::from(v[5] != 0.0 || v[6] != 0.0);
        let row = |j: usize| DVec4::new(v[j], v[j + 1], v[j + 2], v[j + 3]);
        let camera_from_world = DMat4::from_cols(row(7), row(11), row(15), DVec4::W).transpose();
        let world_from_camera = camera_from_world.inverse();
        if !world_from_camera.is_finite() {
            return Err(bad("a 3x4 matrix with an inverse", format!("{:?}", &v[7..])));
        }
        let normalised = [v[1], v[2], v[3], v[4]];
        cameras.push(Re10kCamera { line: i + 1, timestamp, normalised, world_from_camera });
    }
    if cameras.is_empty() {
        return Err(Error::format(path, "at least one camera line", "none"));
    }
    if bent > 0 {
        let path = path.display();
        warnings
            .push(format!("{path}: columns 6 and 7 are not 0 in {bent} lines; they are ignored"));
    }
    Ok(cameras)
}

/// Finds the camera file in a folder: a `.txt` whose first line is an address or has 19
/// columns.
pub(super) fn find(folder: &Path) -> Result<Option<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
    let mut files: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    files.sort();
    let like = |p: &PathBuf| {
        if p.extension().is_none_or(|e| e != "txt") {
            return false;
        }
        let Ok(bytes) = read(p) else { return false };
        let bytes = utf8(&bytes);
        let text = String::from_utf8_lossy(&bytes);
        let mut lines = text.lines().filter(|l| !l.trim().is_empty());
        let Some(first) = lines.next() else { return false };
        let numbers = |l: &str| l.split_ascii_whitespace().all(|w| w.parse::<f64>().is_ok());
        let columns = |l: &str| l.split_ascii_whitespace().count();
        (first.contains("://") && lines.next().is_some_and(|l| numbers(l) && columns(l) > 16))
            || (numbers(first) && columns(first) == COLUMNS)
    };
    Ok(files.into_iter().find(like))
}

/// Reads a camera file and finds its frames.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let mut warnings = Vec::new();
    let cameras = parse(path, &read(path)?, &mut warnings)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let places = [
        folder.join("images"),
        folder.join("frames"),
        folder.join(path.file_stem().unwrap_or_default()),
        folder.to_owned(),
    ];
    let images = reading.list(&places);
    if images.is_empty() {
        let expected = format!("pictures in {} or {}", places[0].display(), places[1].display());
        return Err(Error::format(path, expected, "none"));
    }
    let matched = matched(path, &cameras, &images, &mut warnings)?;
    let drafts = cameras.iter().zip(matched).filter_map(|(c, image)| {
        let image = image?;
        let file = image.file_name()?.to_string_lossy().into_owned();
        let place = format!(":{}", c.line);
        let draft = Draft::new(place, file, Lens::Normalised(c.normalised), c.world_from_camera);
        Some(Draft { image: Some(image), timestamp: Some(c.timestamp), ..draft })
    });
    let mut scene =
        assemble(path, SceneFormat::RealEstate10k, &reading.needed(), drafts.collect())?;
    scene.units = Units::RealEstate10k;
    warnings.append(&mut scene.warnings);
    scene.warnings = warnings;
    Ok(scene)
}

/// Finds the picture of each camera by the rules of the module's documentation.
fn matched(
    path: &Path,
    cameras: &[Re10kCamera],
    images: &[PathBuf],
    warnings: &mut Vec<String>,
) -> Result<Vec<Option<PathBuf>>> {
    let number = |p: &PathBuf| p.file_stem()?.to_str()?.parse::<i64>().ok();
    let numbered: HashMap<i64, &PathBuf> =
        images.iter().filter_map(|p| Some((number(p)?, p))).collect();
    let by = |key: &dyn Fn(usize) -> i64| -> Vec<Option<PathBuf>> {
        (0..cameras.len()).map(|i| numbered.get(&key(i)).map(|p| (*p).clone())).collect()
    };
    let found = |list: &[Option<PathBuf>]| list.iter().filter(|p| p.is_some()).count();

    let by_time = by(&|i| cameras[i].timestamp);
    let by_index = by(&|i| i as i64);
    let stamps: HashSet<i64> = cameras.iter().map(|c| c.timestamp).collect();
    let all_stamped = images.iter().all(|p| number(p).is_some_and(|n| stamps.contains(&n)));
    let (list, rule) = if all_stamped {
        (by_time, "time stamp")
    } else if numbered.len() == images.len() && found(&by_index) == images.len() {
        (by_index, "number")
    } else if images.len() == cameras.len() {
        return Ok(images.iter().cloned().map(Some).collect());
    } else if found(&by_time) > 0 {
        (by_time, "time stamp")
    } else {
        return Err(Error::format(
            path,
            format!("{} pictures, one for each line, or names that are time stamps", cameras.len()),
            images.len().to_string(),
        ));
    };
    let found = found(&list);
    if found < cameras.len() {
        let count = cameras.len();
        warnings.push(format!("{found} of {count} cameras have a picture, matched by {rule}"));
    }
    Ok(list)
}
