//! A scene folder of a generated room, as the programs read it.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::files::poses::scene::Units;
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_lab::data::procedural::CameraSpec;
use subsplat_lab::data::procedural::{Example, ExampleSpec};

/// Side of the scene's pictures, px.
pub const SIDE: usize = 128;

/// A folder with `scene/`: two context views of a made-up room and one between them
/// (frame 1), and cameras.json with near and far.
pub fn workplace() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    std::fs::create_dir_all(scene.join("images")).unwrap();
    let example = example();
    let order = [0, 2, 1];
    let mut cameras = Vec::new();
    for (i, from) in order.into_iter().enumerate() {
        let view = &example.views[from];
        let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let picture = Rgb { width: SIDE, height: SIDE, data: view.rgb.iter().map(byte).collect() };
        let file = format!("images/view{i}.png");
        save_png(scene.join(&file), &picture).unwrap();
        cameras.push(named(file, example.cameras[from]));
    }
    let near_far = Some(NearFar::new(example.near, example.far));
    let content = CameraFile { cameras, units: Units::Unknown, near_far, ..Default::default() };
    save_cameras_json(scene.join("cameras.json"), &content).unwrap();
    folder
}

/// A camera of cameras.json.
pub fn named(file: String, camera: Camera) -> NamedCamera {
    NamedCamera::new(file, camera)
}

fn example() -> &'static Example {
    static EXAMPLE: OnceLock<Example> = OnceLock::new();
    EXAMPLE.get_or_init(|| {
        let spec = ExampleSpec::new(SIDE, SIDE, 1);
        let cameras = CameraSpec { crop: 0.0, ..spec.cameras };
        Example::new(3, &ExampleSpec { cameras, photographic: false, samples: 1, ..spec })
    })
}

/// All files under `folder`, relative, sorted.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.push(path.strip_prefix(folder).unwrap().to_owned());
            }
        }
    }
    found.sort();
    found
}
