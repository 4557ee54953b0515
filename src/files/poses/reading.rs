//! Options of the reading of a scene, and the search for its pictures.

use super::assemble::{
    Draft, Pictures, entries, find_image_in, has_extension, list_images, similar_key,
};
use super::matrices::PoseConvention;
use glam::DMat4;
use std::cell::RefCell;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Most folders below a folder of pictures that are searched for a file name.
const FOLDERS_MAX: usize = 500;
/// Most folders that a message names.
const NAMED: usize = 4;

/// Options of a reading: [`load_scene_with`](super::scene::load_scene_with).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SceneOptions {
    /// Pose file, or folder of a COLMAP model: a path below the scene's folder, or any path. Default: the first
    /// kind that the folder has, of several models the largest.
    pub model: Option<PathBuf>,
    /// Folder of the pictures. Default: the folders in which the program that wrote the pose file has them.
    pub images: Option<PathBuf>,
    /// Refuses an entry that is left out, a mask that is not used and a point without a position.
    /// By default the scene is read without them, and a warning names them.
    pub strict: bool,
    /// Direction and axes of the matrices of `poses.txt`, `transforms.json`, Polycam, 3D Scanner App, MVSNet and of
    /// matrix files, where a program wrote them in another convention than the format's. Other formats ignore it.
    pub convention: Option<PoseConvention>,
}

/// Options of one reading, and the folders that it has listed.
#[derive(Debug)]
pub(super) struct Reading<'a> {
    /// Need of pictures.
    pub pictures: Pictures,
    /// See [`SceneOptions::strict`].
    pub strict: bool,
    /// See [`SceneOptions::convention`].
    pub convention: Option<PoseConvention>,
    /// See [`SceneOptions::images`].
    images: Option<&'a Path>,
    /// The scene's folder, where the pose file may lie elsewhere.
    folder: Option<&'a Path>,
    folders: Folders,
    /// Pictures that were found by a part of their path.
    by_part: RefCell<HashMap<PathBuf, FoundByPart>>,
    /// Folders that were searched for a picture that has not the path of the pose file.
    searched: RefCell<Vec<PathBuf>>,
}

/// Entries that find a picture by a part of their path.
#[derive(Clone, Debug, Default)]
struct FoundByPart {
    /// The picture's path below the folder that was searched.
    place: String,
    /// Paths of the pose file that agree with it from the folder `images` on.
    from_images: HashSet<String>,
    /// The other paths.
    others: HashSet<String>,
}

impl FoundByPart {
    /// The one path of a pose file to which the picture belongs; `None` where several have the same claim.
    fn owner(&self) -> Option<&str> {
        let claims = if self.from_images.is_empty() { &self.others } else { &self.from_images };
        let mut claims = claims.iter();
        claims.next().filter(|_| claims.next().is_none()).map(String::as_str)
    }
}

impl<'a> Reading<'a> {
    /// Reading without options.
    pub fn new(pictures: Pictures) -> Self {
        Self {
            pictures,
            strict: false,
            convention: None,
            images: None,
            folder: None,
            folders: Folders::default(),
            by_part: RefCell::default(),
            searched: RefCell::default(),
        }
    }

    /// Reading of a scene in `folder`.
    pub fn with(pictures: Pictures, options: &'a SceneOptions, folder: Option<&'a Path>) -> Self {
        let images = options.images.as_deref();
        let SceneOptions { strict, convention, .. } = *options;
        Self { strict, convention, images, folder, ..Self::new(pictures) }
    }

