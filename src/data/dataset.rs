//! Training examples from data sets on disk, as a stream that a seed and an index
//! decide: pixelSplat's chunks (RealEstate10K, ACID) and folders of scenes in any
//! format of [`crate::io::scene`].
//!
//! One round (epoch) visits every scene once; chunks are shuffled, and scenes within
//! their chunk, as the reference loader does, so that consecutive examples come from
//! one file. Example `index` of seed `seed` is the same on every machine, for any
//! number of threads, and whatever was read before: a run that stops at an index goes on
//! from it.
//!
//! What the reference passes over is passed over here too: videos shorter than the gap
//! between the contexts, and videos with a frame wider than 100 degrees. The reference
//! also drops pictures that are not 360×640; here those are dropped that are smaller
//! than the target, which a crop could only enlarge, and pairs of a scene's frames that
//! nothing says near and far of because the camera stood still between them.

use super::chunks::{Chunk, NEAR_FAR, load_index};
use super::crop::{CropOptions, crop};
use super::depth::depth_range;
use super::procedural::rng::Rng;
use super::sampler::{Drawn, ViewSampler};
use crate::camera::{Camera, Intrinsics};
use crate::io::image::Rgb;
use crate::io::scene::{Scene, is_scene, load_scene};
use crate::io::{Error, Result};
use glam::{Mat4, Vec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Widest field of view that an example may have, degrees (pixelSplat's `max_fov`).
const FOV_MAX: f32 = 100.0;
/// Chunks kept open: enough for loaders that work on neighbouring indices.
const OPEN_CHUNKS: usize = 3;
/// Examples looked at beyond two rounds: what is passed over for the pair that was drawn
/// may serve with another.
const STILL_PAIRS: u64 = 64;
/// Keys that split the random numbers of one seed.
const KEY_ORDER: u64 = 1;
const KEY_EXAMPLE: u64 = 2;

/// A picture and its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// Display values.
    pub image: Rgb,
    /// Pinhole camera of these pixels.
    pub camera: Camera,
}

impl Posed {
    /// The view in a mirror: picture left to right, world and camera x negated, so that
    /// the mirrored world seen by the mirrored camera is the mirrored picture. The pose
    /// is S·E·S with S = diag(−1, 1, 1, 1) (MVSplat's augmentation); the principal point
    /// moves with the pixels (MVSplat leaves it, which is the same where it is centred).
    #[must_use]
    pub fn flipped(&self) -> Self {
        let k = self.camera.intrinsics;
        let Rgb { width, height, .. } = self.image;
        let mut image = Rgb::black(width, height);
        let rows = image.data.chunks_exact_mut(3 * width.max(1));
        for (to, from) in rows.zip(self.image.data.chunks_exact(3 * width.max(1))) {
            let pixels = to.chunks_exact_mut(3).zip(from.chunks_exact(3).rev());
            pixels.for_each(|(to, from)| to.copy_from_slice(from));
        }
        let intrinsics = Intrinsics { cx: k.width as f32 - k.cx, ..k };
        let mirror = Mat4::from_scale(Vec3::new(-1.0, 1.0, 1.0));
        let world_from_camera = mirror * self.camera.world_from_camera * mirror;
        Self { image, camera: Camera { intrinsics, world_from_camera } }
    }
}

/// What one step learns from: two inputs and the pictures to be predicted.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingExample {
    /// Name of the video or the scene.
    pub name: String,
    /// Which of its frames these are.
    pub frames: Drawn,
    /// The network's inputs, all of one size.
    pub context: Vec<Posed>,
    /// What the renders are compared with, r times the inputs' size.
    pub targets: Vec<Posed>,
    /// Nearest and farthest depth candidate, world units.
    pub near_far: (f32, f32),
    /// Whether pictures and poses were mirrored.
    pub flipped: bool,
}

