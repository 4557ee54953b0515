//! Readers by name, as functions of bytes: an answer or an error, never a panic, never more memory or time than the
//! input justifies. The fuzz targets call them, and `tests/fuzzed` calls them with the committed corpus.

#[path = "round_trips.rs"]
pub mod round_trips;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use subsplat::files::photos::image::{LoadOptions, Truncated, parse_depth_png, parse_picture};
use subsplat::files::photos::{exif, photograph, video};
use subsplat::files::poses::{
    bundler, cameras_json, colmap, llff, matrices, metashape, mvsnet, neus, protocol, re10k,
    reality_capture, scene,
};
use subsplat::files::splats::{glb, ksplat, ply, sog, splat, spz};
use subsplat::files::weights::torch::TorchFile;
use subsplat::files::{SaveOptions, SplatFormat, encode_splats, parse_splats};
use subsplat::scene::splats::Splats;

/// A reader or a round trip.
pub type Target = fn(&[u8]);

/// Every target, in alphabetical order. The name is also the one of the archive of its corpus.
pub const TARGETS: &[(&str, Target)] = &[
    ("bundler", |b| drop(bundler::parse("fuzz", b))),
    ("cameras_json", |b| scene("cameras.json", b)),
    ("colmap_cameras", |b| drop(colmap::parse_cameras_bin("fuzz", b))),
    ("colmap_cameras_txt", |b| drop(colmap::parse_cameras_txt("fuzz", b))),
    ("colmap_images", |b| drop(colmap::parse_images_bin("fuzz", b))),
    ("colmap_images_txt", |b| drop(colmap::parse_images_txt("fuzz", b, &mut Vec::new()))),
    ("colmap_points", |b| drop(colmap::parse_points_bin("fuzz", b))),
    ("colmap_points_txt", |b| drop(colmap::parse_points_txt("fuzz", b))),
    ("depth_png", |b| drop(parse_depth_png(b, 0.001, "fuzz.png"))),
    ("exif", |b| drop(exif::parse_exif(b, 4000, 3000))),
    ("ffprobe", |b| drop(video::parse_ffprobe(b, "fuzz.mp4"))),
    ("glb", |b| splats(glb::parse_glb(b, "fuzz.glb"))),
    ("ksplat", |b| splats(ksplat::parse_ksplat(b, "fuzz.ksplat"))),
    ("llff", |b| drop(llff::parse("fuzz", b))),
    ("llff_scene", |b| scene("poses_bounds.npy", b)),
    ("matrices", matrices_of),
    ("matrix_files", matrix_files_of),
    ("meshroom", |b| scene("cameras.sfm", b)),
    ("metashape", |b| drop(metashape::parse("fuzz", b))),
    ("metashape_scene", |b| scene("cameras.xml", b)),
    ("mvsnet", |b| drop(mvsnet::parse("fuzz", b))),
    ("nerfstudio", |b| scene("transforms_train.json", b)),
    ("neus", |b| drop(neus::parse("fuzz", b))),
    ("openmvg", |b| scene("sfm_data.json", b)),
    ("opensfm", |b| scene("reconstruction.json", b)),
    ("photograph", photograph_of),
    ("picture", |b| drop(parse_picture(b, "fuzz.png"))),
    ("ply", |b| splats(ply::parse_ply(b, "fuzz.ply"))),
    ("polycam", |b| scene("keyframes/cameras/1.json", b)),
    ("protocol", protocol_of),
    ("re10k", |b| drop(re10k::parse("fuzz", b, &mut Vec::new()))),
    ("reality_capture", |b| drop(reality_capture::parse("fuzz", b))),
    ("record3d", |b| scene("metadata", b)),
    ("round_trip_cameras", round_trips::cameras),
    ("round_trip_exact", round_trips::exact),
    ("round_trip_packed", round_trips::packed),
    ("scanner_app", scanner_app_of),
    ("sog", |b| splats(sog::parse_sog(b, "fuzz.sog"))),
    ("splat", |b| splats(splat::parse_splat(b, "fuzz.splat"))),
    ("spz", |b| splats(spz::parse_spz(b, "fuzz.spz"))),
    ("torch", torch_of),
    ("transforms", |b| scene("transforms.json", b)),
    #[cfg(feature = "network")]
    ("weights", |b| {
        drop(subsplat::network::model::weights::parse_tensors(b, Path::new("fuzz.safetensors")))
    }),
];

