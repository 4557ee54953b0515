//! Options of the reading of a scene, and the search for its pictures.

use super::assemble::{Pictures, find_image_in, has_extension, list_images, similar_key};
use super::matrices::PoseConvention;
use glam::DMat4;
use std::cell::RefCell;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

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
    /// Direction and axes of the matrices of `poses.txt`, `transforms.json` and Polycam, where a program wrote
    /// them in another convention than the format's. Other formats ignore it.
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
    /// Pictures that were found by a part of their path, with that path.
    taken: RefCell<HashMap<PathBuf, String>>,
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
            taken: RefCell::default(),
        }
    }

    /// Reading of a scene in `folder`.
    pub fn with(pictures: Pictures, options: &'a SceneOptions, folder: Option<&'a Path>) -> Self {
        let images = options.images.as_deref();
        let SceneOptions { strict, convention, .. } = *options;
        Self { strict, convention, images, folder, ..Self::new(pictures) }
    }

    /// The same options for a format whose cameras need the sizes of their pictures.
    pub fn needed(&self) -> Reading<'a> {
        let Self { strict, convention, images, folder, .. } = *self;
        Self { strict, convention, images, folder, ..Self::new(Pictures::Needed) }
    }

    /// Converts a matrix whose format has the convention `own`.
    pub fn pose(&self, matrix: DMat4, own: PoseConvention) -> DMat4 {
        self.convention.unwrap_or(own).to_world_from_camera(matrix)
    }

    /// Searches for a picture below the folder of pictures that the options name; else below `roots` and the
    /// scene's folder.
    pub fn find(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        if let Some(images) = self.images {
            return self.find_below(&[images], name);
        }
        find_image_in(&self.folders, roots, name)
            .or_else(|| find_image_in(&self.folders, &[self.folder?], name))
    }

    /// Searches as [`Self::find`] does, then for the path without its first folders, which may be those of another
    /// machine. Two entries do not find one picture in the second way.
    pub fn find_by_end(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        if let Some(images) = self.images {
            return self.find_below(&[images], name);
        }
        self.find_below(roots, name).or_else(|| self.find_below(&[self.folder?], name))
    }

    /// Searches below `roots` by the path of a pose file, then by the path without its first folders. Two entries
    /// do not find one picture in the second way.
    fn find_below(&self, roots: &[&Path], name: &str) -> Option<PathBuf> {
        let name = name.replace('\\', "/");
        if let Some(found) = find_image_in(&self.folders, roots, &name) {
            return Some(found);
        }
        let mut rest = name.as_str();
        while let Some((_, inner)) = rest.split_once('/') {
            rest = inner;
            if let Some(found) = find_image_in(&self.folders, roots, rest) {
                let mut taken = self.taken.borrow_mut();
                let first = taken.entry(found.clone()).or_insert_with(|| name.clone());
                return (*first == name).then_some(found);
            }
        }
        None
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

/// Pictures of folders by [`similar_key`], each folder listed once.
#[derive(Debug, Default)]
pub(in crate::files) struct Folders {
    /// `None` where several pictures of a folder have the key.
    listed: RefCell<HashMap<PathBuf, HashMap<String, Option<PathBuf>>>>,
}

impl Folders {
    /// The only picture in the folder of `place` whose name is that of `place` but for case, the form of
    /// accents and the extension.
    pub fn similar(&self, place: &Path) -> Option<PathBuf> {
        let folder = place.parent()?;
        let mut listed = self.listed.borrow_mut();
        let pictures = match listed.get(folder) {
            Some(pictures) => pictures,
            None => listed.entry(folder.to_owned()).or_insert_with(|| by_key(folder)),
        };
        pictures.get(&similar_key(place)).cloned().flatten()
    }
}

fn by_key(folder: &Path) -> HashMap<String, Option<PathBuf>> {
    let mut pictures = HashMap::new();
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    for path in entries.filter_map(|entry| Some(entry.ok()?.path())).filter(|p| has_extension(p)) {
        let several = pictures.contains_key(&similar_key(&path));
        pictures.insert(similar_key(&path), (!several).then_some(path));
    }
    pictures
}
