//! Training examples from data sets on disk: pixelSplat's chunks (RealEstate10K, ACID) and folders
//! of scenes in any format of [`subsplat::files::poses::scene`].
//!
//! The examples form a stream. One round (epoch) visits every scene once. Chunks are shuffled, and
//! scenes are shuffled within their chunk, as in the reference loader, so that consecutive examples
//! come from one file. Example `index` of seed `seed` is the same on every machine, for any number
//! of threads, and for any order of reading. A run that stopped at an index continues from it.
//!
//! The stream skips the videos that the reference skips: videos shorter than the gap between the
//! context frames, and videos with a frame wider than 100 degrees. The reference also drops
//! pictures that are not 360×640. This stream instead drops pictures smaller than the target, which
//! a crop would have to enlarge. It also skips pairs without a baseline whose near and far are
//! unknown.

use super::chunks::{Chunk, ChunkCamera, load_index};
use super::procedural::rng::Rng;
use super::sampler::{SampledFrames, ViewSampler};
use glam::{Mat4, Vec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use subsplat::files::poses::scene::{Scene, is_scene, load_scene};
use subsplat::files::{Error, Result};
use subsplat::reconstruct::inputs::crop::{CropOptions, crop};
use subsplat::reconstruct::{DepthBounds, DepthRange};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar, Size};

/// Widest field of view of an example, degrees (pixelSplat's `max_fov`).
const FOV_MAX: f32 = 100.0;
/// Number of chunks that stay open. Loaders work on neighbouring indices and need few.
const OPEN_CHUNKS: usize = 3;
/// Indices tried beyond two rounds. A scene that is skipped for one pair of frames may be usable
/// with another.
const EXTRA_ATTEMPTS: u64 = 64;
/// Key of the random numbers that order the scenes.
const KEY_ORDER: u64 = 1;
/// Key of the random numbers that select frames and mirroring.
const KEY_EXAMPLE: u64 = 2;

/// A picture and its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// Picture, display values.
    pub image: Rgb,
    /// Pinhole camera of this picture.
    pub camera: Camera,
}

impl Posed {
    /// Mirrors the picture left to right, together with camera and world, so that the mirrored
    /// camera sees the mirrored picture in the mirrored world.
    ///
    /// The pose becomes S·E·S with S = diag(−1, 1, 1, 1) (MVSplat's augmentation). The principal
    /// point moves with the pixels; MVSplat leaves it, which is equal for a centred one.
    #[must_use]
    pub fn flipped(&self) -> Self {
        let k = self.camera.intrinsics();
        let Rgb { width, height, .. } = self.image;
        let mut image = Rgb::black(width, height);
        let rows = image.data.chunks_exact_mut(3 * width.max(1));
        for (to, from) in rows.zip(self.image.data.chunks_exact(3 * width.max(1))) {
            let pixels = to.chunks_exact_mut(3).zip(from.chunks_exact(3).rev());
            pixels.for_each(|(to, from)| to.copy_from_slice(from));
        }
        let intrinsics = Intrinsics { cx: k.width as f32 - k.cx, ..k };
        let mirror = Mat4::from_scale(Vec3::new(-1.0, 1.0, 1.0));
        let world_from_camera = mirror * self.camera.world_from_camera() * mirror;
        Self { image, camera: Camera::new_unchecked(intrinsics, world_from_camera) }
    }
}

/// Data of one training step: two inputs and the pictures to predict.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingExample {
    /// Name of the video or the scene.
    pub name: String,
    /// Indices of the frames.
    pub frames: SampledFrames,
    /// The network's inputs, all of one size.
    pub context: Vec<Posed>,
    /// Pictures to predict, r times the inputs' size.
    pub targets: Vec<Posed>,
    /// Nearest and farthest depth candidate, world units.
    pub near_far: NearFar,
    /// True if pictures and poses are mirrored.
    pub flipped: bool,
}

impl TrainingExample {
    /// Mirrors all views ([`Posed::flipped`]).
    #[must_use]
    pub fn flipped(&self) -> Self {
        let all = |views: &[Posed]| views.iter().map(Posed::flipped).collect();
        Self {
            context: all(&self.context),
            targets: all(&self.targets),
            flipped: !self.flipped,
            ..self.clone()
        }
    }
}

