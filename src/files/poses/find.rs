//! The scene of a folder: every pose file in it, or one level below, by content. The first kind of this
//! list that a folder has is read, of several COLMAP models the largest; a line names what is not read.
//!
//! 1. `cameras.json`, `transforms.json`, `transforms_train.json` (NeRF's synthetic scenes)
//! 2. COLMAP models in `sparse`, `colmap/sparse`, the folder itself and `dense`, and in their numbered folders
//! 3. a RealEstate10K txt
//! 4. `poses.txt` with `K.txt`

use super::assemble::entries;
use super::{colmap, re10k};
use crate::files::photos::photograph::list_photographs;
use crate::files::{Result, read};
use std::path::{Path, PathBuf};

/// JSON files with cameras, in the order of preference; the others are parts of the same scene.
const JSON_FILES: [&str; 5] = [
    "cameras.json",
    "transforms.json",
    "transforms_train.json",
    "transforms_val.json",
    "transforms_test.json",
];
/// Folders in which COLMAP models may lie, themselves or in numbered folders of theirs.
const MODEL_FOLDERS: [&str; 4] = ["sparse", "colmap/sparse", "", "dense"];
/// Cameras in layouts that are not read: file or folder, and its maker.
const NOT_READ: [(&str, &str); 9] = [
    ("keyframes/corrected_cameras", "Polycam's raw data"),
    ("keyframes/cameras", "Polycam's raw data"),
    ("corrected_cameras", "Polycam's raw data"),
    ("poses_bounds.npy", "LLFF's poses"),
    ("reconstruction.json", "OpenSfM's reconstruction"),
    ("bundle.out", "Bundler's cameras"),
    ("metadata.json", "Record3D's metadata"),
    ("camera_path.json", "a path of nerfstudio's viewer"),
    ("project.files", "a Metashape project"),
];
/// Most folders that are searched one level below.
const FOLDERS_MAX: usize = 200;
/// File that `subsplat run` writes beside the pictures that it renders, and words that it has.
const OWN_REPORT: (&str, [&str; 3]) =
    ("metrics.json", ["\"peak_memory_bytes\"", "\"gaussians\"", "\"near_far_from\""]);

/// Pose file of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum PoseFile {
    /// `cameras.json` or `transforms.json`.
    Json(PathBuf),
    /// Folder of a COLMAP model.
    Colmap(PathBuf),
    /// File of RealEstate10K.
    Re10k(PathBuf),
    /// Folder of `poses.txt`.
    Matrices(PathBuf),
}

impl PoseFile {
    /// Number of cameras, 0 where it is not known. Reads the file.
    fn cameras(&self) -> usize {
        match self {
            Self::Json(path) => cameras_of_json(path, true).unwrap_or(0),
            Self::Colmap(folder) => colmap::count_images(folder),
            Self::Re10k(_) | Self::Matrices(_) => 0,
        }
    }

    fn path(&self) -> &Path {
        match self {
            Self::Json(path) | Self::Colmap(path) | Self::Re10k(path) | Self::Matrices(path) => {
                path
            }
        }
    }
}

/// A pose file that can be read.
#[derive(Clone, Debug)]
struct Candidate {
    file: PoseFile,
    part: Part,
}

/// Pose files of the same kind have different cameras of one place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    /// A file that has all cameras.
    Whole(&'static str),
    /// One of `transforms_*.json`.
    Transforms,
    /// One of several COLMAP models.
    Colmap,
}

/// The pose file of a folder that is read, and lines about what else is there.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub file: PoseFile,
    pub notes: Vec<String>,
}

/// The scene of `folder`, or of the folders below it where `folder` has neither cameras nor photographs.
///
/// # Errors
/// A folder that cannot be read.
pub(super) fn find(folder: &Path) -> Result<Option<Found>> {
    if let Some(own) = find_in(folder)? {
        return Ok(Some(own));
    }
    if !list_photographs(folder).is_empty() {
        return Ok(None);
    }
    let mut below = Vec::new();
    for folder in folders(folder).iter().filter(|folder| !is_own_output(folder)) {
        below.extend(candidates(folder)?);
    }
    // The largest, the first of several.
    if below.len() > 1 {
        below.sort_by_cached_key(|candidate| std::cmp::Reverse(candidate.file.cameras()));
    }
    let mut below = below.into_iter();
    let Some(first) = below.next() else { return Ok(None) };
    let mut found = chosen(folder, first, below.collect());
    let read = name(folder, found.file.path());
    found.notes.insert(0, format!("the scene is read from {read}, below the folder"));
    Ok(Some(found))
}

/// The scene of `folder` itself.
///
/// # Errors
/// A folder that cannot be read.
pub(super) fn find_in(folder: &Path) -> Result<Option<Found>> {
    let mut own = candidates(folder)?.into_iter();
    let Some(first) = own.next() else { return Ok(None) };
    // Another format usually has the same cameras.
    let others = own.filter(|other| other.part == first.part).collect();
    Ok(Some(chosen(folder, first, others)))
}

