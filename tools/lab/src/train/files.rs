//! Training examples from pictures on disk ([`Dataset`]): chunks of videos, folders of scenes.

use super::config::TrainConfig;
use super::source::{Example, InputTargets, Source};
use super::{Error, Result};
use crate::data::dataset::{Dataset, ExampleOptions};
use crate::data::sampler::{GapBounds, GapMode, ViewSampler};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::Arc;
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule};
use subsplat_kernels::camera::{NearFar, Size};

/// A data set and its selection of frames. The defaults are MVSplat's `re10k`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Files {
    /// Chunks (`index.json`, or `train/index.json`), a scene, or a folder of scenes.
    pub path: PathBuf,
    /// Interpretation of the gap between the context frames.
    #[serde(default)]
    pub mode: GapMode,
    /// Bounds of the gap at step 0, frames.
    #[serde(default = "first")]
    pub first: [usize; 2],
    /// Bounds of the gap from step `gap_steps` on, frames.
    #[serde(default = "last")]
    pub last: [usize; 2],
    /// Steps over which the bounds grow.
    #[serde(default = "gap_steps")]
    pub gap_steps: usize,
    /// Keeps the principal point's fraction of width and height, as the reference's crop does. If
    /// false, the principal point moves with the pixels.
    #[serde(default)]
    pub reference_crop: bool,
    /// Nearest and farthest depth candidate. The default is 1 and 100 for chunks; for scenes it
    /// derives from their points or cameras.
    #[serde(default)]
    pub near_far: Option<[f32; 2]>,
}

fn first() -> [usize; 2] {
    let GapBounds { low, high } = ViewSampler::re10k(GapMode::Mvs).first;
    [low, high]
}

fn last() -> [usize; 2] {
    let GapBounds { low, high } = ViewSampler::re10k(GapMode::Mvs).last;
    [low, high]
}

fn gap_steps() -> usize {
    ViewSampler::re10k(GapMode::Mvs).steps
}

/// Exclusive upper bound of a gap: more frames than any video has.
const FRAMES_END: usize = 1 << 31;

impl Files {
    /// Validates the ranges.
    ///
    /// # Errors
    /// The first key out of range.
    pub fn check(&self) -> Result<()> {
        for (key, [low, high]) in [("data.files.first", self.first), ("data.files.last", self.last)]
        {
            if low == 0 || high < low || high >= FRAMES_END {
                let expected = format!("[low, high] with 1 <= low <= high < {FRAMES_END}");
                return Err(Error::value(key, expected, format!("[{low}, {high}]")));
            }
        }
        match self.near_far {
            Some([near, far]) if !NearFar::new(near, far).is_valid() => {
                let got = format!("[{near}, {far}]");
                Err(Error::value("data.files.near_far", "[near, far] with 0 < near < far", got))
            }
            _ => Ok(()),
        }
    }
}

/// The stream of a [`Dataset`]. An example that the data set skips is replaced by the next usable
/// example.
pub struct Pictures {
    dataset: Dataset,
    seed: u64,
    /// Examples of one step.
    per_step: u64,
    /// Number of times that each example is used.
    replay: u64,
}

impl Pictures {
    /// Opens the data set of `files` for the training of `config`.
    ///
    /// # Errors
    /// A missing data set; an index or a scene that cannot be parsed.
    pub fn open(files: &Files, config: &TrainConfig) -> Result<Self> {
        let model = config.model_config()?;
        let bounds = |[low, high]: [usize; 2]| GapBounds { low, high };
        let sampler = ViewSampler {
            mode: files.mode,
            first: bounds(files.first),
            last: bounds(files.last),
            steps: files.gap_steps,
            targets: config.data.targets,
        };
        let [w, h] = config.data.input;
        let rule = if files.reference_crop { CropRule::Mvsplat } else { CropRule::Exact };
        let exact = CropOptions::new(Size::new(w, h), model.upscale, model.stride());
        let options = ExampleOptions {
            sampler,
            crop: CropOptions { rule, ..exact },
            // The loader mirrors the examples of every source.
            flip: false,
            near_far: files.near_far.map(|[near, far]| NearFar { near, far }),
        };
        let dataset = Dataset::open(&files.path, options)?;
        Ok(Self {
            dataset,
            seed: config.data.seed,
            per_step: config.examples_per_step().max(1),
            replay: config.data.replay,
        })
    }
}

impl Source for Pictures {
    fn example(&self, index: u64) -> Result<Arc<Example>> {
        let step = index.saturating_mul(self.replay) / self.per_step;
        let step = usize::try_from(step).unwrap_or(usize::MAX);
        let (_, example) = self.dataset.example_from(self.seed, index, step)?;
        Ok(Arc::new(Example {
            context: example.context,
            targets: example.targets,
            inverse_depth: Vec::new(),
            near_far: example.near_far,
            input_targets: InputTargets::Absent,
        }))
    }

    fn warnings(&self) -> Vec<String> {
        self.dataset.warnings()
    }
}