/// Options of the examples.
#[derive(Clone, Debug, PartialEq)]
pub struct ExampleOptions {
    /// Selection of frames.
    pub sampler: ViewSampler,
    /// Sizes and the rule of the crop.
    pub crop: CropOptions,
    /// Mirrors half of the examples.
    pub flip: bool,
    /// Nearest and farthest depth candidate. The default is 1 and 100 for chunks and
    /// [`DepthBounds::of_frames`] for scenes.
    pub near_far: Option<NearFar>,
}

/// Storage of the scenes.
enum Source {
    /// Chunk files in order, with their keys.
    Chunks(Vec<(PathBuf, Vec<String>)>),
    /// Folders of scenes.
    Scenes(Vec<Scene>),
}

/// Position of a scene in the data set.
#[derive(Clone, Copy, Debug, Default)]
struct ScenePosition {
    /// Index of the file; 0 for folders of scenes.
    file: u32,
    /// Index of the scene in its file.
    scene: u32,
}

/// The order of one round, with the seed and the round that determine it.
#[derive(Clone)]
struct RoundOrder {
    seed: u64,
    round: u64,
    order: Arc<Vec<ScenePosition>>,
}

/// Arguments of the sampler for one example.
#[derive(Clone, Copy)]
struct FrameDraw {
    /// Training step.
    step: usize,
    /// Seed of the frames.
    seed: u64,
}

/// A data set on disk.
pub struct Dataset {
    root: PathBuf,
    source: Source,
    options: ExampleOptions,
    /// The order used last.
    order: Mutex<Option<RoundOrder>>,
    /// Open chunks with their file indices, the most recent first.
    open: Mutex<Vec<(usize, Arc<Chunk>)>>,
}

/// Returns the folder of chunks at `path` or at `path/split` (`train`, `test`). Returns `None`
/// where neither has an `index.json`.
pub fn chunk_folder(path: impl AsRef<Path>, split: &str) -> Option<PathBuf> {
    let path = path.as_ref();
    let folders = [path.to_owned(), path.join(split)];
    folders.into_iter().find(|f| f.join("index.json").is_file())
}

/// Returns the paths for [`load_scene`]: `path` itself, or its folders that are scenes, sorted by
/// name.
///
/// # Errors
/// A folder without any scene; a folder that cannot be listed.
pub fn scene_paths(path: impl AsRef<Path>) -> Result<Vec<PathBuf>> {
    list_scenes(path.as_ref())
}

fn list_scenes(path: &Path) -> Result<Vec<PathBuf>> {
    if path.is_file() || is_scene(path) {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).map_err(|e| Error::io(path, e))?;
    let mut folders: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    folders.retain(|f| f.is_dir() && is_scene(f));
    folders.sort();
    if folders.is_empty() {
        let expected = "a scene, a folder of scenes, or chunks with index.json";
        return Err(Error::format(path, expected, "a folder with none of them"));
    }
    Ok(folders)
}

impl Dataset {
    /// Opens chunks (`path` or `path/train` has an `index.json`), a scene, or a folder of scenes.
    ///
    /// # Errors
    /// None of these; an index or a scene that cannot be parsed.
    pub fn open(path: impl AsRef<Path>, options: ExampleOptions) -> Result<Self> {
        Self::open_at(path.as_ref(), options)
    }

    fn open_at(path: &Path, options: ExampleOptions) -> Result<Self> {
        let source = match chunk_folder(path, "train") {
            Some(folder) => {
                let mut files: BTreeMap<PathBuf, Vec<String>> = BTreeMap::new();
                for (key, file) in load_index(&folder)? {
                    files.entry(file).or_default().push(key);
                }
                if files.is_empty() {
                    let index = folder.join("index.json");
                    return Err(Error::format(index, "at least one example", "none"));
                }
                Source::Chunks(files.into_iter().collect())
            }
            None => {
                let paths = scene_paths(path)?;
                Source::Scenes(paths.iter().map(load_scene).collect::<Result<_>>()?)
            }
        };
        Ok(Self {
            root: path.to_owned(),
            source,
            options,
            order: Mutex::default(),
            open: Mutex::default(),
        })
    }

    /// Returns the number of scenes, which is the length of a round.
    pub fn len(&self) -> usize {
        match &self.source {
            Source::Chunks(files) => files.iter().map(|(_, keys)| keys.len()).sum(),
            Source::Scenes(scenes) => scenes.len(),
        }
    }

