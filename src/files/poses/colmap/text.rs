//! COLMAP's text files: `#` comments, one record a line (two in `images.txt`), in UTF-8, or in UTF-16 with a byte
//! order mark.
//!
//! * `cameras.txt`: CAMERA_ID MODEL WIDTH HEIGHT PARAMS…
//! * `images.txt`: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of
//!   X Y POINT3D_ID triples, which may be empty, and which some exporters leave out
//! * `points3D.txt`: POINT3D_ID X Y Z R G B ERROR TRACK…

use super::super::json::utf8;
use super::{Cameras, ColmapCamera, ColmapImage, MODELS, Points, camera, pose};
use crate::files::{Error, Result};
use glam::DVec3;
use std::path::Path;
use std::str::{FromStr, SplitAsciiWhitespace};

/// A line with its number, for messages.
#[derive(Clone, Copy)]
struct Line<'a> {
    path: &'a Path,
    number: usize,
    text: &'a str,
}

impl Line<'_> {
    fn error(&self, expected: impl Into<String>, got: impl Into<String>) -> Error {
        Error::format(self.path, expected, got).at(format!(":{}", self.number))
    }

    fn number<T: FromStr>(&self, word: Option<&str>, what: &str) -> Result<T> {
        let Some(word) = word else { return Err(self.error(what, "the end of the line")) };
        word.parse().map_err(|_| self.error(what, format!("`{}`", shown(word))))
    }

    /// Numbers, of which those that other languages write for no number are not a number.
    fn numbers<const N: usize>(
        &self,
        words: &mut SplitAsciiWhitespace<'_>,
        what: &str,
    ) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for v in &mut values {
            let word = words.next();
            *v = match word {
                Some(word) if is_no_number(word) => f64::NAN,
                word => self.number(word, what)?,
            };
        }
        Ok(values)
    }
}

/// Returns whether a word is no number in the way of C libraries: `-nan(ind)`, `1.#QNAN`, `-1.#IND`.
fn is_no_number(word: &str) -> bool {
    let word = word.trim_start_matches(['-', '+']).to_ascii_lowercase();
    word.starts_with("nan") || word.starts_with("1.#")
}

/// Returns the start of a word, which may be megabytes long.
fn shown(word: &str) -> String {
    word.chars().take(40).collect()
}

