//! Cases of a data set: the views that are inputs, and those that are ground truth.

use crate::data::chunks::{Chunk, Example, load_index as chunk_index};
use crate::data::dataset::{chunk_folder, scene_paths};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use subsplat::files::poses::protocol::{Index, Views, load_index, load_protocol};
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::reconstruct::inputs::pair::choose_pair;
use subsplat::reconstruct::stages::check_pairs;
use subsplat::reconstruct::{DepthBounds, DepthRange, Error, Photo, Result};
use subsplat_kernels::camera::Camera;

/// Most targets of a case that is made up.
const MADE_UP_TARGETS: usize = 8;

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
    bounds: OnceLock<DepthBounds>,
}

impl Case {
    fn new(scene: &str, views: Views, resolution: Option<[usize; 2]>, place: Place) -> Self {
        Self { scene: scene.to_owned(), views, resolution, place, bounds: OnceLock::new() }
    }

    /// Joins the inputs' frames to a name: `0_8`.
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
    /// Depth range, before the network estimates its own.
    pub bounds: DepthBounds,
    /// Ends of the depth range that the user fixed.
    pub depth_range: DepthRange,
}

/// Cases of a data set.
#[derive(Debug)]
pub struct Benchmark {
    cases: Vec<Case>,
    scenes: Vec<Scene>,
    /// Ends of the depth range that the user fixed.
    depth_range: DepthRange,
    /// True if the data are chunks; otherwise they are scenes.
    chunks: bool,
    /// The chunk that was opened last.
    open: Mutex<Option<(PathBuf, Arc<Chunk>)>>,
    notes: Vec<String>,
    /// Notes on cases that are made up.
    made_up: Vec<String>,
}

impl Benchmark {
    /// Opens pixelSplat's chunks, a scene, or a folder of scenes. Chunks have an `index.json` in
    /// `data` or `data/test`, and need an `index` (scene: context and target, or null). Scenes
    /// have an `index` or a `protocol.json`. Where no scene has one, each gets a case: the pair that
    /// `subsplat run` chooses, and every k-th frame between the two as a target. Otherwise scenes
    /// without tests are skipped, as are entries of the index that the data lacks;
    /// [`Benchmark::notes`] lists them.
    ///
    /// # Errors
    /// Files that are missing or broken; a frame that a scene does not have; no case at all.
    pub fn open(data: &Path, index: Option<&Path>) -> Result<Self> {
        let listed = index.map(load_index).transpose()?;
        let mut all = Self {
            cases: Vec::new(),
            scenes: Vec::new(),
            depth_range: DepthRange::Auto,
            chunks: false,
            open: Mutex::default(),
            notes: Vec::new(),
            made_up: Vec::new(),
        };
        match (chunk_folder(data, "test"), listed, index) {
            (Some(folder), Some(listed), _) => all.add_chunks(&folder, listed)?,
            (Some(_), None, _) => {
                let expected = "an evaluation index for a data set of chunks (--index)";
                return Err(Error::argument(data.display().to_string(), expected, "none"));
            }
            (None, listed, index) => all.add_scenes(data, listed.as_ref().zip(index))?,
        }
        if all.cases.is_empty() {
            let expected = match index {
                Some(index) => format!("scenes that {} names", index.display()),
                None => "scenes with a protocol.json that has tests, or of at least 3 frames at \
                         different places"
                    .to_owned(),
            };
            return Err(Error::argument(data.display().to_string(), expected, "none"));
        }
        Ok(all)
    }