/// The target `name`.
pub fn target(name: &str) -> Option<Target> {
    TARGETS.iter().find(|(own, _)| *own == name).map(|(_, target)| *target)
}

/// Header of a picture of 4×4 px, BMP. Only its size is read.
const PICTURE: [u8; 54] =
    *b"BM\x66\0\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0\x04\0\0\0\x04\0\0\0\x01\0\x18\0\0\0\0\0\
    \x30\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0";

/// A folder of this call alone, removed when the value is dropped. `TMPDIR` chooses the place.
pub struct Folder(PathBuf);

impl Folder {
    /// Makes the folder.
    ///
    /// # Panics
    /// The folder cannot be made.
    pub fn new() -> Self {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let path =
            std::env::temp_dir().join(format!("subsplat-fuzz-{}-{count}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file below the folder and returns its path.
    ///
    /// # Panics
    /// The file cannot be written.
    pub fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

impl Default for Folder {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // A folder that stays is no error of a reader.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Reads a folder that has one pose file. What is read is finite.
fn scene(name: &str, bytes: &[u8]) {
    let folder = Folder::new();
    let path = folder.write(name, bytes);
    finite(scene::load_cameras(folder.path()));
    finite(scene::load_cameras(&path));
    if name == "cameras.json" {
        let _ = cameras_json::load_cameras_json(&path);
    }
}

/// `poses.txt` and, after the first zero byte, `K.txt`.
fn matrices_of(bytes: &[u8]) {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    let (poses, intrinsics) = bytes.split_at(end);
    let folder = Folder::new();
    folder.write("poses.txt", poses);
    folder.write("K.txt", intrinsics.get(1..).unwrap_or_default());
    for convention in [
        matrices::PoseConvention::WorldFromCameraOpenCv,
        matrices::PoseConvention::CameraFromWorldOpenCv,
    ] {
        let _ = matrices::load(folder.path(), convention);
    }
}

/// A pose and, after the first zero byte, intrinsics, of a picture.
fn matrix_files_of(bytes: &[u8]) {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    let (pose, intrinsics) = bytes.split_at(end);
    let folder = Folder::new();
    folder.write("pose/0.txt", pose);
    folder.write("intrinsics.txt", intrinsics.get(1..).unwrap_or_default());
    folder.write("rgb/0.png", &PICTURE);
    finite(scene::load_cameras(folder.path()));
}

fn scanner_app_of(bytes: &[u8]) {
    let folder = Folder::new();
    folder.write("frame_00000.json", bytes);
    folder.write("frame_00000.png", &PICTURE);
    finite(scene::load_cameras(folder.path()));
}

/// What is read of a scene is finite.
fn finite(scene: subsplat::files::Result<scene::Scene>) {
    for frame in scene.into_iter().flat_map(|scene| scene.frames) {
        assert!(frame.camera.world_from_camera().is_finite(), "{:?}", frame.camera);
    }
}

/// Checks what a reader accepted: finite numbers, rotations, and a .ply of it that has as many Gaussians.
fn splats(read: subsplat::files::Result<Splats>) {
    let Ok(splats) = read else { return };
    assert!(splats.rows().iter().chain(splats.sh()).all(|v| v.is_finite()));
    assert!((0..splats.len()).all(|i| splats.quat_wxyz(i) != [0.0; 4]));
    // An opacity outside [0, 1] is refused by the writer.
    let Ok(copy) = encode_splats(SplatFormat::Ply, &splats, &SaveOptions::default()) else {
        return;
    };
    let (copy, _) = parse_splats(&copy, "copy.ply").unwrap();
    assert_eq!(copy.len(), splats.len());
}

fn protocol_of(bytes: &[u8]) {
    let folder = Folder::new();
    let path = folder.write("protocol.json", bytes);
    let _ = protocol::load_protocol(&path);
    let _ = protocol::load_index(&path);
}

fn photograph_of(bytes: &[u8]) {
    let options = LoadOptions { truncated: Truncated::Accept };
    let _ = photograph::parse_photograph(bytes, &options, "fuzz.jpg");
}

/// Reads every tensor of the file.
fn torch_of(bytes: &[u8]) {
    let Ok(file) = TorchFile::parse(bytes, "fuzz.pt") else { return };
    let mut left = vec![file.root()];
    while let Some(value) = left.pop() {
        if let Some(tensor) = value.as_tensor() {
            let _ = file.read(tensor);
        }
        left.extend(value.items().unwrap_or_default());
        left.extend(value.entries().map(|(_, v)| v));
    }
}