    /// Returns false: `open` refuses a data set without scenes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the warnings of the scenes' readers, one line each.
    pub fn warnings(&self) -> Vec<String> {
        match &self.source {
            Source::Chunks(_) => Vec::new(),
            Source::Scenes(scenes) => scenes.iter().flat_map(|s| s.warnings.clone()).collect(),
        }
    }

    /// Returns the scene at `index` of round `round`.
    fn scene_at(&self, seed: u64, round: u64, index: usize) -> ScenePosition {
        let mut cached = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        let order = match &*cached {
            Some(o) if (o.seed, o.round) == (seed, round) => Arc::clone(&o.order),
            _ => {
                let order = Arc::new(self.order(seed, round));
                *cached = Some(RoundOrder { seed, round, order: Arc::clone(&order) });
                order
            }
        };
        drop(cached);
        order.get(index).copied().unwrap_or_default()
    }

    /// Computes the order of a round.
    fn order(&self, seed: u64, round: u64) -> Vec<ScenePosition> {
        let mut rng = Rng::new(seed).fork(KEY_ORDER).fork(round);
        let shuffled = |n: usize, rng: &mut Rng| {
            let mut all: Vec<u32> = (0..n as u32).collect();
            (1..n).rev().for_each(|i| all.swap(i, rng.count(0, i)));
            all
        };
        let Source::Chunks(files) = &self.source else {
            let scenes = shuffled(self.len(), &mut rng).into_iter();
            return scenes.map(|scene| ScenePosition { file: 0, scene }).collect();
        };
        let mut order = Vec::with_capacity(self.len());
        for file in shuffled(files.len(), &mut rng) {
            let keys = files.get(file as usize).map_or(0, |(_, keys)| keys.len());
            let scenes = shuffled(keys, &mut rng).into_iter();
            order.extend(scenes.map(|scene| ScenePosition { file, scene }));
        }
        order
    }

    /// Returns example `index` of the stream of `seed`, with the sampler at training step `step`.
    /// Returns `None` where the stream skips the scene.
    ///
    /// # Errors
    /// A file that is missing or cannot be parsed; a key that its chunk does not hold.
    pub fn example(&self, seed: u64, index: u64, step: usize) -> Result<Option<TrainingExample>> {
        let scenes = self.len().max(1) as u64;
        let position = self.scene_at(seed, index / scenes, (index % scenes) as usize);
        let mut rng = Rng::new(seed).fork(KEY_EXAMPLE).fork(index);
        let draw = FrameDraw { step, seed: rng.bits() };
        let example = match &self.source {
            Source::Chunks(files) => self.chunk_example(files, position, draw)?,
            Source::Scenes(scenes) => match scenes.get(position.scene as usize) {
                Some(scene) => self.scene_example(scene, draw)?,
                None => None,
            },
        };
        let flip = self.options.flip && rng.chance(0.5);
        Ok(example.map(|e| if flip { e.flipped() } else { e }))
    }

    /// Returns the first example at or after `index` that the stream does not skip, with its index.
    ///
    /// # Errors
    /// As [`Dataset::example`]; no usable example within two rounds.
    pub fn example_from(
        &self,
        seed: u64,
        index: u64,
        step: usize,
    ) -> Result<(u64, TrainingExample)> {
        // A single usable scene may be the first of a round and the last of the next. Its first
        // pairs may lack a baseline.
        for at in index..index + 2 * self.len() as u64 + EXTRA_ATTEMPTS {
            if let Some(example) = self.example(seed, at, step)? {
                return Ok((at, example));
            }
        }
        let ExampleOptions { sampler, crop, .. } = &self.options;
        let Size { width: w, height: h } = crop.target_size;
        let expected = format!(
            "a scene of more than {} frames of at least {}x{} pixels, none wider than {FOV_MAX} \
             degrees, with a camera that moves or with near and far",
            sampler.bounds(step).low,
            w,
            h
        );
        let got = format!("none among {}", self.len());
        Err(Error::format(&self.root, expected, got))
    }

