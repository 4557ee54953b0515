//! Files to go on from: one safetensors file with weights, moments, moving average and
//! the number of the step, written atomically, the newest few kept.

use super::config::TrainConfig;
use super::optimizer::State;
use super::{Error, Result};
use crate::io::tensors::{TensorSpec, write_tensors};
use crate::model::weights::read_tensors;
use safetensors::Dtype;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Key of [`Progress`] in the metadata.
const PROGRESS_KEY: &str = "subsplat.train";
/// Key of the configuration in the metadata.
const CONFIG_KEY: &str = "subsplat.train.config";
/// Name of a checkpoint around its step.
const NAME: (&str, &str) = ("step-", ".safetensors");

/// How far a training is. With the configuration's seeds this is all of the random
/// state: everything random is a function of seed and place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Examples taken.
    pub examples: u64,
    /// Steps in a row that were not finite.
    pub bad: usize,
    /// Seconds of training so far.
    pub seconds: f64,
}

/// A checkpoint as read.
pub struct Checkpoint {
    /// How far it is.
    pub progress: Progress,
    /// What it was told.
    pub config: TrainConfig,
    /// The optimizer.
    pub state: State,
}

/// Path of the checkpoint after `step` steps.
pub fn path(folder: &Path, step: u64) -> PathBuf {
    folder.join(format!("{}{step:08}{}", NAME.0, NAME.1))
}

/// Steps of the checkpoints in `folder`, oldest first; none where there is no folder.
pub fn steps(folder: &Path) -> Vec<u64> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let step = |entry: std::io::Result<std::fs::DirEntry>| -> Option<u64> {
        let name = entry.ok()?.file_name().into_string().ok()?;
        name.strip_prefix(NAME.0)?.strip_suffix(NAME.1)?.parse().ok()
    };
    let mut steps: Vec<u64> = entries.filter_map(step).collect();
    steps.sort_unstable();
    steps
}

/// Writes a checkpoint and removes all but the newest `keep`.
///
/// # Errors
/// The folder is missing or full.
pub fn save(
    folder: &Path,
    (progress, config): (&Progress, &TrainConfig),
    state: &State,
    keep: usize,
) -> Result<PathBuf> {
    let path = path(folder, progress.step);
    let json = serde_json::to_string(progress).map_err(|e| Error::Parse(e.to_string()))?;
    let metadata = BTreeMap::from([
        (PROGRESS_KEY.to_owned(), json),
        (CONFIG_KEY.to_owned(), config.to_json()?),
    ]);
    let (mut specs, mut data) = (Vec::new(), Vec::new());
    for (name, tensor) in state {
        let (name, shape) = (name.clone(), tensor.dims().to_vec());
        specs.push(TensorSpec { name, dtype: Dtype::F32, shape });
        data.push(tensor.flatten_all()?.to_vec1::<f32>()?);
    }
    write_tensors(&path, &specs, &metadata, |i| {
        Ok(data[i].iter().flat_map(|v| v.to_le_bytes()).collect())
    })?;
    let all = steps(folder);
    for step in all.iter().rev().skip(keep.max(1)) {
        // An old file that stays does no harm.
        let _ = std::fs::remove_file(self::path(folder, *step));
    }
    Ok(path)
}

/// Reads a checkpoint.
///
/// # Errors
/// Not a checkpoint, or not whole.
pub fn load(path: &Path) -> Result<Checkpoint> {
    let (state, metadata) = read_tensors(path)?;
    let text = |key: &str| {
        metadata.get(key).ok_or_else(|| {
            crate::io::Error::format(path, "a training checkpoint", format!("no `{key}`"))
        })
    };
    let progress = serde_json::from_str(text(PROGRESS_KEY)?)
        .map_err(|e| crate::io::Error::format(path, "a training checkpoint", e.to_string()))?;
    let config = TrainConfig::from_json(text(CONFIG_KEY)?)?;
    Ok(Checkpoint { progress, config, state })
}
