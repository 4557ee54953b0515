//! The scene of a folder: every pose file in it, or one level below, by content. The first kind of this
//! list that a folder has is read, of several COLMAP models the largest. A line names the others of the same
//! kind, and those of another kind with more cameras. A file that cannot be read, or none of whose pictures is
//! found, gives a line, and the next one is read (`load.rs`).
//!
//! 1. `cameras.json`, `transforms.json`, `transforms_train.json` (NeRF's synthetic scenes)
//! 2. COLMAP models in `sparse`, `colmap/sparse`, the folder itself and `dense`, and in their numbered folders
//! 3. a RealEstate10K txt
//! 4. `poses.txt` with `K.txt`
//! 5. the cameras of OpenSfM, Polycam, Record3D, Bundler, LLFF, Metashape (XML) and RealityCapture (CSV)
//! 6. those of OpenMVG, Meshroom, 3D Scanner App, MVSNet, NeuS, and a matrix file of each picture (ScanNet, 7-Scenes,
//!    NSVF, NeRF++)
//! 7. a list of `ns-export cameras` where the pictures state their focal lengths
//! 8. a JSON file of any other name with the content of one of the files above
//!
//! `not_read.rs` names cameras in other layouts.

use super::assemble::{entries, files};
pub use super::not_read::not_read;
use super::{
    bundler, colmap, llff, matrix_files, meshroom, metashape, mvsnet, nerfstudio, neus, openmvg,
    opensfm, polycam, re10k, reality_capture, scanner_app,
};
use crate::files::photos::photograph::list_photographs;
use crate::files::{Result, lower_extension, read};
use std::path::{Path, PathBuf};

/// JSON files with cameras, in the order of preference; the others are parts of the same scene.
pub(super) const JSON_FILES: [&str; 6] = [
    "cameras.json",
    "transforms.json",
    "transforms_train.json",
    "transforms_val.json",
    "transforms_test.json",
    "transforms_eval.json",
];
/// Folders in which COLMAP models may lie, themselves or in numbered folders of theirs.
const MODEL_FOLDERS: [&str; 4] = ["sparse", "colmap/sparse", "", "dense"];
/// Files of Bundler, from the folder of the scene.
const BUNDLER_FILES: [&str; 3] = ["bundle.out", "bundle/bundle.out", "bundler/bundle.out"];
/// Files of OpenSfM, from the folder of the scene: its own, and OpenDroneMap's.
const OPENSFM_FILES: [&str; 2] = ["reconstruction.json", "opensfm/reconstruction.json"];
/// Files of Meshroom, from the folder of the scene, before any other with its extension.
const MESHROOM_FILES: [&str; 2] = ["cameras.sfm", "sfm.json"];
/// Folder of Meshroom's reconstructions, each in a folder of its own, from the folder of its project.
const MESHROOM_CACHE: &str = "MeshroomCache/StructureFromMotion";
/// Most JSON files of any name that are read in search of cameras, and the size of the largest, bytes.
const JSON_MAX: (usize, u64) = (40, 1 << 26);
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
    /// `images.txt` of a COLMAP model beside a binary one.
    ColmapText(PathBuf),
    /// File of RealEstate10K.
    Re10k(PathBuf),
    /// Folder of `poses.txt`.
    Matrices(PathBuf),
    /// `reconstruction.json` of OpenSfM.
    OpenSfm(PathBuf),
    /// Folder of Polycam's key frames.
    Polycam(PathBuf),
    /// Metadata of Record3D.
    Record3d(PathBuf),
    /// `bundle.out` of Bundler.
    Bundler(PathBuf),
    /// `poses_bounds.npy` of LLFF.
    Llff(PathBuf),
    /// XML of Metashape.
    Metashape(PathBuf),
    /// CSV of RealityCapture.
    RealityCapture(PathBuf),
    /// List or path of nerfstudio.
    Nerfstudio(PathBuf),
    /// `sfm_data.json` of OpenMVG.
    OpenMvg(PathBuf),
    /// Scene of Meshroom.
    Meshroom(PathBuf),
    /// Folder of 3D Scanner App.
    ScannerApp(PathBuf),
    /// Folder of MVSNet's cameras.
    MvsNet(PathBuf),
    /// Archive of NeuS.
    Neus(PathBuf),
    /// Folder with a matrix file of each picture.
    MatrixFiles(PathBuf),
}

