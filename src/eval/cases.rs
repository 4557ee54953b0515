//! Which views of which scenes are inputs, and which are compared with.

use super::{Result, bad};
use crate::data::chunks::{Chunk, Example, NEAR_FAR, load_index as chunk_index};
use crate::data::dataset::{chunk_folder, scene_paths};
use crate::data::depth::{DepthRange, depth_range};
use crate::io::protocol::{Index, Views, load_index, load_protocol};
use crate::io::scene::{Scene, load_scene};
use crate::pipeline::{Photo, check_photos, refine_range};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Inputs and targets of one reconstruction.
#[derive(Debug)]
pub struct Case {
    /// Name of the scene, or key of the video.
    pub scene: String,
    /// Frames of the inputs and of the targets.
    pub views: Views,
    /// Width and height of the inputs that the protocol names, px.
    pub resolution: Option<[usize; 2]>,
    place: Place,
    range: OnceLock<DepthRange>,
}

impl Case {
    fn new(scene: &str, views: Views, resolution: Option<[usize; 2]>, place: Place) -> Self {
        Self { scene: scene.to_owned(), views, resolution, place, range: OnceLock::new() }
    }

    /// The inputs' frames as a name: `0_8`.
    pub fn pair(&self) -> String {
        self.views.context.iter().map(usize::to_string).collect::<Vec<_>>().join("_")
    }
}

#[derive(Clone, Debug)]
enum Place {
    /// Chunk of the example whose key is the case's scene.
    Chunk(PathBuf),
    /// Index into the scenes.
    Scene(usize),
}

/// Photographs of a case.
pub struct Loaded {
    /// The inputs.
    pub context: Vec<Photo>,
    /// The truth.
    pub targets: Vec<Photo>,
    /// Names of the targets' frames.
    pub names: Vec<String>,
    /// Depth candidates.
    pub range: DepthRange,
    /// Nobody said what `range` is: the model may look ([`SubSplat::look`]).
    ///
    /// [`SubSplat::look`]: crate::model::subsplat::SubSplat::look
    pub look: bool,
}

/// Cases of a data set.
#[derive(Debug)]
pub struct Benchmark {
    cases: Vec<Case>,
    scenes: Vec<Scene>,
    /// Nearest and farthest depth, where the user gave them.
    given: (Option<f32>, Option<f32>),
    /// Chunks, and not scenes.
    chunks: bool,
    /// The chunk opened last.
    open: Mutex<Option<(PathBuf, Arc<Chunk>)>>,
    notes: Vec<String>,
}

impl Benchmark {
    /// Opens pixelSplat's chunks (`data` or `data/test` has an `index.json`; `index` is
    /// then required), a scene, or a folder of scenes. Without an `index` (scene: context
    /// and target, or null) scenes need a `protocol.json`; those without one, or without
    /// tests in it, are passed over, and so is what the index names and the data lacks:
    /// [`Benchmark::notes`] says how many.
    ///
    /// # Errors
    /// Files that are missing or broken; an index out of a scene's range; no case at all.
    pub fn open(data: &Path, index: Option<&Path>) -> Result<Self> {
        let listed = index.map(load_index).transpose()?;
        let mut all = Self {
            cases: Vec::new(),
            scenes: Vec::new(),
            given: (None, None),
            chunks: false,
            open: Mutex::default(),
            notes: Vec::new(),
        };
        match (chunk_folder(data, "test"), listed, index) {
            (Some(folder), Some(listed), _) => all.of_chunks(&folder, listed)?,
            (Some(_), None, _) => {
                let expected = "an evaluation index for a data set of chunks (--index)";
                return bad(data.display().to_string(), expected, "none");
            }
            (None, listed, index) => all.of_scenes(data, listed.as_ref().zip(index))?,
        }
        if all.cases.is_empty() {
            let expected = match index {
                Some(index) => format!("scenes that {} names", index.display()),
                None => "scenes with a protocol.json that has tests".to_owned(),
            };
            return bad(data.display().to_string(), expected, "none");
        }
        Ok(all)
    }

    fn of_chunks(&mut self, folder: &Path, listed: Index) -> Result<()> {
        self.chunks = true;
        let files = chunk_index(folder)?;
        let total = listed.len();
        let (mut without, mut absent) = (0, 0);
        for (key, views) in listed {
            match (views, files.get(&key)) {
                (None, _) => without += 1,
                (Some(_), None) => absent += 1,
                (Some(views), Some(file)) => {
                    self.cases.push(Case::new(&key, views, None, Place::Chunk(file.clone())));
                }
            }
        }
        // A chunk is opened once.
        let file = |c: &Case| match &c.place {
            Place::Chunk(file) => file.clone(),
            Place::Scene(_) => PathBuf::new(),
        };
        self.cases.sort_by_cached_key(|c| (file(c), c.scene.clone()));
        if without + absent > 0 {
            self.notes.push(format!(
                "of {total} entries of the index {without} have no views and {absent} are not in \
                 the data; {} are evaluated",
                self.cases.len()
            ));
        }
        Ok(())
    }