fn lines<'a>(path: &'a Path, bytes: &'a [u8]) -> Result<Vec<Line<'a>>> {
    let text = std::str::from_utf8(bytes).map_err(|e| {
        let line = 1 + bytes[..e.valid_up_to()].iter().filter(|b| **b == b'\n').count();
        Error::format(path, "UTF-8 text", "other bytes").at(format!(":{line}"))
    })?;
    let line = |(i, text): (usize, &'a str)| Line { path, number: i + 1, text: text.trim() };
    Ok(text.lines().enumerate().map(line).collect())
}

fn records<'a>(path: &'a Path, bytes: &'a [u8]) -> Result<impl Iterator<Item = Line<'a>>> {
    let lines = lines(path, bytes)?.into_iter();
    Ok(lines.filter(|l| !l.text.is_empty() && !l.text.starts_with('#')))
}

/// Reads `cameras.txt`; `path` is for messages.
///
/// # Errors
/// A line without an id, an id twice. A camera model that is not read, and parameters that do not parse, are
/// errors of that camera.
pub fn parse_cameras(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Cameras> {
    cameras(path.as_ref(), &utf8(bytes))
}

fn cameras(path: &Path, bytes: &[u8]) -> Result<Cameras> {
    let mut cameras = Cameras::new();
    for line in records(path, bytes)? {
        let mut words = line.text.split_ascii_whitespace();
        let id: u32 = line.number(words.next(), "a camera id")?;
        if cameras.insert(id, camera_of(line, words)).is_some() {
            return Err(line.error("each camera id once", format!("{id} again")));
        }
    }
    if cameras.is_empty() {
        return Err(Error::format(path, "at least one camera", "none"));
    }
    Ok(cameras)
}

/// The camera of a line, from the words after its id.
fn camera_of(line: Line<'_>, mut words: SplitAsciiWhitespace<'_>) -> Result<ColmapCamera> {
    let model = words.next().unwrap_or("");
    let Some(&(model, count)) = MODELS.iter().find(|m| m.0 == model) else {
        return Err(line.error(super::MODELS_READ, format!("`{}`", shown(model))));
    };
    let size = [
        line.number(words.next(), "a width in pixels")?,
        line.number(words.next(), "a height in pixels")?,
    ];
    let parameters =
        words.map(|w| line.number(Some(w), "a camera parameter")).collect::<Result<Vec<f64>>>()?;
    if parameters.len() != count {
        let expected = format!("{count} parameters of {model}");
        return Err(line.error(expected, parameters.len().to_string()));
    }
    camera(model, size, &parameters).map_err(|r| line.error(r.expected, r.got))
}

/// Parses the point ids of a line of X Y POINT3D_ID triples; `None` for another line.
fn observations(text: &str) -> Option<Vec<u64>> {
    let mut words = text.split_ascii_whitespace();
    let mut points = Vec::new();
    while let Some(x) = words.next() {
        x.parse::<f64>().ok()?;
        words.next()?.parse::<f64>().ok()?;
        // −1 means no point.
        if let Ok(id) = u64::try_from(words.next()?.parse::<i64>().ok()?) {
            points.push(id);
        }
    }
    Some(points)
}

/// Reads `images.txt`; `path` is for messages. A picture without its second line gives a
/// warning.
///
/// # Errors
/// A line that does not parse.
pub fn parse_images(
    path: impl AsRef<Path>,
    bytes: &[u8],
    warnings: &mut Vec<String>,
) -> Result<Vec<ColmapImage>> {
    images(path.as_ref(), &utf8(bytes), warnings)
}

fn images(path: &Path, bytes: &[u8], warnings: &mut Vec<String>) -> Result<Vec<ColmapImage>> {
    let lines = lines(path, bytes)?;
    let mut images = Vec::new();
    let mut without = 0;
    let mut i = 0;
    while i < lines.len() {
        let line = lines[i];
        i += 1;
        if line.text.is_empty() || line.text.starts_with('#') {
            continue;
        }
        let mut image = image(line)?;
        // An empty line or the end of the file is an empty list.
        if let Some(next) = lines.get(i) {
            match observations(next.text) {
                Some(points) => {
                    image.points = points;
                    i += 1;
                }
                None if self::image(*next).is_ok() => without += 1,
                None => {
                    return Err(
                        next.error("triples of X Y POINT3D_ID", format!("`{}`", shown(next.text)))
                    );
                }
            }
        }
        images.push(image);
    }
    if without > 0 {
        warnings.push(format!("{}: {without} images have no line of points", path.display()));
    }
    Ok(images)
}

fn image(line: Line<'_>) -> Result<ColmapImage> {
    let mut words = line.text.split_ascii_whitespace();
    line.number::<u32>(words.next(), "an image id")?;
    let q = line.numbers::<4>(&mut words, "a quaternion QW QX QY QZ")?;
    let t = line.numbers::<3>(&mut words, "a translation TX TY TZ")?;
    let camera = line.number(words.next(), "a camera id")?;
    // A name may contain runs of spaces.

    let mut rest = line.text;
    for _ in 0..9 {
        rest = rest.trim_start();
        rest = &rest[rest.find(char::is_whitespace).unwrap_or(rest.len())..];
    }
    let name = rest.trim_start().to_owned();
    if name.is_empty() {
        return Err(line.error("a picture name", "the end of the line"));
    }
    let found = pose(q, t);
    let (rotation, translation) = found.clone().unwrap_or_default();
    let (refused, place, points) = (found.err(), format!(":{}", line.number), Vec::new());
    Ok(ColmapImage { place, rotation, translation, refused, camera, name, points })
}

/// Reads `points3D.txt`; `path` is for messages. A position may be no finite number.
///
/// # Errors
/// A line that does not parse.
pub fn parse_points(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Points> {
    points(path.as_ref(), &utf8(bytes))
}

fn points(path: &Path, bytes: &[u8]) -> Result<Points> {
    let mut points = Points::new();
    for line in records(path, bytes)? {
        let mut words = line.text.split_ascii_whitespace();
        let id = line.number(words.next(), "a point id")?;
        let p = DVec3::from_array(line.numbers::<3>(&mut words, "a position X Y Z")?);
        points.push((id, p));
    }
    Ok(points)
}