    /// Returns the stream of `seed`, starting at `index`.
    pub fn stream(&self, seed: u64, index: u64) -> Stream<'_> {
        Stream { dataset: self, seed, index }
    }

    /// Reads an example of a video; `None` where the stream skips the video.
    fn chunk_example(
        &self,
        files: &[(PathBuf, Vec<String>)],
        position: ScenePosition,
        draw: FrameDraw,
    ) -> Result<Option<TrainingExample>> {
        let file = position.file as usize;
        let Some((path, keys)) = files.get(file) else { return Ok(None) };
        let Some(key) = keys.get(position.scene as usize) else { return Ok(None) };
        let chunk = self.chunk(file, path)?;
        let Some(video) = chunk.find(key) else {
            let expected = format!("an example `{}`, as index.json says", key.escape_debug());
            return Err(Error::format(path, expected, "none"));
        };
        let wide = |k: &Intrinsics| k.fov_x().max(k.fov_y()).to_degrees() > FOV_MAX;
        let unit = |c: &ChunkCamera| Intrinsics::from_normalised(c.normalised, 1, 1);
        let mut units = video.cameras.iter().map(unit);
        if units.any(|k| wide(&k)) {
            return Ok(None);
        }
        let sampler = &self.options.sampler;
        let Some(frames) = sampler.sample(video.frames(), draw.step, draw.seed) else {
            return Ok(None);
        };
        let near_far = self.options.near_far.unwrap_or(NearFar::RE10K);
        self.cropped(key, frames, near_far, &|frame| chunk.load(video, frame))
    }

    /// Reads an example of a scene; `None` where the stream skips the pair of frames.
    fn scene_example(&self, scene: &Scene, draw: FrameDraw) -> Result<Option<TrainingExample>> {
        let sampler = &self.options.sampler;
        let Some(frames) = sampler.sample(scene.frames.len(), draw.step, draw.seed) else {
            return Ok(None);
        };
        let near_far = match self.options.near_far {
            Some(range) => range,
            // Frames and near_far are already validated: the error means a zero baseline.
            None => match DepthBounds::of_frames(scene, &frames.context, DepthRange::Auto) {
                Ok(bounds) => bounds.near_far(),
                Err(_) => return Ok(None),
            },
        };
        let load = |frame: usize| match scene.frames.get(frame) {
            Some(frame) => frame.load(),
            None => Err(Error::format(&scene.name, "a frame of the scene", frame.to_string())),
        };
        self.cropped(&scene.name, frames, near_far, &load)
    }

    /// Loads and crops the frames; `None` for pictures smaller than the target.
    fn cropped(
        &self,
        name: &str,
        frames: SampledFrames,
        near_far: NearFar,
        load: &dyn Fn(usize) -> Result<(Rgb, Camera)>,
    ) -> Result<Option<TrainingExample>> {
        let options = &self.options.crop;
        let Size { width: w, height: h } = options.target_size;
        let min_size = (w, h);
        let (mut context, mut targets) = (Vec::new(), Vec::new());
        for (i, &frame) in frames.context.iter().chain(&frames.targets).enumerate() {
            let (photo, camera) = load(frame)?;
            if photo.width < min_size.0 || photo.height < min_size.1 {
                return Ok(None);
            }
            let c = crop(&photo, &camera, options)?;
            if i < frames.context.len() {
                context.push(Posed { image: c.input, camera: c.input_camera });
            } else {
                targets.push(Posed { image: c.target, camera: c.target_camera });
            }
        }
        let name = name.to_owned();
        Ok(Some(TrainingExample { name, frames, context, targets, near_far, flipped: false }))
    }

    /// Returns an open chunk, from the cache where possible.
    fn chunk(&self, file: usize, path: &Path) -> Result<Arc<Chunk>> {
        let lock = || self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, chunk)) = lock().iter().find(|(f, _)| *f == file) {
            return Ok(Arc::clone(chunk));
        }
        // The chunk is opened outside the lock, so that other loaders can open theirs.
        let chunk = Arc::new(Chunk::open(path)?);
        let mut open = lock();
        open.insert(0, (file, Arc::clone(&chunk)));
        open.truncate(OPEN_CHUNKS);
        Ok(chunk)
    }
}

/// A sequence of examples.
pub struct Stream<'a> {
    dataset: &'a Dataset,
    seed: u64,
    index: u64,
}

impl Stream<'_> {
    /// Returns the index of the next example, from which a stopped run continues.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// Returns the next example that the stream does not skip.
    ///
    /// # Errors
    /// As [`Dataset::example_from`].
    pub fn next_example(&mut self, step: usize) -> Result<TrainingExample> {
        let (at, example) = self.dataset.example_from(self.seed, self.index, step)?;
        self.index = at + 1;
        Ok(example)
    }
}
