//! RealityCapture's and RealityScan's table of cameras ("Internal/External camera parameters"): a .csv whose
//! header names its columns, `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`.
//!
//! The pose is camera-to-world with the axes right, up, backward: the position x, y, alt, and the rotation
//! Rz(−heading)·Rx(pitch)·Ry(roll), degrees. `f` is the focal length for a film of 36 mm along the picture's larger
//! side, px and py are the principal point's offset from the middle in units of that side. The radial factor is
//! 1 + k1·r² + … + k4·r⁸, t1 and t2 are OpenCV's p1 and p2. Columns from px on may be missing. The file has no
//! sizes: those of the pictures are read.
//!
//! Sources: nerfstudio, `process_data/realitycapture_utils.py` and its pull request 3131; the rotation agrees with
//! the XMP matrix and the angles that one user published of one camera (forums.unrealengine.com, "Different rotation
//! of cameras in XMP and CSV").

use super::assemble::{Draft, Lens, assemble};
use super::json::utf8;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use super::transforms::opengl_to_opencv;
use crate::files::photos::distortion::Distortion;
use crate::files::{Error, Result, first_bytes, read};
use csv::StringRecord;
use glam::{DMat3, DMat4, DVec3};
use std::path::Path;

/// Columns without which a row is no camera.
const NEEDED: [&str; 8] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
/// Columns that may be missing.
const MORE: [&str; 8] = ["px", "py", "k1", "k2", "k3", "k4", "t1", "t2"];
/// Bytes from the start of a file in which the header lies.
const START: usize = 4096;
/// Width of the film to which the focal length belongs, mm.
const FILM: f64 = 36.0;

/// A row of the table.
#[derive(Clone, Debug, PartialEq)]
pub struct RealityCaptureCamera {
    /// Position in the world.
    pub position: DVec3,
    /// Heading, pitch and roll, degrees.
    pub angles: [f64; 3],
    /// Focal length for a film of 36 mm, mm.
    pub focal: f64,
    /// Offset of the principal point from the middle, in units of the picture's larger side.
    pub center: [f64; 2],
    /// Lens distortion.
    pub distortion: Distortion,
}

/// A row with its line and the name of its picture.
#[derive(Debug)]
pub struct RealityCaptureRow {
    /// Line of the file, from 1.
    pub line: u64,
    /// Path of the picture.
    pub name: String,
    /// The camera; an error where the row has none.
    pub camera: Result<RealityCaptureCamera>,
}

/// Columns of a header.
struct Header {
    needed: [usize; 8],
    more: [Option<usize>; 8],
}

impl Header {
    /// The columns of a record; `None` where one that is needed is missing.
    fn of(record: &StringRecord) -> Option<Self> {
        let names: Vec<String> = record
            .iter()
            .map(|name| name.trim_start_matches('#').trim().to_ascii_lowercase())
            .collect();
        let column = |name: &str| names.iter().position(|own| own == name);
        let needed: Option<Vec<usize>> = NEEDED.iter().map(|name| column(name)).collect();
        Some(Self { needed: needed?.try_into().ok()?, more: MORE.map(column) })
    }
}

/// Reports whether a file begins with the header of such a table.
pub(super) fn is_table(path: &Path) -> bool {
    let start = first_bytes(path, START).unwrap_or_default();
    records(&utf8(&start)).iter().any(|record| Header::of(record).is_some())
}

/// Number of rows; 0 where the file cannot be read.
pub(super) fn count(path: &Path) -> usize {
    read(path).and_then(|bytes| parse(path, &bytes)).map_or(0, |rows| rows.len())
}

/// The records of a table, of any length each. Bytes that are no UTF-8 become U+FFFD.
fn records(bytes: &[u8]) -> Vec<StringRecord> {
    let mut builder = csv::ReaderBuilder::new();
    builder.has_headers(false).flexible(true).trim(csv::Trim::All);
    let text = String::from_utf8_lossy(bytes);
    // Nothing that is text is an error of a flexible reader.
    builder.from_reader(text.as_bytes()).into_records().filter_map(|record| record.ok()).collect()
}

/// Reads a table; `path` is for messages.
///
/// # Errors
/// No header with the columns that are needed. What is wrong with one row is the error of that row.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<Vec<RealityCaptureRow>> {
    rows(path.as_ref(), bytes)
}

fn rows(path: &Path, bytes: &[u8]) -> Result<Vec<RealityCaptureRow>> {
    let mut records = records(&utf8(bytes)).into_iter();
    let Some(header) = records.find_map(|record| Header::of(&record)) else {
        let expected = format!("a header with {}", NEEDED.join(","));
        return Err(Error::format(path, expected, "none"));
    };
    let row = |record: StringRecord| {
        let line = record.position().map_or(0, csv::Position::line);
        let name = record.get(header.needed[0]).unwrap_or_default().to_owned();
        RealityCaptureRow { line, name, camera: camera(path, line, &header, &record) }
    };
    Ok(records.map(row).collect())
}

fn camera(
    path: &Path,
    line: u64,
    header: &Header,
    record: &StringRecord,
) -> Result<RealityCaptureCamera> {
    let number = |name: &str, column: usize| {
        let text = record.get(column).unwrap_or_default();
        text.parse::<f64>().ok().filter(|value| value.is_finite()).ok_or_else(|| {
            let start: String = text.chars().take(40).collect();
            let expected = format!("a finite number `{name}`");
            Error::format(path, expected, format!("`{start}`")).at(format!(":{line}"))
        })
    };
    let mut needed = [0.0; 8];
    for (i, value) in needed.iter_mut().enumerate().skip(1) {
        *value = number(NEEDED[i], header.needed[i])?;
    }
    let mut more = [0.0; 8];
    for (i, value) in more.iter_mut().enumerate() {
        *value = header.more[i].map_or(Ok(0.0), |column| number(MORE[i], column))?;
    }
    let [_, x, y, alt, heading, pitch, roll, focal] = needed;
    let [px, py, k1, k2, k3, k4, t1, t2] = more;
    Ok(RealityCaptureCamera {
        position: DVec3::new(x, y, alt),
        angles: [heading, pitch, roll],
        focal,
        center: [px, py],
        distortion: Distortion::polynomial([k1, k2, k3, k4], [t1, t2], 0.0),
    })
}

impl RealityCaptureCamera {
    /// OpenCV camera-to-world.
    pub fn world_from_camera(&self) -> DMat4 {
        let [heading, pitch, roll] = self.angles.map(f64::to_radians);
        let rotation = DMat3::from_rotation_z(-heading)
            * DMat3::from_rotation_x(pitch)
            * DMat3::from_rotation_y(roll);
        opengl_to_opencv(DMat4::from_mat3_translation(rotation, self.position))
    }
}

/// Reads a table. Pictures may lie beside the file, in its parent, and in an `images` folder of either.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let rows = parse(path, &read(path)?)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let roots = [folder, folder.parent().unwrap_or(folder)];
    let drafts = rows.into_iter().map(|row| {
        let RealityCaptureRow { line, name, camera } = row;
        let camera = match camera {
            Ok(camera) => camera,
            Err(error) => return Draft::refused(name, error),
        };
        let [x, y] = camera.center;
        let lens = Lens::LargerSide([camera.focal / FILM, x, y]);
        let pose = camera.world_from_camera();
        Draft {
            image: reading.find(&roots, &name),
            distortion: camera.distortion,
            ..Draft::new(format!(":{line}"), name, lens, pose)
        }
    });
    let drafts: Vec<Draft> = drafts.collect();
    assemble(path, SceneFormat::RealityCapture, &reading.needed(), drafts)
}