    fn of_scenes(&mut self, data: &Path, listed: Option<(&Index, &Path)>) -> Result<()> {
        let paths = scene_paths(data)?;
        let mut without = Vec::new();
        for path in &paths {
            let folder = if path.is_dir() { path } else { path.parent().unwrap_or(path) };
            let protocol = folder.join("protocol.json");
            let scene = load_scene(path)?;
            let (tests, resolution, source) = match listed {
                Some((index, file)) => {
                    let views = index.get(&scene.name).and_then(Clone::clone);
                    (views.into_iter().collect(), None, file.to_owned())
                }
                None if protocol.is_file() => {
                    let content = load_protocol(&protocol)?;
                    (content.tests, content.resolution, protocol)
                }
                None => (Vec::new(), None, protocol),
            };
            if tests.is_empty() {
                without.push(scene.name.clone());
            }
            for views in tests {
                views.check(&source, scene.frames.len())?;
                let place = Place::Scene(self.scenes.len());
                self.cases.push(Case::new(&scene.name, views, resolution, place));
            }
            self.scenes.push(scene);
        }
        if !without.is_empty() && !self.cases.is_empty() {
            self.notes.push(format!("passed over, without tests: {}", without.join(", ")));
        }
        Ok(())
    }

    /// Depth candidates for every scene (world units); what is not given is derived:
    /// chunks 1 and 100, scenes by [`depth_range`] and, where that is but a guess, by
    /// points matched between the inputs, as `run` does it.
    pub fn set_near_far(&mut self, near: Option<f32>, far: Option<f32>) {
        self.given = (near, far);
        self.cases.iter_mut().for_each(|c| c.range = OnceLock::new());
    }

    /// Keeps the cases of the first `scenes` scenes.
    pub fn limit(&mut self, scenes: usize) {
        let mut seen: Vec<String> = Vec::new();
        self.cases.retain(|c| {
            if !seen.contains(&c.scene) {
                seen.push(c.scene.clone());
            }
            seen.len() <= scenes
        });
    }

    /// The cases, scene by scene.
    pub fn cases(&self) -> &[Case] {
        &self.cases
    }

    /// Whether the data are pixelSplat's chunks.
    pub fn is_chunks(&self) -> bool {
        self.chunks
    }

    /// What was passed over, and warnings of the readers, one line each.
    pub fn notes(&self) -> Vec<String> {
        let warnings = self.scenes.iter().flat_map(|s| s.warnings.clone());
        self.notes.iter().cloned().chain(warnings).collect()
    }

    /// Reads the photographs of a case.
    ///
    /// # Errors
    /// Pictures that are missing or broken; a frame that a video does not have; nothing to
    /// derive the depth range from.
    pub fn load(&self, case: &Case) -> Result<Loaded> {
        let views = &case.views;
        if views.target.is_empty() || views.context.len() < 2 {
            let got = format!("{} and {}", views.context.len(), views.target.len());
            let what = format!("scene {} ({})", case.scene, case.pair());
            return bad(what, "at least 2 context frames and a target", got);
        }
        match &case.place {
            Place::Chunk(file) => self.of_video(case, file),
            Place::Scene(i) => match self.scenes.get(*i) {
                Some(scene) => self.of_scene(case, scene),
                None => bad(&case.scene, "a scene of this data set", "another"),
            },
        }
    }

    fn of_video(&self, case: &Case, file: &Path) -> Result<Loaded> {
        let chunk = self.chunk(file)?;
        let Some(video) = chunk.find(&case.scene) else {
            let what = file.display().to_string();
            return bad(what, format!("an example `{}`", case.scene.escape_debug()), "none");
        };
        let photos = |frames: &[usize]| -> Result<Vec<Photo>> {
            frames.iter().map(|&f| photo(&chunk, video, f)).collect()
        };
        let names = case.views.target.iter().map(|f| format!("{f:06}")).collect();
        let (near, far) = (self.given.0.unwrap_or(NEAR_FAR.0), self.given.1.unwrap_or(NEAR_FAR.1));
        if !(near > 0.0 && far > near && far.is_finite()) {
            return bad("near and far", "0 < near < far", format!("{near} and {far}"));
        }
        let reason = "RealEstate10K's habit".to_owned();
        let range = DepthRange { near, far, reason, guessed: false };
        let (context, targets) = (photos(&case.views.context)?, photos(&case.views.target)?);
        Ok(Loaded { context, targets, names, range, look: self.given == (None, None) })
    }

    fn of_scene(&self, case: &Case, scene: &Scene) -> Result<Loaded> {
        let frames = |list: &[usize]| {
            let frame = |&i: &usize| match scene.frames.get(i) {
                Some(frame) => Ok(Photo::from_frame(frame)?),
                None => bad(&scene.name, "a frame of the scene", i.to_string()),
            };
            list.iter().map(frame).collect::<Result<Vec<_>>>()
        };
        let (context, targets) = (frames(&case.views.context)?, frames(&case.views.target)?);
        let name = |&i: &usize| scene.frames.get(i).map_or_else(String::new, |f| f.name.clone());
        let names = case.views.target.iter().map(name).collect();
        let range = match case.range.get() {
            Some(range) => range.clone(),
            None => {
                let guess = depth_range(scene, &case.views.context, self.given)?;
                let range = match guess.guessed {
                    true => refine_range(guess, self.given, &check_photos(&context)?),
                    false => guess,
                };
                case.range.get_or_init(|| range).clone()
            }
        };
        Ok(Loaded { context, targets, names, range, look: self.given == (None, None) })
    }

    fn chunk(&self, file: &Path) -> Result<Arc<Chunk>> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((path, chunk)) = &*open
            && path == file
        {
            return Ok(Arc::clone(chunk));
        }
        let chunk = Arc::new(Chunk::open(file)?);
        *open = Some((file.to_owned(), Arc::clone(&chunk)));
        Ok(chunk)
    }
}

fn photo(chunk: &Chunk, video: &Example, frame: usize) -> Result<Photo> {
    let (image, camera) = chunk.load(video, frame)?;
    Ok(Photo { image, camera })
}