/// A line about cameras in `folder` in a layout that is not read.
pub fn not_read(folder: impl AsRef<Path>) -> Option<String> {
    cameras_not_read(folder.as_ref())
}

fn cameras_not_read(folder: &Path) -> Option<String> {
    let is_list = |file: &str| {
        let start = read(folder.join(file)).unwrap_or_default();
        start.iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'[')
    };
    let there = NOT_READ
        .iter()
        .find(|(path, _)| folder.join(path).exists())
        .map(|(path, maker)| format!("{path} ({maker})"));
    let list = JSON_FILES[1..].iter().find(|file| is_list(file));
    let list = list.map(|file| format!("{file} (a list of poses without focal lengths)"));
    let cameras = list.or(there)?;
    Some(format!(
        "{}: cameras in {cameras} are not read: export them as COLMAP or as transforms.json",
        folder.display()
    ))
}

/// Reports whether `subsplat run` wrote the folder: its pictures are rendered, not photographs.
pub fn is_own_output(folder: impl AsRef<Path>) -> bool {
    let (file, words) = OWN_REPORT;
    let report = std::fs::read_to_string(folder.as_ref().join(file)).unwrap_or_default();
    words.iter().all(|word| report.contains(word))
}

/// The folders in `folder` by name, 200 at most, without hidden ones.
pub fn folders(folder: impl AsRef<Path>) -> Vec<PathBuf> {
    folders_in(folder.as_ref())
}

fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let mut all = entries(folder);
    all.retain(|path| path.is_dir());
    all.sort();
    all.truncate(FOLDERS_MAX);
    all
}

/// The pose files of a folder, the one to read first. Files are read where their content decides alone.
fn candidates(folder: &Path) -> Result<Vec<Candidate>> {
    let mut all = Vec::new();
    let mut add = |file: PoseFile, part: Part| all.push(Candidate { file, part });
    for file in JSON_FILES {
        let path = folder.join(file);
        // A malformed file of the first two names is an error of its reader.
        let whole = file == "cameras.json" || file == "transforms.json";
        if path.is_file() && (whole || cameras_of_json(&path, false).is_some()) {
            add(PoseFile::Json(path), if whole { Part::Whole(file) } else { Part::Transforms });
        }
    }
    let mut models: Vec<PathBuf> =
        MODEL_FOLDERS.iter().flat_map(|base| models(&folder.join(base), base.is_empty())).collect();
    if models.len() > 1 {
        models.sort_by_cached_key(|model| std::cmp::Reverse(colmap::count_images(model)));
    }
    models.into_iter().for_each(|model| add(PoseFile::Colmap(model), Part::Colmap));
    if let Some(path) = re10k::find(folder)? {
        add(PoseFile::Re10k(path), Part::Whole("txt"));
    }
    if folder.join("poses.txt").is_file() {
        add(PoseFile::Matrices(folder.to_owned()), Part::Whole("poses.txt"));
    }
    Ok(all)
}

/// COLMAP models in `base`: itself, and those of its numbered folders where it is not the scene's own
/// (`alone`).
fn models(base: &Path, alone: bool) -> Vec<PathBuf> {
    let numbered = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.chars().all(|c| c.is_ascii_digit())
    };
    let below = if alone { Vec::new() } else { folders(base) };
    let below =
        below.into_iter().filter(numbered).flat_map(|path| [path.clone(), path.join("sparse")]);
    let all = std::iter::once(base.to_owned()).chain(below);
    all.filter(|path| colmap::is_model(path)).collect()
}

/// Number of cameras of a JSON file: of an object with frames, or of a list where `lists`.
fn cameras_of_json(path: &Path, lists: bool) -> Option<usize> {
    let value = super::json::value(&read(path).ok()?).ok()?;
    let frames = value.get("frames").and_then(|frames| frames.as_array());
    frames.or(value.as_array().filter(|_| lists)).map(Vec::len)
}

/// The candidate `first`, and a line that names the `others`.
fn chosen(folder: &Path, first: Candidate, others: Vec<Candidate>) -> Found {
    let named = |other: Candidate| {
        let name = name(folder, other.file.path());
        match other.file.cameras() {
            0 => name,
            cameras => format!("{name} ({cameras} cameras)"),
        }
    };
    let others: Vec<String> = others.into_iter().map(named).collect();
    let file = first.file;
    let notes = if others.is_empty() {
        Vec::new()
    } else {
        let read = name(folder, file.path());
        vec![format!("cameras come from {read}; not read: {}", others.join(", "))]
    };
    Found { file, notes }
}

/// `path` as seen from `folder`.
fn name(folder: &Path, path: &Path) -> String {
    let inside = path.strip_prefix(folder).unwrap_or(path);
    let inside = if inside.as_os_str().is_empty() { Path::new(".") } else { inside };
    inside.display().to_string()
}