impl TrainingExample {
    /// All views in a mirror ([`Posed::flipped`]).
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

/// How examples are made.
#[derive(Clone, Debug, PartialEq)]
pub struct ExampleOptions {
    /// Choice of frames.
    pub sampler: ViewSampler,
    /// Sizes, and the reference crop or ours.
    pub crop: CropOptions,
    /// Mirror half of the examples.
    pub flip: bool,
    /// Nearest and farthest depth candidate; without: chunks 1 and 100, scenes by
    /// [`depth_range`].
    pub near_far: Option<(f32, f32)>,
}

enum Source {
    /// Files in order, with the keys that they hold.
    Chunks(Vec<(PathBuf, Vec<String>)>),
    Scenes(Vec<Scene>),
}

/// Order of one round: pairs (file, scene in it).
type Order = Arc<Vec<(u32, u32)>>;

/// A data set on disk.
pub struct Dataset {
    root: PathBuf,
    source: Source,
    options: ExampleOptions,
    /// The order used last, with its seed and round.
    order: Mutex<Option<(u64, u64, Order)>>,
    open: Mutex<Vec<(usize, Arc<Chunk>)>>,
}

/// The folder of chunks that `path` means: itself, or its part `split` (`train`,
/// `test`); `None` where there is no `index.json`.
pub fn chunk_folder(path: &Path, split: &str) -> Option<PathBuf> {
    let folders = [path.to_owned(), path.join(split)];
    folders.into_iter().find(|f| f.join("index.json").is_file())
}

/// What [`load_scene`] takes of `path`: itself, or its folders that are scenes, by name.
///
/// # Errors
/// No scene at all; a folder that cannot be listed.
pub fn scene_paths(path: &Path) -> Result<Vec<PathBuf>> {
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
    /// Opens chunks (`path` or `path/train` has an `index.json`), a scene, or a folder of
    /// scenes.
    ///
    /// # Errors
    /// None of these; an index or a scene that is broken.
    pub fn open(path: &Path, options: ExampleOptions) -> Result<Self> {
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
                Source::Scenes(paths.iter().map(|p| load_scene(p)).collect::<Result<_>>()?)
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

    /// Number of scenes: the length of a round.
    pub fn len(&self) -> usize {
        match &self.source {
            Source::Chunks(files) => files.iter().map(|(_, keys)| keys.len()).sum(),
            Source::Scenes(scenes) => scenes.len(),
        }
    }

    /// Never: a data set without scenes is refused when it is opened.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Warnings of the scenes' readers, one line each.
    pub fn warnings(&self) -> Vec<String> {
        match &self.source {
            Source::Chunks(_) => Vec::new(),
            Source::Scenes(scenes) => scenes.iter().flat_map(|s| s.warnings.clone()).collect(),
        }
    }

    /// Which file, and which of its scenes, position `at` of round `round` visits.
    fn visited(&self, seed: u64, round: u64, at: usize) -> (usize, usize) {
        let mut kept = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        let order = match &*kept {
            Some((s, r, order)) if (*s, *r) == (seed, round) => Arc::clone(order),
            _ => {
                let order = Arc::new(self.order(seed, round));
                *kept = Some((seed, round, Arc::clone(&order)));
                order
            }
        };
        drop(kept);
        order.get(at).map_or((0, 0), |(file, scene)| (*file as usize, *scene as usize))
    }

    fn order(&self, seed: u64, round: u64) -> Vec<(u32, u32)> {
        let mut rng = Rng::new(seed).fork(KEY_ORDER).fork(round);
        let shuffled = |n: usize, rng: &mut Rng| {
            let mut all: Vec<u32> = (0..n as u32).collect();
            (1..n).rev().for_each(|i| all.swap(i, rng.count(0, i)));
            all
        };
        let Source::Chunks(files) = &self.source else {
            return shuffled(self.len(), &mut rng).into_iter().map(|i| (0, i)).collect();
        };
        let mut order = Vec::with_capacity(self.len());
        for file in shuffled(files.len(), &mut rng) {
            let keys = files.get(file as usize).map_or(0, |(_, keys)| keys.len());
            order.extend(shuffled(keys, &mut rng).into_iter().map(|scene| (file, scene)));
        }
        order
    }

    /// Example `index` of the stream of `seed`, with the sampler at training step
    /// `step`; `None` where the stream passes over the scene (see the module's text).
    ///
    /// # Errors
    /// A file that is missing or broken; a key that its chunk does not hold.
    pub fn example(&self, seed: u64, index: u64, step: usize) -> Result<Option<TrainingExample>> {
        let scenes = self.len().max(1) as u64;
        let place = self.visited(seed, index / scenes, (index % scenes) as usize);
        let mut rng = Rng::new(seed).fork(KEY_EXAMPLE).fork(index);
        let frames_seed = rng.bits();
        let example = match &self.source {
            Source::Chunks(files) => self.of_chunk(files, place, (step, frames_seed))?,
            Source::Scenes(scenes) => match scenes.get(place.1) {
                Some(scene) => self.of_scene(scene, (step, frames_seed))?,
                None => None,
            },
        };
        let flip = self.options.flip && rng.chance(0.5);
        Ok(example.map(|e| if flip { e.flipped() } else { e }))
    }

    /// The example of `index` or, where the stream passes over it, the first after it, and
    /// its index.
    ///
    /// # Errors
    /// Those of [`Dataset::example`]; none in a whole round.
    pub fn serve(&self, seed: u64, index: u64, step: usize) -> Result<(u64, TrainingExample)> {
        // The one usable scene may be the first of a round and the last of the next, and
        // its first pairs may be taken where the camera stood still.
        for at in index..index + 2 * self.len() as u64 + STILL_PAIRS {
            if let Some(example) = self.example(seed, at, step)? {
                return Ok((at, example));
            }
        }
        let ExampleOptions { sampler, crop, .. } = &self.options;
        let ((w, h), r) = (crop.input_size, crop.upscale);
        let expected = format!(
            "a scene of more than {} frames of at least {}x{} pixels, none wider than {FOV_MAX} \
             degrees, with a camera that moves or near and far given",
            sampler.bounds(step).0,
            w * r,
            h * r
        );
        let got = format!("none among {}", self.len());
        Err(Error::format(&self.root, expected, got))
    }

    /// The stream of `seed` from `index` on.
    pub fn stream(&self, seed: u64, index: u64) -> Stream<'_> {
        Stream { dataset: self, seed, index }
    }

    fn of_chunk(
        &self,
        files: &[(PathBuf, Vec<String>)],
        (file, scene): (usize, usize),
        (step, seed): (usize, u64),
    ) -> Result<Option<TrainingExample>> {
        let Some((path, keys)) = files.get(file) else { return Ok(None) };
        let Some(key) = keys.get(scene) else { return Ok(None) };
        let chunk = self.chunk(file, path)?;
        let Some(video) = chunk.find(key) else {
            let expected = format!("an example `{}`, as index.json says", key.escape_debug());
            return Err(Error::format(path, expected, "none"));
        };
        let wide = |k: &Intrinsics| k.fov_x().max(k.fov_y()).to_degrees() > FOV_MAX;
        let mut units = video.cameras.iter().map(|c| c.camera(1, 1).intrinsics);
        if units.any(|k| wide(&k)) {
            return Ok(None);
        }
        let Some(drawn) = self.options.sampler.draw(video.frames(), step, seed) else {
            return Ok(None);
        };
        let near_far = self.options.near_far.unwrap_or(NEAR_FAR);
        self.cropped(key, drawn, near_far, &|frame| chunk.load(video, frame))
    }

    fn of_scene(
        &self,
        scene: &Scene,
        (step, seed): (usize, u64),
    ) -> Result<Option<TrainingExample>> {
        let Some(drawn) = self.options.sampler.draw(scene.frames.len(), step, seed) else {
            return Ok(None);
        };
        let near_far = match self.options.near_far {
            Some(given) => given,
            // Its frames and near_far are checked, so that this says: the camera stood still.
            None => match depth_range(scene, &drawn.context, (None, None)) {
                Ok(range) => (range.near, range.far),
                Err(_) => return Ok(None),
            },
        };
        let load = |frame: usize| match scene.frames.get(frame) {
            Some(frame) => frame.load(),
            None => Err(Error::format(&scene.name, "a frame of the scene", frame.to_string())),
        };
        self.cropped(&scene.name, drawn, near_far, &load)
    }

    fn cropped(
        &self,
        name: &str,
        frames: Drawn,
        near_far: (f32, f32),
        load: &dyn Fn(usize) -> Result<(Rgb, Camera)>,
    ) -> Result<Option<TrainingExample>> {
        let options = &self.options.crop;
        let (w, h) = options.input_size;
        let least = (w.saturating_mul(options.upscale), h.saturating_mul(options.upscale));
        let (mut context, mut targets) = (Vec::new(), Vec::new());
        for (i, &frame) in frames.context.iter().chain(&frames.targets).enumerate() {
            let (photo, camera) = load(frame)?;
            if photo.width < least.0 || photo.height < least.1 {
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

    fn chunk(&self, file: usize, path: &Path) -> Result<Arc<Chunk>> {
        let lock = || self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, chunk)) = lock().iter().find(|(f, _)| *f == file) {
            return Ok(Arc::clone(chunk));
        }
        // Read outside the lock: another loader may read another chunk meanwhile.
        let chunk = Arc::new(Chunk::open(path)?);
        let mut open = lock();
        open.insert(0, (file, Arc::clone(&chunk)));
        open.truncate(OPEN_CHUNKS);
        Ok(chunk)
    }
}

/// Examples one after the other.
pub struct Stream<'a> {
    dataset: &'a Dataset,
    seed: u64,
    index: u64,
}

impl Stream<'_> {
    /// Index of the next example: where a stopped run goes on.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// The next example, passing over what [`Dataset::example`] passes over.
    ///
    /// # Errors
    /// Those of [`Dataset::serve`].
    pub fn next_example(&mut self, step: usize) -> Result<TrainingExample> {
        let (at, example) = self.dataset.serve(self.seed, self.index, step)?;
        self.index = at + 1;
        Ok(example)
    }
}
