//! Reads pixelSplat's data sets, which MVSplat and its successors use for training and evaluation.
//!
//! A data set is `{root}/{train,test}/NNNNNN.torch`, each a list of examples, and `index.json`,
//! which maps keys to files.
//!
//! An example is a video: `key`, `url`, `timestamps` int64 `[N]`, `cameras` float32 `[N, 18]` and
//! `images`, N encoded pictures as 1-D uint8 tensors (JPEG; PNG for DTU). A row of `cameras` holds
//! fx, fy, cx, cy over the picture's width and height, two numbers that pixelSplat ignores, and the
//! row-major 3×4 matrix camera-from-world with OpenCV axes. The reader converts it to the crate's
//! `world_from_camera`.
//!
//! The reader executes nothing in a chunk ([`subsplat::files::weights::torch`]). Pictures are read one at a time,
//! so that opening a chunk of 100 MB needs memory for its list of frames only.

use glam::{DMat4, DVec4, Mat4};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat::files::photos::image::parse_picture;
use subsplat::files::weights::torch::{TensorRef, TorchDtype, TorchFile, Value};
use subsplat::files::{Error, Result, read};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, CameraError, Intrinsics};

/// Number of columns of `cameras`.
const COLUMNS: usize = 18;

/// The camera of a frame, independent of the picture's size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkCamera {
    /// fx, fy, cx, cy over the picture's width and height.
    pub normalised: [f32; 4],
    /// Rigid pose: the inverse of the row's matrix.
    pub world_from_camera: Mat4,
}

impl ChunkCamera {
    /// Returns the camera of a picture of `width` × `height` pixels.
    ///
    /// # Errors
    /// Those of [`Camera::new`].
    pub fn camera(&self, width: usize, height: usize) -> std::result::Result<Camera, CameraError> {
        let intrinsics = Intrinsics::from_normalised(self.normalised, width, height);
        Camera::new(intrinsics, self.world_from_camera)
    }

    /// Converts a row of `cameras`; `Err` holds the reason of a refusal.
    fn from_row(row: &[f32; COLUMNS]) -> std::result::Result<Self, String> {
        let [fx, fy, cx, cy, _, _, m @ ..] = row.map(f64::from);
        let [a, b, c, d, e, f, g, h, i, j, k, l] = m;
        let rows = DMat4::from_cols(
            DVec4::new(a, b, c, d),
            DVec4::new(e, f, g, h),
            DVec4::new(i, j, k, l),
            DVec4::W,
        );
        // `Camera::new` reports NaN and infinity.
        let pose = rows.transpose().inverse().as_mat4();
        let normalised = [fx, fy, cx, cy].map(|v| v as f32);
        let unit = Intrinsics::from_normalised(normalised, 1, 1);
        let camera = Camera::new(unit, pose).map_err(|e| e.to_string())?;
        Ok(Self { normalised, world_from_camera: camera.world_from_camera() })
    }
}

/// One video of a chunk.
#[derive(Clone, Debug)]
pub struct Example {
    /// Key in the data set.
    pub key: String,
    /// Address of the video; may be empty.
    pub url: String,
    /// One timestamp per frame, microseconds.
    pub timestamps: Vec<i64>,
    /// One camera per frame.
    pub cameras: Vec<ChunkCamera>,
    images: Vec<Arc<TensorRef>>,
}

impl Example {
    /// Returns the number of frames.
    pub fn frames(&self) -> usize {
        self.cameras.len()
    }
}

/// An open chunk.
#[derive(Debug)]
pub struct Chunk {
    file: TorchFile,
    examples: Vec<Example>,
}

impl Chunk {
    /// Opens `NNNNNN.torch` and reads everything except the pictures.
    ///
    /// # Errors
    /// Files that [`TorchFile::open`] refuses; an example without one of its parts; parts of
    /// different numbers of frames; an invalid camera.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Self::from_file(TorchFile::open(path)?)
    }

    /// Parses a chunk from memory; messages contain `name`.
    ///
    /// # Errors
    /// As [`Chunk::open`].
    pub fn parse(bytes: impl Into<Arc<[u8]>>, name: impl AsRef<Path>) -> Result<Self> {
        Self::from_file(TorchFile::parse(bytes, name)?)
    }

    /// Reads the list of examples.
    fn from_file(file: TorchFile) -> Result<Self> {
        let Value::List(rows) = file.root() else {
            let got = file.root().kind();
            return Err(Error::format(file.path(), "a chunk: a list of examples", got));
        };
        let examples = rows.iter().enumerate().map(|(i, row)| example(&file, i, row));
        let examples = examples.collect::<Result<Vec<_>>>()?;
        Ok(Self { file, examples })
    }

    /// Returns the examples in the file's order.
    pub fn examples(&self) -> &[Example] {
        &self.examples
    }

    /// Finds the example of a key.
    pub fn find(&self, key: &str) -> Option<&Example> {
        self.examples.iter().find(|e| e.key == key)
    }

    /// Reads the encoded picture of one frame of an example of this chunk.
    ///
    /// # Errors
    /// A frame out of range; a file that has changed since it was opened.
    pub fn encoded(&self, example: &Example, frame: usize) -> Result<Vec<u8>> {
        let Some(image) = example.images.get(frame) else {
            let expected = format!("a frame below {}", example.images.len());
            let place = format!(" example `{}`", example.key);
            return Err(Error::format(self.file.path(), expected, frame.to_string()).at(place));
        };
        self.file.read(image)
    }

    /// Reads and decodes the picture of one frame and returns it with its camera.
    ///
    /// # Errors
    /// As [`Chunk::encoded`]; a damaged picture.
    pub fn load(&self, example: &Example, frame: usize) -> Result<(Rgb, Camera)> {
        let bytes = self.encoded(example, frame)?;
        let picture = parse_picture(&bytes, self.file.path())
            .map_err(|e| e.at(format!(" example `{}` frame {frame}", example.key)))?;
        let Some(camera) = example.cameras.get(frame) else {
            return Err(Error::format(self.file.path(), "a camera for each picture", "none"));
        };
        let camera = camera.camera(picture.width, picture.height).map_err(|e| {
            Error::format(self.file.path(), "a valid camera", e.to_string())
                .at(format!(" example `{}` frame {frame}", example.key))
        })?;
        Ok((picture, camera))
    }
}

