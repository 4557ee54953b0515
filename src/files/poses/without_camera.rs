//! Pictures that lie among those of a scene and have no camera in its pose file.

use super::assemble::list_images;
use super::find::is_own_output;
use super::scene::{Frame, LeftOut};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

/// Most folders of pictures that are listed.
const FOLDERS_MAX: usize = 200;
/// Names of a line; the others are counted by it.
const NAMES: usize = 3;
/// Words in the names of pictures that belong to a photograph of the scene: NeRF's scenes have `r_0_depth_0001.png`
/// and `r_0_normal_0001.png` beside `r_0.png`.
const COMPANIONS: [&str; 4] = ["mask", "depth", "normal", "disp"];

/// The same as whole words: 3D Scanner App has `conf_00000.png` beside `frame_00000.jpg`.
const COMPANION_WORDS: [&str; 2] = ["conf", "confidence"];

/// A folder of pictures.
struct Folder {
    /// Its path as the frames have it.
    path: PathBuf,
    /// Names of the photographs with a camera.
    used: HashSet<OsString>,
    /// Their stems, in lower case.
    stems: HashSet<String>,
    /// Names of masks and depth maps.
    maps: HashSet<OsString>,
}

/// The folders of the frames' pictures by their canonical paths.
#[derive(Default)]
struct Folders {
    all: BTreeMap<PathBuf, Folder>,
    canonical: HashMap<PathBuf, PathBuf>,
}

impl Folders {
    fn of(frames: &[Frame]) -> Self {
        let mut folders = Self::default();
        for image in frames.iter().map(|frame| frame.image.as_path()) {
            let Some((key, path)) = folders.key(image).zip(image.parent()) else { continue };
            if folders.all.len() == FOLDERS_MAX && !folders.all.contains_key(&key) {
                continue;
            }
            let new = || Folder {
                path: path.to_owned(),
                used: HashSet::new(),
                stems: HashSet::new(),
                maps: HashSet::new(),
            };
            let folder = folders.all.entry(key).or_insert_with(new);
            folder.used.extend(image.file_name().map(OsStr::to_owned));
            folder.stems.insert(stem(image));
        }
        for map in frames.iter().flat_map(|frame| frame.mask.iter().chain(&frame.depth)) {
            let folder = folders.key(map).and_then(|key| folders.all.get_mut(&key));
            if let Some(folder) = folder {
                folder.maps.extend(map.file_name().map(OsStr::to_owned));
            }
        }
        folders
    }

    /// The canonical path of the folder of `file`.
    fn key(&mut self, file: &Path) -> Option<PathBuf> {
        let folder = file.parent()?;
        if !self.canonical.contains_key(folder) {
            let here = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
            let key = here.canonicalize().ok()?;
            self.canonical.insert(folder.to_owned(), key);
        }
        self.canonical.get(folder).cloned()
    }
}

/// A line about the pictures without a camera in the folders of the frames' pictures; `None` where there is none.
/// Masks, depth maps, copies in another format and pictures that were rendered are no photographs.
pub(super) fn line(path: &Path, frames: &[Frame], left_out: &[LeftOut]) -> Option<String> {
    let named: HashSet<String> = left_out.iter().map(|left| stem_of_name(&left.name)).collect();
    let (mut photographs, mut without, mut places) = (0, Vec::new(), Vec::new());
    for folder in Folders::of(frames).all.into_values() {
        let own_output =
            is_own_output(&folder.path) || folder.path.parent().is_some_and(is_own_output);
        if own_output {
            continue;
        }
        let is_photograph = |image: &PathBuf| {
            let (stem, name) = (stem(image), image.file_name().unwrap_or_default());
            let is_companion = COMPANIONS.iter().any(|word| stem.contains(word))
                || stem.split(['_', '-', '.', ' ']).any(|word| COMPANION_WORDS.contains(&word));
            let is_known = folder.stems.contains(&stem) || named.contains(&stem);
            !is_companion && !is_known && !folder.maps.contains(name)
        };
        let others: Vec<PathBuf> =
            list_images(&folder.path).into_iter().filter(is_photograph).collect();
        photographs += folder.used.len() + others.len();
        if !others.is_empty() {
            places.push(folder.path);
        }
        let name =
            |image: PathBuf| image.file_name().unwrap_or_default().to_string_lossy().into_owned();
        without.extend(others.into_iter().map(name));
    }
    let first = places.first()?;
    let common: PathBuf = first
        .components()
        .zip(path.parent().unwrap_or(Path::new("")).components())
        .take_while(|(a, b)| a == b)
        .map(|(a, _)| a)
        .collect();
    let inside = |path: &Path| {
        let inside = path.strip_prefix(&common).unwrap_or(path);
        inside.components().collect::<PathBuf>().display().to_string()
    };
    let mut named: Vec<String> =
        places.iter().take(NAMES).map(|folder| format!("{}/", inside(folder))).collect();
    // The folder of the pose file itself.
    named.iter_mut().filter(|name| *name == "/").for_each(|name| *name = "./".to_owned());
    let more = if places.len() > NAMES { ", …" } else { "" };
    let count = without.len();
    let shown = without[..count.min(NAMES)].join(", ");
    let shown = if count > NAMES { format!("{shown}, …") } else { shown };
    Some(format!(
        "{count} of {photographs} pictures in {}{more} have no camera in {}: {shown}",
        named.join(", "),
        inside(path)
    ))
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase()
}

/// [`stem`] of a path in a pose file, which may be one of Windows.
fn stem_of_name(name: &str) -> String {
    stem(Path::new(&name.replace('\\', "/")))
}
