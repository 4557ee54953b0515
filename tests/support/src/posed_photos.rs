//! Photographs with true cameras, and the features that pose estimation takes of them.

use crate::shared;
use std::path::{Path, PathBuf};
use subsplat::cameras::estimation::{Lens, PosePhoto};
use subsplat::files::poses::protocol::load_protocol;
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::{Photo, Rgb};
use subsplat_kernels::camera::Camera;

/// Features of each photograph of a pair, as `estimate_cameras_of_files` takes them.
pub const PAIR_FEATURES: usize = 4000;
/// Features of each of many photographs, as `estimate_cameras_of_files` takes them.
pub const MANY_FEATURES: usize = 2500;

/// What an estimate may know of the lens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intrinsics {
    Known,
    Unknown,
}

/// A photograph of a scene, with its true camera.
pub struct PosedPhoto {
    pub camera: Camera,
    rgb: Vec<u8>,
}

impl PosedPhoto {
    /// Photograph `index` of `scene`.
    pub fn load(scene: &Scene, index: usize) -> Self {
        let (rgb, camera) = scene.frames[index].load().expect("a photograph");
        Self { camera, rgb: rgb.data }
    }

    /// Its pixels with a camera.
    pub fn with_camera(&self, camera: Camera) -> Photo {
        let k = self.camera.intrinsics();
        let image = Rgb { width: k.width, height: k.height, data: self.rgb.clone() };
        Photo::new(image, camera).expect("pixels of the camera's size")
    }

    /// Its features, with as much of its lens as `intrinsics` says.
    pub fn features(&self, intrinsics: Intrinsics, count: usize) -> PosePhoto {
        let k = self.camera.intrinsics();
        let lens = match intrinsics {
            Intrinsics::Known => Lens::known(k),
            Intrinsics::Unknown => Lens::unknown(k.width, k.height),
        };
        PosePhoto::from_rgb8(&self.rgb, lens, count).expect("a photograph")
    }
}

/// Two photographs of a scene that its protocol names as context.
pub struct PosedPair {
    /// The scene's name and both indices: `fox 0,8`.
    pub name: String,
    pub photos: [PosedPhoto; 2],
    /// The protocol's target views.
    pub targets: Vec<PosedPhoto>,
}

/// A scene of `../shared/photos`.
pub fn photo_scene(name: &str) -> Option<Scene> {
    Some(load_scene(&shared(&format!("photos/{name}"))?).expect("a scene"))
}

/// The context pairs of all scenes, in the order of their names.
pub fn context_pairs() -> Option<Vec<PosedPair>> {
    let mut folders: Vec<PathBuf> = std::fs::read_dir(shared("photos")?)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.join("protocol.json").is_file())
        .collect();
    folders.sort();
    Some(folders.iter().flat_map(|folder| pairs_of(folder)).collect())
}

fn pairs_of(folder: &Path) -> Vec<PosedPair> {
    let protocol = load_protocol(folder.join("protocol.json")).expect("a protocol");
    let scene = load_scene(folder).expect("a scene");
    let name = folder.file_name().expect("a name").to_string_lossy();
    let pairs = protocol.tests.iter().map(|views| {
        let [a, b] = views.context[..] else { panic!("{name}: two context views") };
        let photos = [a, b].map(|i| PosedPhoto::load(&scene, i));
        let targets = views.target.iter().map(|&i| PosedPhoto::load(&scene, i)).collect();
        PosedPair { name: format!("{name} {a},{b}"), photos, targets }
    });
    pairs.collect()
}
