//! COLMAP's sparse model: `cameras`, `images` and `points3D`, binary or text.
//!
//! Poses in the file are camera-from-world (quaternion wxyz and translation), OpenCV
//! axes; pixel centres lie at +0.5, as here. `rigs.*` and `frames.*` of COLMAP 4 are
//! ignored: `images.*` still holds every pose. Distortion is removed when a frame is
//! loaded ([`crate::files::photos::undistort`]). Camera models that are read: `MODELS_READ`; others are
//! refused by name. An EQUIRECTANGULAR picture becomes several frames
//! ([`crate::files::photos::views`]).
//!
//! Frames are sorted by picture name, as COLMAP's image ids follow no order.
//! Layout: COLMAP, `src/colmap/scene/reconstruction_io_{binary,text}` and the
//! documentation page "Output Format".

mod binary;
mod text;
mod write;

use super::assemble::{Draft, Lens, assemble};
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::photos::views::panorama_intrinsics;
use crate::files::{Error, Result, read};
use glam::{DMat4, DQuat, DVec3};
use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

pub use binary::parse_points as parse_points_bin;
pub use binary::{parse_cameras as parse_cameras_bin, parse_images as parse_images_bin};
pub use write::{SparsePoint, save_colmap};

pub use text::parse_points as parse_points_txt;
pub use text::{parse_cameras as parse_cameras_txt, parse_images as parse_images_txt};

/// One camera of `cameras.*`.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapCamera {
    /// Picture width, px.
    pub width: usize,
    /// Picture height, px.
    pub height: usize,
    /// fx, fy, cx, cy, px.
    pub focal_and_center: [f64; 4],
    /// Lens distortion.
    pub distortion: Distortion,
}

/// One picture of `images.*`.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapImage {
    /// Place in the file, in the form of [`Error::at`].
    pub place: String,
    /// Rotation, camera from world, unit.
    pub rotation: DQuat,
    /// Translation, camera from world.
    pub translation: DVec3,
    /// The file's numbers where they are no pose; rotation and translation are then those of the world.
    pub refused: Option<String>,
    /// Key into the cameras.
    pub camera: u32,
    /// Path below the picture folder.
    pub name: String,
    /// Ids of the points that the picture observes.
    pub points: Vec<u64>,
}

/// Cameras by id. One that is not read is an error of the pictures that have it.
pub type Cameras = HashMap<u32, Result<ColmapCamera>>;
/// Id and position of each point.
pub type Points = Vec<(u64, DVec3)>;

/// Number of pictures that the model in `folder` states; 0 where it cannot be read.
pub(super) fn count_images(folder: &Path) -> usize {
    let binary = folder.join("images.bin");
    if folder.join("cameras.bin").is_file() && binary.is_file() {
        let mut count = [0; 8];
        let read = std::fs::File::open(binary).and_then(|mut file| file.read_exact(&mut count));
        return read.map_or(0, |()| u64::from_le_bytes(count) as usize);
    }
    count_images_txt(&folder.join("images.txt"))
}

/// Number of pictures in an `images.txt`; 0 where it cannot be read.
pub(super) fn count_images_txt(path: &Path) -> usize {
    let bytes = read(path).unwrap_or_default();
    parse_images_txt(path, &bytes, &mut Vec::new()).map_or(0, |images| images.len())
}

/// The `images.txt` of a folder that holds a binary model, which goes before it, and one as text.
pub(super) fn second_text(folder: &Path) -> Option<PathBuf> {
    (is_whole(folder, "bin") && is_whole(folder, "txt")).then(|| folder.join("images.txt"))
}

/// Reports whether `folder` holds the two files of a model that hold its cameras.
fn is_whole(folder: &Path, extension: &str) -> bool {
    ["cameras", "images"].iter().all(|stem| folder.join(format!("{stem}.{extension}")).is_file())
}

/// Reports whether `folder` holds a model.
pub(super) fn is_model(folder: &Path) -> bool {
    ["bin", "txt"].iter().any(|extension| is_whole(folder, extension))
}

/// COLMAP's camera models by number: name and number of parameters. Models that [`lens`]
/// does not support are listed so that errors name them.
const MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// For messages.
const MODELS_READ: &str = "a camera model among SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, \
                           OPENCV, OPENCV_FISHEYE, FULL_OPENCV, FOV, SIMPLE_RADIAL_FISHEYE, \
                           RADIAL_FISHEYE, THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE, \
                           SIMPLE_DIVISION, DIVISION, SIMPLE_FISHEYE, FISHEYE, EQUIRECTANGULAR";

/// Focal lengths, principal point and distortion of a camera.
struct LensParameters {
    focal_and_center: [f64; 4],
    distortion: Distortion,
}