    /// A reading with the same options that has found nothing.
    pub fn again(&self) -> Reading<'a> {
        let Self { pictures, strict, convention, images, folder, .. } = *self;
        Self { strict, convention, images, folder, ..Self::new(pictures) }
    }

    /// The same reading for a format whose cameras need the sizes of their pictures.
    pub fn needed(&self) -> Reading<'a> {
        let (by_part, searched) = (self.by_part.clone(), self.searched.clone());
        Self { pictures: Pictures::Needed, by_part, searched, ..self.again() }
    }

    /// Converts a matrix whose format has the convention `own`.
    pub fn pose(&self, matrix: DMat4, own: PoseConvention) -> DMat4 {
        self.convention.unwrap_or(own).to_world_from_camera(matrix)
    }

    /// Searches for a picture by its path: below the folder of pictures that the options name; else below `roots`
    /// and the scene's folder.
    pub fn find_exact(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        if let Some(images) = self.images {
            return find_image_in(&self.folders, &[images], name);
        }
        find_image_in(&self.folders, roots, name)
            .or_else(|| find_image_in(&self.folders, &[self.folder?], name))
    }

    /// Searches as [`Self::find_exact`] does, then in the same folders for the path without its first folders, which
    /// may be those of another machine, then below the folders of pictures for the file name where one picture alone
    /// has it. The assembly gives each picture that is found by a part of its path to one entry ([`Self::settle`]).
    pub fn find(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        self.find_of_scene(roots, roots, name)
    }

    /// [`Self::find`] where a part of the path is enough in the folders `own` alone: `roots` has others that may
    /// hold the pictures of other scenes.
    pub fn find_of_scene(&self, roots: &[&Path], own: &[&Path], name: &str) -> Option<PathBuf> {
        if let Some(found) = self.find_exact(roots, name) {
            return Some(found);
        }
        let own: Vec<&Path> = match self.images {
            Some(images) => vec![images],
            None => own.iter().copied().chain(self.folder).collect(),
        };
        let mut searched = self.searched.borrow_mut();
        for folder in &own {
            if !searched.iter().any(|known| known == folder) {
                searched.push(folder.to_path_buf());
            }
        }
        let name = name.replace('\\', "/");
        self.find_by_end(&own, &name).or_else(|| self.find_by_file_name(&own, &name))
    }

    /// Searches below `roots` for the path without its first folders.
    fn find_by_end(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        let mut rest = name;
        while let Some((dropped, inner)) = rest.split_once('/') {
            rest = inner;
            let Some(found) = find_image_in(&self.folders, roots, rest) else { continue };
            if found.is_file() {
                let from_images = dropped == "images" || rest.starts_with("images/");
                self.claim(&found, name, rest, from_images);
                return Some(found);
            }
        }
        None
    }

    /// Searches for the file name below the folders of pictures of `roots`.
    fn find_by_file_name(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        let file = Path::new(name.rsplit('/').next().filter(|file| !file.is_empty())?);
        let base = |root: &Path| match self.images {
            Some(images) => images.to_owned(),
            None => root.join("images"),
        };
        let (base, found) = roots.iter().map(|root| base(root)).find_map(|base| {
            let found = self.folders.below(&base, file)?;
            Some((base, found))
        })?;
        let place = found.strip_prefix(base).unwrap_or(&found).to_string_lossy().replace('\\', "/");
        self.claim(&found, name, &place, false);
        Some(found)
    }

    fn claim(&self, found: &Path, name: &str, place: &str, from_images: bool) {
        let mut by_part = self.by_part.borrow_mut();
        let claims = by_part.entry(found.to_owned()).or_default();
        claims.place = place.to_owned();
        let claims = if from_images { &mut claims.from_images } else { &mut claims.others };
        claims.insert(name.to_owned());
    }

    /// Gives each picture that was found by a part of its path to the one entry to which it belongs, under the path
    /// that was found. Entries with its whole path go before it; of several others with the same claim none has it.
    pub fn settle(&self, drafts: &mut [Draft]) {
        let by_part = self.by_part.borrow();
        if by_part.is_empty() {
            return;
        }
        let name = |draft: &Draft| draft.file.replace('\\', "/");
        let is_claim = |claims: &FoundByPart, name: &String| {
            claims.from_images.contains(name) || claims.others.contains(name)
        };
        let mut exact: HashSet<PathBuf> = HashSet::new();
        for draft in drafts.iter() {
            if let Some(image) = &draft.image
                && by_part.get(image).is_some_and(|claims| !is_claim(claims, &name(draft)))
            {
                exact.insert(image.clone());
            }
        }
        for draft in drafts.iter_mut() {
            let Some(image) = draft.image.clone() else { continue };
            let Some(claims) = by_part.get(&image) else { continue };
            let name = name(draft);
            if !is_claim(claims, &name) {
                continue;
            }
            if !exact.contains(&image) && claims.owner() == Some(name.as_str()) {
                draft.file = claims.place.clone();
            } else {
                draft.image = None;
            }
        }
    }

    /// For messages: where pictures were searched, and how to name their folder; empty where none was.
    pub fn searched(&self) -> String {
        let searched = self.searched.borrow();
        let shown = |folder: &PathBuf| {
            let here = folder.as_os_str().is_empty();
            if here { "this folder".to_owned() } else { folder.display().to_string() }
        };
        let named: Vec<String> = searched.iter().take(NAMED).map(shown).collect();
        match (named.is_empty(), self.images) {
            (true, _) => String::new(),
            (false, Some(_)) => format!(" in {} and below", named.join(", ")),
            (false, None) => format!(
                " in {} and in `images` there; --images names the folder of the pictures",
                named.join(", ")
            ),
        }
    }

    /// Pictures of the folder that the options name; else of the first of `places` that has some.
    pub fn list(&self, places: &[PathBuf]) -> Vec<PathBuf> {
        match self.images {
            Some(images) => list_images(images),
            None => {
                places.iter().map(|p| list_images(p)).find(|l| !l.is_empty()).unwrap_or_default()
            }
        }
    }

    /// Folders that may hold the pictures: the one that the options name, else `places`.
    pub fn places(&self, places: Vec<PathBuf>) -> Vec<PathBuf> {
        self.images.map_or(places, |images| vec![images.to_owned()])
    }
}