/// Reads example `i` of the file.
fn example(file: &TorchFile, i: usize, row: &Value) -> Result<Example> {
    let key = row.get("key").and_then(Value::as_str);
    let place = match key {
        Some(key) => format!(" example `{}`", key.escape_debug()),
        None => format!(" example {i}"),
    };
    let bad =
        |expected: String, got: String| Error::format(file.path(), expected, got).at(place.clone());
    let part = |name: &str| {
        row.get(name).ok_or_else(|| {
            let expected = "a dictionary of key, url, timestamps, cameras and images".to_owned();
            bad(expected, format!("{} without `{name}`", row.kind()))
        })
    };
    let Some(key) = part("key")?.as_str() else {
        return Err(bad("a text as `key`".to_owned(), part("key")?.kind()));
    };
    let table = |name: &str, dtype: TorchDtype, columns: Option<usize>| -> Result<Vec<u8>> {
        let value = part(name)?;
        let fits = |t: &&TensorRef| match (t.shape.as_slice(), columns) {
            ([_], None) => t.dtype == dtype,
            ([_, c], Some(columns)) => t.dtype == dtype && *c == columns,
            _ => false,
        };
        match value.as_tensor().filter(fits) {
            Some(t) => file.read(t),
            None => {
                let columns = columns.map_or(String::new(), |c| format!(", {c}"));
                let expected = format!("`{name}` as {} [frames{columns}]", dtype.name());
                Err(bad(expected, value.kind()))
            }
        }
    };
    let timestamps = table("timestamps", TorchDtype::I64, None)?;
    let timestamps: Vec<i64> =
        timestamps.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b)).collect();
    let rows = table("cameras", TorchDtype::F32, Some(COLUMNS))?;
    let numbers: Vec<f32> =
        rows.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let cameras = numbers.as_chunks::<COLUMNS>().0.iter().enumerate().map(|(frame, row)| {
        ChunkCamera::from_row(row).map_err(|e| {
            let place = format!("{place} frame {frame}");
            Error::format(file.path(), "a row of `cameras` with a rigid pose", e).at(place)
        })
    });
    let cameras = cameras.collect::<Result<Vec<_>>>()?;
    let images = pictures(part("images")?).map_err(|got| {
        bad("`images`, a list of encoded pictures (1-D uint8 tensors)".to_owned(), got)
    })?;
    if timestamps.len() != cameras.len() || images.len() != cameras.len() {
        let got = format!("{}, {} and {}", timestamps.len(), cameras.len(), images.len());
        return Err(bad("as many timestamps as cameras and images".to_owned(), got));
    }
    let url = row.get("url").and_then(Value::as_str).unwrap_or_default().to_owned();
    Ok(Example { key: key.to_owned(), url, timestamps, cameras, images })
}

/// Returns the tensors of the pictures; `Err` holds the kind of the invalid value.
fn pictures(value: &Value) -> std::result::Result<Vec<Arc<TensorRef>>, String> {
    let Value::List(items) = value else { return Err(value.kind()) };
    let picture = |(i, item): (usize, &Value)| match item {
        Value::Tensor(t) if t.dtype == TorchDtype::U8 && t.shape.len() == 1 => Ok(t.clone()),
        other => Err(format!("{} as picture {i}", other.kind())),
    };
    items.iter().enumerate().map(picture).collect()
}

/// Reads `index.json` of a folder of chunks: the file of each key.
///
/// # Errors
/// A missing file; content other than an object of strings; a file name outside the folder.
pub fn load_index(folder: impl AsRef<Path>) -> Result<BTreeMap<String, PathBuf>> {
    read_index(folder.as_ref())
}

fn read_index(folder: &Path) -> Result<BTreeMap<String, PathBuf>> {
    let path = folder.join("index.json");
    let names: BTreeMap<String, String> = serde_json::from_slice(&read(&path)?).map_err(|e| {
        Error::format(&path, "an object from keys to names of chunks", e.to_string())
    })?;
    let inside = |(key, name): (String, String)| {
        let plain = Path::new(&name).file_name().is_some_and(|n| n == name.as_str());
        if !plain || name.contains('\\') {
            let got = format!("`{}`", name.escape_debug());
            return Err(Error::format(&path, "names of files in the index's folder", got));
        }
        let file = folder.join(name);
        Ok((key, file))
    };
    names.into_iter().map(inside).collect()
}