    fn add_chunks(&mut self, folder: &Path, listed: Index) -> Result<()> {
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
        // Sorted by file, so that each chunk is opened once.
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

    fn add_scenes(&mut self, data: &Path, listed: Option<(&Index, &Path)>) -> Result<()> {
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
        if self.cases.is_empty() && listed.is_none() {
            self.make_up_cases();
            without.retain(|name| !self.cases.iter().any(|c| c.scene == *name));
        }
        if !without.is_empty() && !self.cases.is_empty() {
            self.notes.push(format!("skipped, without tests: {}", without.join(", ")));
        }
        Ok(())
    }

    /// Adds a case for each scene with enough frames.
    fn make_up_cases(&mut self) {
        for (i, scene) in self.scenes.iter().enumerate() {
            let Some((views, step)) = made_up_views(scene) else { continue };
            let [first, last] = [views.context[0], views.context[1]];
            let inside = views.target.iter().all(|t| (first..last).contains(t));
            let place = if inside { "between" } else { "beside" };
            let targets = views.target.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
            let name = &scene.name;
            self.made_up.push(format!(
                "{name} has no protocol.json: inputs are frames {first} and {last}, which `run` \
                 chooses; targets are frames {targets}, one in {step} of those {place} them"
            ));
            self.cases.push(Case::new(name, views, None, Place::Scene(i)));
        }
    }

    /// Fixes ends of the depth range of every scene. Open ends are 1 and 100 for chunks. For
    /// scenes they come from the pose file, sparse points, or points that are matched between
    /// the inputs, as in [`Reconstructor::run`](subsplat::reconstruct::Reconstructor::run).
    pub fn set_depth_range(&mut self, range: DepthRange) {
        self.depth_range = range;
        self.cases.iter_mut().for_each(|c| c.bounds = OnceLock::new());
    }

    /// Replaces the cases by one for each scene: `count` frames spread over the sequence are its
    /// inputs, and the frames in the middle between two of them its targets. A tenth of the
    /// sequence at either end is left out. Scenes with fewer than 2·`count` − 1 frames in between
    /// have no case; [`Benchmark::notes`] names them. With `held` = K, every K-th frame is a target instead,
    /// the same ones for any number of inputs, which are spread over the others.
    ///
    /// # Errors
    /// Chunks instead of scenes; fewer than two inputs; no scene with enough frames.
    pub fn spread_contexts(&mut self, count: usize, held: Option<usize>) -> Result<()> {
        if self.chunks || count < 2 {
            let expected = "at least 2 inputs, and scenes instead of chunks";
            return Err(Error::argument("inputs of each case", expected, count.to_string()));
        }
        if let Some(every @ ..2) = held {
            let expected = "2 or more, so that inputs remain";
            return Err(Error::argument(
                "frames from one target to the next",
                expected,
                every.to_string(),
            ));
        }
        let (mut cases, mut short) = (Vec::new(), Vec::new());
        for (i, scene) in self.scenes.iter().enumerate() {
            let Some(views) = spread(&scene.usable(), count, held) else {
                short.push(scene.name.clone());
                continue;
            };
            let resolution = self.cases.iter().find(|c| c.scene == scene.name);
            let resolution = resolution.and_then(|c| c.resolution);
            cases.push(Case::new(&scene.name, views, resolution, Place::Scene(i)));
        }
        if cases.is_empty() {
            let frames = held.map_or(2 * count - 1, |every| count + count.div_ceil(every - 1));
            let expected = format!("a scene with {frames} frames or more");
            return Err(Error::argument("scenes", expected, "none"));
        }
        if !short.is_empty() {
            self.notes.push(format!("skipped, with too few frames: {}", short.join(", ")));
        }
        self.cases = cases;
        self.made_up.clear();
        Ok(())
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

    /// Keeps the cases of part `part` of `parts` equal parts, in order: processes that evaluate one part
    /// each evaluate every case once.
    ///
    /// # Errors
    /// No part of that number; a part without a case.
    pub fn keep_part(&mut self, part: usize, parts: usize) -> Result<()> {
        let at = |i: usize| self.cases.len() * i / parts.max(1);
        if part >= parts || at(part) == at(part + 1) {
            let expected =
                format!("one of {} cases in each part, counted from 0", self.cases.len());
            return Err(Error::argument("part of the cases", expected, format!("{part}/{parts}")));
        }
        let (first, end) = (at(part), at(part + 1));
        self.cases.truncate(end);
        self.cases.drain(..first);
        Ok(())
    }

    /// The cases, in the order of the scenes.
    pub fn cases(&self) -> &[Case] {
        &self.cases
    }

    /// Returns whether the data are pixelSplat's chunks.
    pub fn is_chunks(&self) -> bool {
        self.chunks
    }

    /// Skipped scenes, cases that are made up, and warnings of the readers, one line each.
    pub fn notes(&self) -> Vec<String> {
        let warnings = self.scenes.iter().flat_map(|s| &s.warnings);
        self.notes.iter().chain(&self.made_up).chain(warnings).cloned().collect()
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
            return Err(Error::argument(what, "at least 2 context frames and a target", got));
        }
        match &case.place {
            Place::Chunk(file) => self.load_from_chunk(case, file),
            Place::Scene(i) => match self.scenes.get(*i) {
                Some(scene) => self.load_from_scene(case, scene),
                None => Err(Error::argument(&case.scene, "a scene of this data set", "another")),
            },
        }
    }

    fn load_from_chunk(&self, case: &Case, file: &Path) -> Result<Loaded> {
        let chunk = self.chunk(file)?;
        let Some(video) = chunk.find(&case.scene) else {
            let what = file.display().to_string();
            let expected = format!("an example `{}`", case.scene.escape_debug());
            return Err(Error::argument(what, expected, "none"));
        };
        let photos = |frames: &[usize]| -> Result<Vec<Photo>> {
            frames.iter().map(|&f| photo(&chunk, video, f)).collect()
        };
        let names = case.views.target.iter().map(|f| format!("{f:06}")).collect();
        let bounds = DepthBounds::initial(&[], self.depth_range, Some(&DepthBounds::re10k()))?;
        let (context, targets) = (photos(&case.views.context)?, photos(&case.views.target)?);
        Ok(Loaded { context, targets, names, bounds, depth_range: self.depth_range })
    }

    fn load_from_scene(&self, case: &Case, scene: &Scene) -> Result<Loaded> {
        let frames = |list: &[usize]| {
            let frame = |&i: &usize| match scene.frames.get(i) {
                Some(frame) => Ok(Photo::from_frame(frame)?),
                None => Err(Error::argument(&scene.name, "a frame of the scene", i.to_string())),
            };
            list.iter().map(frame).collect::<Result<Vec<_>>>()
        };
        let (context, targets) = (frames(&case.views.context)?, frames(&case.views.target)?);
        let name = |&i: &usize| scene.frames.get(i).map_or_else(String::new, |f| f.name.clone());
        let names = case.views.target.iter().map(name).collect();
        let bounds = match case.bounds.get() {
            Some(bounds) => bounds.clone(),
            None => {
                let bounds = self.bounds_of_scene(case, scene, &context)?;
                case.bounds.get_or_init(|| bounds).clone()
            }
        };
        Ok(Loaded { context, targets, names, bounds, depth_range: self.depth_range })
    }

    /// The depth range of a scene's case. Points are matched only where it would be a guess.
    fn bounds_of_scene(&self, case: &Case, scene: &Scene, photos: &[Photo]) -> Result<DepthBounds> {
        let prior = DepthBounds::of_scene(scene, &case.views.context)?;
        let cameras: Vec<Camera> = photos.iter().map(|p| *p.camera()).collect();
        let guess = DepthBounds::initial(&cameras, self.depth_range, prior.as_ref())?;
        if !guess.source.is_guess() {
            return Ok(guess);
        }
        let reports = check_pairs(photos, |_| Ok(()))?;
        Ok(guess.refined(self.depth_range, &reports))
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

/// `count` inputs spread over the frames `usable` of a scene, and targets: the frames in the middle between two
/// inputs; with `held` = K every K-th frame, whatever the number of inputs, of which none is a target. `None`
/// where the frames are too few.
fn spread(usable: &[usize], count: usize, held: Option<usize>) -> Option<Views> {
    let Some(every) = held else {
        let margin = usable.len() / 10;
        let between = usable.len() - 2 * margin;
        if between < 2 * count - 1 {
            return None;
        }
        let at = |n: usize| margin + n * (between - 1) / (count - 1);
        let context: Vec<usize> = (0..count).map(at).collect();
        let target = context.windows(2).map(|pair| usable[(pair[0] + pair[1]) / 2]).collect();
        let context = context.into_iter().map(|n| usable[n]).collect();
        return Some(Views { context, target });
    };
    let is_target = |n: &usize| n % every == every / 2;
    let (target, rest): (Vec<usize>, Vec<usize>) = (0..usable.len()).partition(is_target);
    if rest.len() < count || target.is_empty() {
        return None;
    }
    let context = (0..count).map(|n| usable[rest[n * (rest.len() - 1) / (count - 1)]]).collect();
    Some(Views { context, target: target.into_iter().map(|n| usable[n]).collect() })
}

/// Makes up a scene's views, with the k of "every k-th frame": the pair that `subsplat run` chooses,
/// and at most [`MADE_UP_TARGETS`] of the frames between the two; of the others where there are none.
/// `None` for a scene of two frames, and without two frames at different places.
fn made_up_views(scene: &Scene) -> Option<(Views, usize)> {
    let pair = choose_pair(scene)?.frames;
    let mut rest = scene.usable();
    rest.retain(|i| !pair.contains(i));
    let between: Vec<usize> =
        rest.iter().copied().filter(|i| (pair[0]..pair[1]).contains(i)).collect();
    let from = if between.is_empty() { rest } else { between };
    let step = from.len().div_ceil(MADE_UP_TARGETS).max(1);
    // The middle of each group of `step` frames, so that targets are not beside an input.
    let target: Vec<usize> = from.iter().copied().skip((step - 1) / 2).step_by(step).collect();
    (!target.is_empty()).then(|| (Views { context: pair.to_vec(), target }, step))
}

fn photo(chunk: &Chunk, video: &Example, frame: usize) -> Result<Photo> {
    let (image, camera) = chunk.load(video, frame)?;
    Photo::new(image, camera)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_frames_are_the_same_for_any_number_of_inputs() {
        let frames: Vec<usize> = (100..120).collect();
        let views = |count| spread(&frames, count, Some(8)).unwrap();
        assert_eq!(views(3).target, [104, 112]);
        assert_eq!(views(3).context, [100, 109, 119]);
        for count in 2..=18 {
            let Views { context, target } = views(count);
            assert_eq!((context.len(), target), (count, vec![104, 112]));
            assert!(context.windows(2).all(|w| w[0] < w[1]), "{context:?}");
            assert!(!context.contains(&104) && !context.contains(&112), "{context:?}");
        }
        assert!(spread(&frames, 19, Some(8)).is_none() && spread(&frames, 2, Some(50)).is_none());
        let between = spread(&frames, 3, None).unwrap();
        assert_eq!((between.context, between.target), (vec![102, 109, 117], vec![105, 113]));
    }
}
