//! Examples from pictures on disk ([`Dataset`]): chunks of videos, folders of scenes.

use super::config::TrainConfig;
use super::source::{Example, Source};
use super::{Error, Result};
use crate::data::crop::{CropOptions, CropRule};
use crate::data::dataset::{Dataset, ExampleOptions};
use crate::data::sampler::{GapMode, ViewSampler};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::Arc;

/// A data set, and how its frames are chosen. Defaults: MVSplat's `re10k`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Files {
    /// Chunks (`index.json`, or `train/index.json`), a scene, or a folder of scenes.
    pub path: PathBuf,
    /// Reading of the gap between the context frames.
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
    /// Keep the principal point's fraction of width and height, as the reference's crop
    /// does; else it moves with the pixels.
    #[serde(default)]
    pub reference_crop: bool,
    /// Nearest and farthest depth candidate; without: chunks 1 and 100, scenes by their
    /// points or their cameras.
    #[serde(default)]
    pub near_far: Option<[f32; 2]>,
}

fn first() -> [usize; 2] {
    let (low, high) = ViewSampler::re10k(GapMode::Mvs).first;
    [low, high]
}

fn last() -> [usize; 2] {
    let (low, high) = ViewSampler::re10k(GapMode::Mvs).last;
    [low, high]
}

fn gap_steps() -> usize {
    ViewSampler::re10k(GapMode::Mvs).steps
}

/// More frames than any video has.
const FRAMES_END: usize = 1 << 31;

impl Files {
    /// Checks ranges.
    ///
    /// # Errors
    /// The first key that is out of range.
    pub fn check(&self) -> Result<()> {
        for (key, [low, high]) in [("data.files.first", self.first), ("data.files.last", self.last)]
        {
            if low == 0 || high < low || high >= FRAMES_END {
                let expected = format!("[low, high] with 1 <= low <= high < {FRAMES_END}");
                return Err(Error::value(key, expected, format!("[{low}, {high}]")));
            }
        }
        match self.near_far {
            Some([near, far]) if !(near > 0.0 && far > near && far.is_finite()) => {
                let got = format!("[{near}, {far}]");
                Err(Error::value("data.files.near_far", "[near, far] with 0 < near < far", got))
            }
            _ => Ok(()),
        }
    }
}

/// The stream of a [`Dataset`]. An example that the data set passes over is replaced by
/// the next one that it does not.
pub struct Pictures {
    dataset: Dataset,
    seed: u64,
    /// Examples of one step, and how often each of this stream is shown: from them an index
    /// tells its step.
    per_step: u64,
    replay: u64,
}

impl Pictures {
    /// Opens the data set of `files` for the training of `config`.
    ///
    /// # Errors
    /// No data set there; an index or a scene that is broken.
    pub fn open(files: &Files, config: &TrainConfig) -> Result<Self> {
        let model = config.model_config()?;
        let pair = |[low, high]: [usize; 2]| (low, high);
        let sampler = ViewSampler {
            mode: files.mode,
            first: pair(files.first),
            last: pair(files.last),
            steps: files.gap_steps,
            targets: config.data.targets,
        };
        let [w, h] = config.data.input;
        let rule = if files.reference_crop { CropRule::Mvsplat } else { CropRule::Exact };
        let square = CropOptions::square(w, model.upscale, model.stride());
        let options = ExampleOptions {
            sampler,
            crop: CropOptions { input_size: (w, h), rule, ..square },
            // Mirror images are the loader's to make, as of every source.
            flip: false,
            near_far: files.near_far.map(|[near, far]| (near, far)),
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
        let (_, one) = self.dataset.serve(self.seed, index, step)?;
        Ok(Arc::new(Example {
            context: one.context,
            targets: one.targets,
            inverse_depth: Vec::new(),
            near_far: one.near_far,
        }))
    }

    fn warnings(&self) -> Vec<String> {
        self.dataset.warnings()
    }
}
