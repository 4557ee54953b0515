//! COLMAP's binary files, little-endian. Every count is compared with the remaining bytes,
//! and nothing may follow the last record.
//!
//! * `cameras.bin`: u64 n; n × {u32 id, i32 model, u64 width, u64 height, f64 × p}
//! * `images.bin`: u64 n; n × {u32 id, f64 × 4 wxyz, f64 × 3, u32 camera, name\0,
//!   u64 m, m × {f64 x, f64 y, u64 point id or 2⁶⁴ − 1}}
//! * `points3D.bin`: u64 n; n × {u64 id, f64 × 3, u8 × 3 RGB, f64 error, u64 m,
//!   m × {u32 image, u32 index}}

use super::{Cameras, ColmapImage, MODELS, Points, camera, pose};
use crate::files::{Error, Result};
use glam::DVec3;
use std::path::Path;

/// Id of an observation without a point.
const NO_POINT: u64 = u64::MAX;
/// Longest name, bytes: file systems allow no longer one.
const NAME_MAX: usize = 4096;

/// A position in the bytes of a file.
struct Cursor<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    fn error(&self, expected: impl Into<String>, got: impl Into<String>) -> Error {
        Error::format(self.path, expected, got).at(format!(" at byte {}", self.at))
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn take(&mut self, n: usize, what: &str) -> Result<&'a [u8]> {
        let Some(taken) = self.at.checked_add(n).and_then(|end| self.bytes.get(self.at..end))
        else {
            return Err(self.error(format!("{n} bytes of {what}"), format!("{} left", self.left())));
        };
        self.at += n;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, what)?);
        Ok(array)
    }

    fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    fn u64(&mut self, what: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for v in &mut values {
            *v = self.f64(what)?;
        }
        Ok(values)
    }

    /// Reads a count of records of at least `least` bytes each, all of which must fit.
    fn count(&mut self, least: usize, what: &str) -> Result<usize> {
        let start = self.at;
        let n = self.u64(what)?;
        let most = self.left() / least;
        if n > most as u64 {
            let at = format!(" at byte {start}");
            let expected = format!("at most {most} {what} (by the file's length)");
            return Err(Error::format(self.path, expected, n.to_string()).at(at));
        }
        Ok(n as usize)
    }

    fn name(&mut self) -> Result<&'a str> {
        let rest = &self.bytes[self.at..];
        let rest = &rest[..rest.len().min(NAME_MAX)];
        let Some(length) = rest.iter().position(|b| *b == 0) else {
            let expected = format!("a picture name that ends within {NAME_MAX} bytes");
            return Err(self.error(expected, "no end"));
        };
        let name = std::str::from_utf8(&rest[..length])
            .map_err(|e| self.error("a picture name in UTF-8", e.to_string()))?;
        if name.is_empty() {
            return Err(self.error("a picture name", "an empty one"));
        }
        self.at += length + 1;
        Ok(name)
    }

    fn end(&self) -> Result<()> {
        match self.left() {
            0 => Ok(()),
            n => Err(self.error("the end of the file", format!("{n} more bytes"))),
        }
    }
}

/// Reads `cameras.bin`; `path` is for messages.
///
/// # Errors
/// Truncated, a camera model of no known number. A model that is not read, and parameters that are not
/// finite, are errors of that camera.
pub fn parse_cameras(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Cameras> {
    cameras(path.as_ref(), bytes)
}

fn cameras(path: &Path, bytes: &[u8]) -> Result<Cameras> {
    let mut c = Cursor { path, bytes, at: 0 };
    // A record has 24 bytes and at least three parameters.
    let n = c.count(48, "cameras")?;
    let mut cameras = Cameras::with_capacity(n);
    for _ in 0..n {
        let start = c.at;
        let at = |e: Error| e.at(format!(" at byte {start}"));
        let id = c.u32("a camera id")?;
        let model = c.u32("a camera model")?;
        let size = [c.u64("a width")?, c.u64("a height")?];
        let Some(&(name, count)) = MODELS.get(model as usize) else {
            return Err(at(c.error(super::MODELS_READ, format!("model number {model}"))));
        };
        let parameters =
            (0..count).map(|_| c.f64("a camera parameter")).collect::<Result<Vec<_>>>()?;
        let camera = camera(name, size, &parameters).map_err(|r| at(c.error(r.expected, r.got)));

        if cameras.insert(id, camera).is_some() {
            return Err(at(c.error("each camera id once", format!("{id} again"))));
        }
    }
    c.end()?;
    Ok(cameras)
}

/// Reads `images.bin`; `path` is for messages.
///
/// # Errors
/// Truncated, a name that is not UTF-8.
pub fn parse_images(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Vec<ColmapImage>> {
    images(path.as_ref(), bytes)
}

fn images(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapImage>> {
    let mut c = Cursor { path, bytes, at: 0 };
    // A record has 64 bytes, a name of at least two bytes, and a count.
    let n = c.count(74, "images")?;
    let mut images = Vec::with_capacity(n);
    for _ in 0..n {
        let place = format!(" at byte {}", c.at);
        c.u32("an image id")?;
        let q = c.f64s::<4>("a quaternion")?;
        let t = c.f64s::<3>("a translation")?;
        let camera = c.u32("a camera id")?;
        let name = c.name()?.to_owned();
        let found = pose(q, t);
        let (rotation, translation) = found.clone().unwrap_or_default();
        let observations = c.count(24, "observations")?;
        let mut points = Vec::new();
        for _ in 0..observations {
            c.take(16, "an observation's position")?;
            let id = c.u64("a point id")?;
            if id != NO_POINT {
                points.push(id);
            }
        }
        let refused = found.err();
        images.push(ColmapImage { place, rotation, translation, refused, camera, name, points });
    }
    c.end()?;
    Ok(images)
}

/// Reads `points3D.bin`; `path` is for messages. A position may be no finite number.
///
/// # Errors
/// Truncated.
pub fn parse_points(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Points> {
    points(path.as_ref(), bytes)
}

fn points(path: &Path, bytes: &[u8]) -> Result<Points> {
    let mut c = Cursor { path, bytes, at: 0 };
    let n = c.count(51, "points")?;
    let mut points = Points::with_capacity(n);
    for _ in 0..n {
        let id = c.u64("a point id")?;
        let p = DVec3::from_array(c.f64s::<3>("a position")?);
        c.take(3, "a colour")?;
        c.f64("an error")?;
        let track = c.count(8, "track entries")?;
        c.take(8 * track, "a track")?;
        points.push((id, p));
    }
    c.end()?;
    Ok(points)
}