/// Pictures by their [`similar_key`].
type ByKey = HashMap<String, Vec<PathBuf>>;

/// Pictures of folders by [`similar_key`], each folder listed once.
#[derive(Debug, Default)]
pub(in crate::files) struct Folders {
    listed: RefCell<HashMap<PathBuf, ByKey>>,
    /// With the folders below.
    listed_below: RefCell<HashMap<PathBuf, ByKey>>,
}

impl Folders {
    /// The picture in the folder of `place` whose name is that of `place` but for case, the form of accents and the
    /// extension: the only one, or the only one with its extension but for case.
    pub fn similar(&self, place: &Path) -> Option<PathBuf> {
        let folder = place.parent()?;
        let mut listed = self.listed.borrow_mut();
        if !listed.contains_key(folder) {
            let entries = std::fs::read_dir(folder).into_iter().flatten();
            let pictures = by_key(entries.filter_map(|entry| Some(entry.ok()?.path())));
            listed.insert(folder.to_owned(), pictures);
        }
        the_one(listed.get(folder)?.get(&similar_key(place))?, place)
    }

    /// The picture in `folder` or below with the name `file`, as [`Self::similar`] compares names.
    fn below(&self, folder: &Path, file: &Path) -> Option<PathBuf> {
        let mut listed = self.listed_below.borrow_mut();
        let pictures =
            listed.entry(folder.to_owned()).or_insert_with(|| by_key(files_below(folder)));
        let similar = pictures.get(&similar_key(file))?;
        let mut same = similar.iter().filter(|path| path.file_name() == Some(file.as_os_str()));
        match (same.next(), same.next()) {
            (Some(one), None) => Some(one.clone()),
            (Some(_), Some(_)) => None,
            (None, _) => the_one(similar, file),
        }
    }
}

/// The only one of `pictures`, or the only one with the extension of `place` but for case.
fn the_one(pictures: &[PathBuf], place: &Path) -> Option<PathBuf> {
    if let [one] = pictures {
        return Some(one.clone());
    }
    let extension = place.extension()?;
    let mut same = pictures
        .iter()
        .filter(|path| path.extension().is_some_and(|own| own.eq_ignore_ascii_case(extension)));
    same.next().filter(|_| same.next().is_none()).cloned()
}

fn by_key(paths: impl IntoIterator<Item = PathBuf>) -> ByKey {
    let mut pictures = ByKey::new();
    for path in paths.into_iter().filter(|path| has_extension(path)) {
        pictures.entry(similar_key(&path)).or_default().push(path);
    }
    pictures
}

/// Files in a folder and in those below, without hidden ones.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let (mut files, mut folders, mut next) = (Vec::new(), vec![folder.to_owned()], 0);
    while next < folders.len().min(FOLDERS_MAX) {
        let (below, own): (Vec<_>, Vec<_>) =
            entries(&folders[next]).into_iter().partition(|path| path.is_dir());
        files.extend(own);
        // A link may lead to a folder above.
        folders.extend(below.into_iter().filter(|path| !path.is_symlink()));
        next += 1;
    }
    files
}
