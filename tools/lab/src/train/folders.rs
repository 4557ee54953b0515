//! Training examples as scene folders, which `eval` reads.

use super::Result;
use super::source::Example;
use crate::data::dataset::Posed;
use serde_json::json;
use std::io::Write;
use std::path::Path;
use subsplat::files as io;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};

/// Writes an example to the folder `place`: its pictures, context views first, cameras.json, and a
/// protocol.json of one test. The protocol is written last.
///
/// # Errors
/// A file that cannot be written.
pub fn write_scene(example: &Example, place: &Path) -> Result<()> {
    let images = place.join("images");
    std::fs::create_dir_all(&images).map_err(|e| io::Error::io(&images, e))?;
    let save = |(v, view): (usize, &Posed)| -> Result<NamedCamera> {
        let file = format!("images/{v}.png");
        save_png(place.join(&file), &view.image)?;
        Ok(NamedCamera::new(file, view.camera))
    };
    let views = example.context.iter().chain(&example.targets).enumerate();
    let cameras = views.map(save).collect::<Result<Vec<_>>>()?;
    let contexts = example.context.len();
    let context: Vec<usize> = (0..contexts).collect();
    let target: Vec<usize> = (contexts..cameras.len()).collect();
    let near_far = Some(example.near_far);
    let file = CameraFile { cameras, units: Default::default(), near_far, ..Default::default() };
    save_cameras_json(place.join("cameras.json"), &file)?;
    let size = example.context.first().map_or((0, 0), |v| (v.image.width, v.image.height));
    let tests = json!([{ "context": context, "target": target }]);
    let protocol = json!({ "resolution": [size.0, size.1], "tests": tests });
    let text = format!("{protocol:#}\n");
    let write = |out: &mut std::io::BufWriter<_>| out.write_all(text.as_bytes());
    Ok(io::write_atomic(place.join("protocol.json"), write)?)
}