/// Interprets the parameters of `model`; their number is that of [`MODELS`].
fn lens(model: &str, p: &[f64]) -> Option<LensParameters> {
    let one_focal = |distortion| {
        let focal_and_center = [p[0], p[0], p[1], p[2]];
        LensParameters { focal_and_center, distortion }
    };
    let one = |k: [f64; 6]| one_focal(Distortion::brown(k, [0.0; 2]));
    let one_fisheye = |k: [f64; 4]| one_focal(Distortion::fisheye(k));
    let two = |distortion| {
        let focal_and_center = [p[0], p[1], p[2], p[3]];
        LensParameters { focal_and_center, distortion }
    };
    Some(match model {
        "SIMPLE_PINHOLE" => one([0.0; 6]),
        "PINHOLE" => two(Distortion::None),
        "SIMPLE_RADIAL" => one([p[3], 0.0, 0.0, 0.0, 0.0, 0.0]),
        "RADIAL" => one([p[3], p[4], 0.0, 0.0, 0.0, 0.0]),
        "OPENCV" => two(Distortion::brown([p[4], p[5], 0.0, 0.0, 0.0, 0.0], [p[6], p[7]])),
        "FULL_OPENCV" => {
            two(Distortion::brown([p[4], p[5], p[8], p[9], p[10], p[11]], [p[6], p[7]]))
        }
        "OPENCV_FISHEYE" => two(Distortion::fisheye([p[4], p[5], p[6], p[7]])),
        "SIMPLE_RADIAL_FISHEYE" => one_fisheye([p[3], 0.0, 0.0, 0.0]),
        "RADIAL_FISHEYE" => one_fisheye([p[3], p[4], 0.0, 0.0]),
        "SIMPLE_FISHEYE" => one_fisheye([0.0; 4]),
        "FISHEYE" => two(Distortion::fisheye([0.0; 4])),
        "FOV" => two(Distortion::Fov { omega: p[4] }),
        "THIN_PRISM_FISHEYE" => two(Distortion::ThinPrismFisheye {
            k: [p[4], p[5], p[8], p[9]],
            p: [p[6], p[7]],
            s: [p[10], p[11]],
        }),
        "RAD_TAN_THIN_PRISM_FISHEYE" => two(Distortion::RadTanThinPrismFisheye {
            k: [p[4], p[5], p[6], p[7], p[8], p[9]],
            p: [p[10], p[11]],
            s: [p[12], p[13], p[14], p[15]],
        }),
        "SIMPLE_DIVISION" => one_focal(Distortion::Division { k: p[3] }),
        "DIVISION" => two(Distortion::Division { k: p[4] }),
        // Its parameters are the size, which every camera has.
        "EQUIRECTANGULAR" => {
            let focal_and_center = panorama_intrinsics(p[0], p[1]);
            LensParameters { focal_and_center, distortion: Distortion::Equirectangular }
        }
        _ => return None,
    })
}

/// An error without its place in the file.
struct Refusal {
    expected: String,
    got: String,
}

/// Makes a camera of `size` (width, height), px.
fn camera(
    model: &str,
    size: [u64; 2],
    parameters: &[f64],
) -> std::result::Result<ColmapCamera, Refusal> {
    let refuse = |expected: &str, got: String| Refusal { expected: expected.to_owned(), got };
    let side = |v: u64| (1..=1 << 20).contains(&v).then_some(v as usize);
    let [Some(width), Some(height)] = size.map(side) else {
        let got = format!("{}x{}", size[0], size[1]);
        return Err(refuse("a picture of 1x1 to 1048576x1048576", got));
    };
    if parameters.iter().any(|v| !v.is_finite()) {
        return Err(refuse("finite camera parameters", format!("{parameters:?}")));
    }
    let LensParameters { focal_and_center, distortion } =
        lens(model, parameters).ok_or_else(|| refuse(MODELS_READ, model.to_owned()))?;
    Ok(ColmapCamera { width, height, focal_and_center, distortion })
}

/// Rotation and translation of the file's quaternion w, x, y, z and translation.
///
/// # Errors
/// Numbers that are no pose, as text.
fn pose(q: [f64; 4], t: [f64; 3]) -> std::result::Result<(DQuat, DVec3), String> {
    let quat = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    let (length, translation) = (quat.length(), DVec3::from_array(t));
    if length.is_finite() && length > 1e-6 && translation.is_finite() {
        return Ok((quat * (1.0 / length), translation));
    }
    Err(format!("quaternion {q:?}, translation {t:?}"))
}

/// Reads the model in `folder`. Pictures may lie beside it, in its parents, and in an
/// `images` folder of any of them.
pub(super) fn load(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    load_form(folder, is_whole(folder, "bin"), reading)
}