impl PoseFile {
    /// Number of cameras, 0 where it is not known. Reads the file.
    fn cameras(&self) -> usize {
        match self {
            Self::Json(path) => cameras_of_json(path, true).unwrap_or(0),
            Self::Colmap(folder) => colmap::count_images(folder),
            Self::ColmapText(path) => colmap::count_images_txt(path),
            Self::Re10k(_) | Self::Matrices(_) => 0,
            Self::OpenSfm(path) => value_of(path).map_or(0, |value| opensfm::count(&value)),
            Self::Polycam(folder) => polycam::count(folder),
            Self::Record3d(path) => length_of(path, "poses"),
            Self::Bundler(path) => bundler::count(path),
            Self::Llff(path) => llff::count(path),
            Self::Metashape(path) => metashape::count(path),
            Self::RealityCapture(path) => reality_capture::count(path),
            Self::OpenMvg(path) => openmvg::count(path),
            Self::Meshroom(path) => meshroom::count(path),
            Self::ScannerApp(folder) => scanner_app::count(folder),
            Self::MvsNet(folder) => mvsnet::count(folder),
            Self::Neus(path) => neus::count(path),
            Self::MatrixFiles(folder) => matrix_files::count(folder),
            Self::Nerfstudio(path) => {
                cameras_of_json(path, true).unwrap_or_else(|| length_of(path, "camera_path"))
            }
        }
    }

    /// The path of the source as seen from `folder`, which [`SceneOptions::model`](super::reading::SceneOptions::model)
    /// reads again.
    fn name(&self, folder: &Path) -> String {
        let path = match self {
            Self::Matrices(path) => path.join("poses.txt"),
            Self::ScannerApp(path) => scanner_app::first(path).unwrap_or_else(|| path.clone()),
            Self::MatrixFiles(path) => matrix_files::first(path).unwrap_or_else(|| path.clone()),
            Self::Polycam(path) if path.join("keyframes").is_dir() => path.join("keyframes"),
            other => other.path().to_owned(),
        };
        name(folder, &path)
    }

