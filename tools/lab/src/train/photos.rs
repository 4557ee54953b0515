//! Photographs for the evaluation during a training: scenes with a `protocol.json`. They are never
//! used for training.

use super::Result;
use super::source::{Example, InputTargets};
use crate::data::dataset::Posed;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat::files::poses::protocol::{Views, load_protocol};
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::reconstruct::inputs::crop::{CropOptions, crop};
use subsplat::reconstruct::{DepthBounds, DepthRange};

/// Side of input and target, px, as in the protocol.
const SIDE: usize = 256;

/// Loads the pairs of all scenes in `folder` (or of `folder` itself), in the order of their names,
/// with targets at the input's size.
///
/// # Errors
/// No scene with a `protocol.json`; a scene, a protocol or a photograph that cannot be read.
pub fn pairs(folder: &Path, stride: usize) -> Result<Vec<Arc<Example>>> {
    let entries = std::fs::read_dir(folder).map_err(|e| subsplat::files::Error::io(folder, e))?;
    let mut scenes: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    scenes.push(folder.to_owned());
    scenes.retain(|p| p.join("protocol.json").is_file());
    scenes.sort();
    let mut found = Vec::new();
    for path in &scenes {
        let file = path.join("protocol.json");
        let scene = load_scene(path)?;
        for test in load_protocol(&file)?.tests {
            test.check(&file, scene.frames.len())?;
            if test.target.is_empty() || test.context.len() < 2 {
                let expected = "at least 2 context frames and a target in every test";
                let got = format!("{} and {}", test.context.len(), test.target.len());
                return Err(subsplat::files::Error::format(&file, expected, got).into());
            }
            found.push(Arc::new(pair(&scene, &test, stride)?));
        }
    }
    if found.is_empty() {
        let expected = "scenes with a protocol.json that names pairs";
        return Err(subsplat::files::Error::format(folder, expected, "none").into());
    }
    Ok(found)
}

/// Loads one test of a protocol as an example without depth.
fn pair(scene: &Scene, test: &Views, stride: usize) -> Result<Example> {
    let options = CropOptions::square(SIDE, 1, stride);
    let load = |&i: &usize| -> Result<Posed> {
        let (photo, camera) = scene.frames[i].load()?;
        let cropped = crop(&photo, &camera, &options)?;
        Ok(Posed { image: cropped.input, camera: cropped.input_camera })
    };
    let bounds = DepthBounds::of_frames(scene, &test.context, DepthRange::Auto)?;
    Ok(Example {
        context: test.context.iter().map(load).collect::<Result<_>>()?,
        targets: test.target.iter().map(load).collect::<Result<_>>()?,
        inverse_depth: Vec::new(),
        near_far: bounds.near_far(),
        input_targets: InputTargets::Absent,
    })
}