/// Reads the model in `folder` from its files of text, where it has them.
pub(super) fn load_text(folder: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let binary = is_whole(folder, "bin") && !is_whole(folder, "txt");
    load_form(folder, binary, reading)
}

fn load_form(folder: &Path, binary: bool, reading: &Reading<'_>) -> Result<Scene> {
    let extension = if binary { "bin" } else { "txt" };
    let path = |stem: &str| folder.join(format!("{stem}.{extension}"));
    let (cameras_path, images_path, points_path) =
        (path("cameras"), path("images"), path("points3D"));
    let mut warnings = Vec::new();

    let bytes = read(&cameras_path)?;
    let cameras = if binary {
        parse_cameras_bin(&cameras_path, &bytes)?
    } else {
        parse_cameras_txt(&cameras_path, &bytes)?
    };
    let bytes = read(&images_path)?;
    let mut images = if binary {
        parse_images_bin(&images_path, &bytes)?
    } else {
        parse_images_txt(&images_path, &bytes, &mut warnings)?
    };
    let mut points = if points_path.is_file() {
        let bytes = read(&points_path)?;
        if binary {
            parse_points_bin(&points_path, &bytes)?
        } else {
            parse_points_txt(&points_path, &bytes)?
        }
    } else {
        warnings.push(format!("{} is missing: no sparse points", points_path.display()));
        Points::new()
    };
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let (count, first) = (points.len(), points.iter().find(|(_, p)| !p.is_finite()).copied());
    points.retain(|(_, position)| position.is_finite());
    if let Some((id, position)) = first {
        let bad = count - points.len();
        let got = format!("{bad} of {count} that are not: point {id} at {position}");
        if reading.strict {
            return Err(Error::format(&points_path, "points with finite positions (strict)", got));
        }
        warnings.push(format!(
            "{}: {bad} of {count} points have no finite position and are left out (point {id})",
            points_path.display()
        ));
    }

    let index: HashMap<u64, u32> =
        points.iter().enumerate().map(|(i, (id, _))| (*id, i as u32)).collect();
    let roots: Vec<PathBuf> = folder.ancestors().take(4).map(Path::to_owned).collect();
    let roots: Vec<&Path> = roots.iter().map(PathBuf::as_path).collect();
    // The folders above the scene's may hold the pictures of other scenes.
    let scene = roots.iter().position(|root| !is_layout(root)).unwrap_or(roots.len());
    let own = &roots[..roots.len().min(scene + 1)];
    let drafts = images
        .into_iter()
        .map(|image| draft(&images_path, image, &cameras, &index, [&roots, own], reading))
        .collect();
    let mut scene = assemble(&images_path, SceneFormat::Colmap, reading, drafts)?;
    let origin = scene.origin;
    let place = |(_, p): (u64, DVec3)| (p - origin).as_vec3();
    scene.points = (!points.is_empty()).then(|| points.into_iter().map(place).collect());
    warnings.append(&mut scene.warnings);
    scene.warnings = warnings;
    Ok(scene)
}

/// Reports whether a folder has a name of COLMAP's layout: sparse/0, dense/0/sparse, colmap/sparse/0.
fn is_layout(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    ["sparse", "colmap", "dense"].contains(&&*name)
        || (!name.is_empty() && name.chars().all(|c| c.is_ascii_digit()))
}

fn draft(
    path: &Path,
    image: ColmapImage,
    cameras: &Cameras,
    index: &HashMap<u64, u32>,
    [roots, own]: [&[&Path]; 2],
    reading: &Reading<'_>,
) -> Draft {
    let camera = match cameras.get(&image.camera) {
        Some(Ok(camera)) => camera,
        Some(Err(error)) => return Draft::refused(image.name, error.copy()),
        None => {
            let got = format!("camera {}", image.camera);
            let error = Error::format(path, "a camera id of the cameras file", got);
            return Draft::refused(image.name, error.at(image.place));
        }
    };
    if let Some(got) = image.refused {
        let error = Error::format(path, "a finite pose with a quaternion above 0", got);
        return Draft::refused(image.name, error.at(image.place));
    }
    // The inverse of (R, t): (Rᵀ, −Rᵀt).
    let back = image.rotation.conjugate();
    let pose = DMat4::from_rotation_translation(back, -(back * image.translation));
    let mut visible: Vec<u32> =
        image.points.iter().filter_map(|id| index.get(id).copied()).collect();
    visible.sort_unstable();
    visible.dedup();
    Draft {
        image: reading.find_of_scene(roots, own, &image.name),
        size: Some((camera.width, camera.height)),
        distortion: camera.distortion,
        visible,
        ..Draft::new(image.place, image.name, Lens::Pixels(camera.focal_and_center), pose)
    }
}