    /// The file, or the folder of several.
    pub fn path(&self) -> &Path {
        match self {
            Self::Json(path) | Self::Colmap(path) | Self::Re10k(path) | Self::Matrices(path) => {
                path
            }
            Self::OpenSfm(path) | Self::Polycam(path) | Self::Record3d(path) => path,
            Self::Bundler(path) | Self::Llff(path) | Self::Nerfstudio(path) => path,
            Self::Metashape(path) | Self::RealityCapture(path) | Self::ColmapText(path) => path,
            Self::OpenMvg(path) | Self::Meshroom(path) | Self::ScannerApp(path) => path,
            Self::MvsNet(path) | Self::Neus(path) | Self::MatrixFiles(path) => path,
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
    pub file: Source,
    pub notes: Vec<String>,
    /// One of the lines names others with cameras of their own.
    pub names_others: bool,
    /// The others in the order of preference.
    pub others: Vec<Source>,
}

/// A pose file with its path below the scene's folder.
#[derive(Clone, Debug)]
pub(super) struct Source {
    pub file: PoseFile,
    pub name: String,
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
    let mut found = chosen(folder, first, below.collect(), |_| true);
    let read = &found.file.name;
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
    let others: Vec<Candidate> = own.collect();
    let count = if others.is_empty() { 0 } else { first.file.cameras() };
    let part = first.part;
    let worth_a_line =
        |other: &Candidate| other.part == part || (count > 0 && other.file.cameras() > count);
    Ok(Some(chosen(folder, first, others, worth_a_line)))
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
    let texts: Vec<PathBuf> =
        models.iter().filter_map(|model| colmap::second_text(model)).collect();
    models.into_iter().for_each(|model| add(PoseFile::Colmap(model), Part::Colmap));
    if let Some(path) = re10k::find(folder)? {
        add(PoseFile::Re10k(path), Part::Whole("txt"));
    }
    if folder.join("poses.txt").is_file() {
        add(PoseFile::Matrices(folder.to_owned()), Part::Whole("poses.txt"));
    }
    foreign(folder).into_iter().for_each(|(file, name)| add(file, Part::Whole(name)));
    texts.into_iter().for_each(|path| add(PoseFile::ColmapText(path), Part::Whole("images.txt")));
    if all.is_empty() {
        let file = any_json(folder).map(|file| Candidate { file, part: Part::Whole("json") });
        all.extend(file);
    }
    Ok(all)
}

/// Cameras of other programs in a folder, each with the name of its kind.
fn foreign(folder: &Path) -> Vec<(PoseFile, &'static str)> {
    let mut all = Vec::new();
    let paths = OPENSFM_FILES.map(|name| folder.join(name));
    if let Some(path) = paths.into_iter().find(|p| is_kind(p, &PoseFile::OpenSfm)) {
        all.push((PoseFile::OpenSfm(path), "OpenSfM"));
    }
    if polycam::count(folder) > 0 {
        all.push((PoseFile::Polycam(folder.to_owned()), "Polycam"));
    }
    let paths = ["metadata.json", "metadata"].map(|name| folder.join(name));
    if let Some(path) = paths.into_iter().find(|p| is_kind(p, &PoseFile::Record3d)) {
        all.push((PoseFile::Record3d(path), "Record3D"));
    }
    let paths = BUNDLER_FILES.map(|name| folder.join(name));
    if let Some(path) = paths.into_iter().find(|path| path.is_file()) {
        all.push((PoseFile::Bundler(path), "Bundler"));
    }
    let path = folder.join("poses_bounds.npy");
    if path.is_file() {
        all.push((PoseFile::Llff(path), "LLFF"));
    }
    let exports = by_content(folder, "xml", metashape::has_cameras, PoseFile::Metashape);
    all.extend(exports.into_iter().map(|file| (file, "Metashape")));
    let tables = by_content(folder, "csv", reality_capture::is_table, PoseFile::RealityCapture);
    all.extend(tables.into_iter().map(|file| (file, "RealityCapture")));
    all.extend(of_reconstructions(folder));
    let lists = JSON_FILES[1..].iter().map(|name| folder.join(name));
    let mut lists = lists.filter(|path| is_kind(path, &PoseFile::Nerfstudio));
    if let Some(path) = lists.find(|path| nerfstudio::has_focal_lengths(path)) {
        all.push((PoseFile::Nerfstudio(path), "nerfstudio"));
    }
    all
}

/// Cameras of OpenMVG, Meshroom, 3D Scanner App, MVSNet, NeuS and of matrix files, each with the name of its kind.
fn of_reconstructions(folder: &Path) -> Vec<(PoseFile, &'static str)> {
    let mut all = Vec::new();
    let paths = openmvg::FILES.map(|name| folder.join(name));
    if let Some(path) = paths.into_iter().find(|path| openmvg::count(path) > 0) {
        all.push((PoseFile::OpenMvg(path), "OpenMVG"));
    }
    let paths = MESHROOM_FILES.map(|name| folder.join(name));
    let named = paths.into_iter().find(|path| meshroom::has_cameras(path)).map(PoseFile::Meshroom);
    let below = folders(folder.join(MESHROOM_CACHE));
    let scenes = std::iter::once(folder).chain(below.iter().map(PathBuf::as_path));
    let scenes =
        scenes.flat_map(|f| by_content(f, "sfm", meshroom::has_cameras, PoseFile::Meshroom));
    let scenes: Vec<PoseFile> =
        scenes.filter(|scene| named.as_ref().is_none_or(|named| named != scene)).collect();
    all.extend(named.into_iter().chain(scenes).map(|file| (file, "Meshroom")));
    if scanner_app::count(folder) > 0 {
        all.push((PoseFile::ScannerApp(folder.to_owned()), "3D Scanner App"));
    }
    if let Some(cameras) = mvsnet::cameras_of(folder) {
        all.push((PoseFile::MvsNet(cameras), "MVSNet"));
    }
    let paths = neus::NAMES.map(|name| folder.join(name));
    if let Some(path) = paths.into_iter().find(|path| neus::count(path) > 0) {
        all.push((PoseFile::Neus(path), "NeuS"));
    }
    if matrix_files::is_scene(folder) {
        all.push((PoseFile::MatrixFiles(folder.to_owned()), "matrix files"));
    }
    all
}

/// Files of a folder with an extension and with the content of a kind: the one with most cameras first.
fn by_content(
    folder: &Path,
    extension: &str,
    is_kind: fn(&Path) -> bool,
    make: fn(PathBuf) -> PoseFile,
) -> Vec<PoseFile> {
    let mut all = files(folder);
    all.retain(|path| lower_extension(path) == extension);
    all.retain(|path| is_kind(path));
    let mut all: Vec<PoseFile> = all.into_iter().map(make).collect();
    if all.len() > 1 {
        all.sort_by_cached_key(|file| std::cmp::Reverse(file.cameras()));
    }
    all
}

/// Reports whether `path` is a JSON file of the kind `make`.
fn is_kind(path: &Path, make: &dyn Fn(PathBuf) -> PoseFile) -> bool {
    path.is_file() && foreign_json(path) == Some(make(path.to_owned()))
}

/// The kind of a JSON file of OpenSfM, OpenMVG, Meshroom, Record3D or nerfstudio's exports, by content.
pub(super) fn foreign_json(path: &Path) -> Option<PoseFile> {
    let value = value_of(path)?;
    let (first, path) = (value.get(0), path.to_owned());
    let first_has = |key: &str| first.is_some_and(|first| first.get(key).is_some());
    if first_has("cameras") && first_has("shots") {
        return Some(PoseFile::OpenSfm(path));
    }
    if (first_has("transform") && first_has("file_path")) || value.get("camera_path").is_some() {
        return Some(PoseFile::Nerfstudio(path));
    }
    let has_list = |key: &str| value.get(key).is_some_and(serde_json::Value::is_array);
    if has_list("views") && has_list("extrinsics") {
        return Some(PoseFile::OpenMvg(path));
    }
    if has_list("views") && has_list("poses") {
        return Some(PoseFile::Meshroom(path));
    }
    let record3d = value.get("K").is_some() && value.get("poses").is_some();
    record3d.then_some(PoseFile::Record3d(path))
}

/// A JSON file of any name with cameras and photographs: of several the one with most.
fn any_json(folder: &Path) -> Option<PoseFile> {
    let (most, largest) = JSON_MAX;
    let mut all = files(folder);
    all.retain(|path| lower_extension(path) == "json");
    all.retain(|path| path.metadata().is_ok_and(|file| file.len() <= largest));
    let mut found: Vec<PoseFile> =
        all.iter().take(most).filter_map(|path| kind_of_json(path)).collect();
    // A stable order: of several with as many cameras the first.
    found.sort_by_cached_key(|file| std::cmp::Reverse(file.cameras()));
    found.into_iter().next()
}

fn kind_of_json(path: &Path) -> Option<PoseFile> {
    match foreign_json(path) {
        Some(PoseFile::Nerfstudio(_)) => return None,
        // A list of photographs.
        Some(file @ (PoseFile::OpenMvg(_) | PoseFile::Meshroom(_))) if file.cameras() == 0 => {
            return None;
        }
        Some(file) => return Some(file),
        None => {}
    }
    let value = value_of(path)?;
    let first = value.get("frames")?.get(0)?;
    let is_frame = first.get("transform_matrix").is_some() || first.get("c2w").is_some();
    is_frame.then(|| PoseFile::Json(path.to_owned()))
}

fn value_of(path: &Path) -> Option<serde_json::Value> {
    super::json::value(&read(path).ok()?).ok()
}

/// Length of the list `key` of a JSON file, 0 where there is none.
fn length_of(path: &Path, key: &str) -> usize {
    let value = value_of(path);
    value.as_ref().and_then(|v| v.get(key)?.as_array()).map_or(0, Vec::len)
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
    let value = value_of(path)?;
    let frames = value.get("frames").and_then(|frames| frames.as_array());
    frames.or(value.as_array().filter(|_| lists)).map(Vec::len)
}

/// The candidate `first` and the `others`, with a line that names those of them that are worth one.
fn chosen(
    folder: &Path,
    first: Candidate,
    others: Vec<Candidate>,
    worth_a_line: impl Fn(&Candidate) -> bool,
) -> Found {
    let named = |other: &Candidate| {
        let name = other.file.name(folder);
        match other.file.cameras() {
            0 => name,
            cameras => format!("{name} ({cameras} cameras)"),
        }
    };
    let source = |candidate: Candidate| {
        let file = candidate.file;
        Source { name: file.name(folder), file }
    };
    let lines: Vec<String> = others.iter().filter(|other| worth_a_line(other)).map(named).collect();
    let file = source(first);
    let names_others = !lines.is_empty();
    let notes = if lines.is_empty() {
        Vec::new()
    } else {
        vec![format!("cameras come from {}; not read: {}", file.name, lines.join(", "))]
    };
    Found { file, notes, names_others, others: others.into_iter().map(source).collect() }
}

/// `path` as seen from `folder`.
fn name(folder: &Path, path: &Path) -> String {
    let inside = path.strip_prefix(folder).unwrap_or(path);
    let inside = if inside.as_os_str().is_empty() { Path::new(".") } else { inside };
    inside.display().to_string()
}
