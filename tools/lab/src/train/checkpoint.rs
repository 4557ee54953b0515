//! Checkpoints: one safetensors file with weights, moments, moving average and the step.
//!
//! Files are written atomically, and the newest few are kept.

use super::config::TrainConfig;
use super::optimizer::State;
use super::{Error, Result};
use safetensors::Dtype;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use subsplat::files::weights::tensors::{TensorSpec, write_tensors};
use subsplat::network::model::weights::read_tensors;

/// Metadata key of [`Progress`].
const PROGRESS_KEY: &str = "subsplat.train";
/// Metadata key of the configuration.
const CONFIG_KEY: &str = "subsplat.train.config";
/// Start of a checkpoint's file name, before the step.
const NAME_PREFIX: &str = "step-";
/// End of a checkpoint's file name, after the step.
const NAME_SUFFIX: &str = ".safetensors";

/// Progress of a training. With the configuration's seeds it is the complete random state, because
/// all random values are functions of seed and position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Completed steps.
    pub step: u64,
    /// Consumed examples.
    pub examples: u64,
    /// Consecutive steps with a loss or gradient that was not finite.
    pub bad: usize,
    /// Seconds of training so far.
    pub seconds: f64,
}

/// Contents of a checkpoint.
pub struct Checkpoint {
    /// Progress of the training.
    pub progress: Progress,
    /// Configuration of the training.
    pub config: TrainConfig,
    /// State of the optimizer.
    pub state: State,
}

/// Returns the path of the checkpoint after `step` steps.
pub fn path(folder: &Path, step: u64) -> PathBuf {
    folder.join(format!("{}{step:08}{}", NAME_PREFIX, NAME_SUFFIX))
}

/// Returns the steps of the checkpoints in `folder`, oldest first; empty for a missing folder.
pub fn steps(folder: &Path) -> Vec<u64> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let step = |entry: std::io::Result<std::fs::DirEntry>| -> Option<u64> {
        let name = entry.ok()?.file_name().into_string().ok()?;
        name.strip_prefix(NAME_PREFIX)?.strip_suffix(NAME_SUFFIX)?.parse().ok()
    };
    let mut steps: Vec<u64> = entries.filter_map(step).collect();
    steps.sort_unstable();
    steps
}

/// Writes a checkpoint and removes all but the newest `keep`.
///
/// # Errors
/// A file that cannot be written.
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
        let name = name.clone();
        let shape = tensor.dims().to_vec();
        specs.push(TensorSpec { name, dtype: Dtype::F32, shape });
        data.push(tensor.flatten_all()?.to_vec1::<f32>()?);
    }
    write_tensors(&path, &specs, &metadata, |i| {
        Ok(data[i].iter().flat_map(|v| v.to_le_bytes()).collect())
    })?;
    let all = steps(folder);
    for step in all.iter().rev().skip(keep.max(1)) {
        // A file that cannot be removed does no harm.
        let _ = std::fs::remove_file(self::path(folder, *step));
    }
    Ok(path)
}

/// Reads a checkpoint.
///
/// # Errors
/// A file that is not a checkpoint, or is incomplete.
pub fn load(path: &Path) -> Result<Checkpoint> {
    let (state, metadata) = read_tensors(path)?;
    let text = |key: &str| {
        metadata.get(key).ok_or_else(|| {
            subsplat::files::Error::format(path, "a training checkpoint", format!("no `{key}`"))
        })
    };
    let progress = serde_json::from_str(text(PROGRESS_KEY)?).map_err(|e| {
        subsplat::files::Error::format(path, "a training checkpoint", e.to_string())
    })?;
    let config = TrainConfig::from_json(text(CONFIG_KEY)?)?;
    Ok(Checkpoint { progress, config, state })
}
