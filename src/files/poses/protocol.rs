//! Choice of context and target frames: `protocol.json` of a scene folder, and the
//! evaluation index of pixelSplat and MVSplat for a data set.
//!
//! * `protocol.json`: `{"resolution": [W, H], "intrinsics_256": {…},
//!   "tests": [{"context": [i, j], "target": [a, b, c], …}]}`
//! * index: `{"scene": {"context": [i, j], "target": [a, b, c]} | null, …}`; a scene of
//!   null has no pair and is skipped.

use super::json::error as json_error;
use crate::files::{Error, Result, read};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Frames of one test, as indices into the scene's frames.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(expecting = "context and target")]
pub struct Views {
    /// Input frames, at least one.
    pub context: Vec<usize>,
    /// Frames to render and compare.
    pub target: Vec<usize>,
}

impl Views {
    /// Checks the indices against a scene of `frames` frames.
    ///
    /// # Errors
    /// An index out of range; `path` is the file in the error.
    pub fn check(&self, path: impl AsRef<Path>, frames: usize) -> Result<()> {
        match self.context.iter().chain(&self.target).find(|i| **i >= frames) {
            None => Ok(()),
            Some(i) => {
                let expected = format!("frame indices below {frames}");
                Err(Error::format(path.as_ref(), expected, i.to_string()))
            }
        }
    }
}

/// Intrinsics in pixels of the protocol's resolution.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(expecting = "fx, fy, cx, cy")]
pub struct ProtocolIntrinsics {
    /// Horizontal focal length, px.
    pub fx: f64,
    /// Vertical focal length, px.
    pub fy: f64,
    /// Principal point from the left, px.
    pub cx: f64,
    /// Principal point from the top, px.
    pub cy: f64,
}

/// Content of a `protocol.json`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(expecting = "an object with tests")]
pub struct Protocol {
    /// Width and height of inputs and targets, px.
    pub resolution: Option<[usize; 2]>,
    /// Intrinsics of every frame after resize and crop to 256×256.
    pub intrinsics_256: Option<ProtocolIntrinsics>,
    /// Context frames with their targets.
    #[serde(default)]
    pub tests: Vec<Views>,
}

/// Scenes with their frames; `None` where the index has null.
pub type Index = BTreeMap<String, Option<Views>>;

/// Reads `protocol.json`.
///
/// # Errors
/// JSON of another form; a test without context.
pub fn load_protocol(path: impl AsRef<Path>) -> Result<Protocol> {
    read_protocol(path.as_ref())
}

fn read_protocol(path: &Path) -> Result<Protocol> {
    let protocol: Protocol = serde_json::from_slice(&read(path)?)
        .map_err(|e| json_error(path, "protocol.json (tests with context and target)", &e))?;
    for (i, test) in protocol.tests.iter().enumerate() {
        if test.context.is_empty() {
            let error = Error::format(path, "at least one context frame", "none");
            return Err(error.at(format!(" test {i}")));
        }
    }
    Ok(protocol)
}

/// Reads an evaluation index.
///
/// # Errors
/// JSON of another form; a scene without context.
pub fn load_index(path: impl AsRef<Path>) -> Result<Index> {
    read_index(path.as_ref())
}

fn read_index(path: &Path) -> Result<Index> {
    let index: Index = serde_json::from_slice(&read(path)?).map_err(|e| {
        json_error(path, "an evaluation index (scene: context and target, or null)", &e)
    })?;
    for (scene, views) in &index {
        if views.as_ref().is_some_and(|v| v.context.is_empty()) {
            let error = Error::format(path, "at least one context frame", "none");
            return Err(error.at(format!(" scene `{scene}`")));
        }
    }
    Ok(index)
}
