//! Posed photographs: one type for every pose format.
//!
//! A [`Scene`] has OpenCV cameras (`world_from_camera`) and intrinsics in pixels of the
//! stored picture, pixel centres at +0.5 (`camera.rs`), in every format. The precedence of
//! pose files in a folder is that of the module [`super::find`] (`load.rs` reads them). The path of a pose file selects that file, as
//! does [`SceneOptions::model`].
//!
//! Pose files refer to the stored pixels ([`Pixels::Stored`]): EXIF orientation is not applied,
//! and a picture with one gives a warning. Cameras of photographs without a pose file refer to
//! the upright pixels ([`Pixels::Upright`]).

use super::assemble::{self, Draft, Lens, Pictures, assemble};
use super::find::{find, find_in};
use super::load::load_at;
#[cfg(feature = "network")]
use super::panoramas::DraftView;
use super::reading::{Reading, SceneOptions};
use crate::files::photos::distortion::Distortion;
use crate::files::photos::image::{LoadOptions, LoadedPicture, load_with, probe};
use crate::files::photos::masks;
use crate::files::photos::photograph::{Photograph, load_photograph, load_photograph_or_panorama};
use crate::files::photos::undistort::{pinhole, undistort, undistort_masked};
use crate::files::photos::views::Cut;
use crate::files::{Error, Result};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DVec3, Vec3};
#[cfg(feature = "network")]
use std::collections::HashMap;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::{Camera, NearFar};

/// The format of a scene's pose file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFormat {
    /// `cameras.json` of `subsplat run`, or the list of 3DGS.
    CamerasJson,
    /// nerfstudio's and instant-ngp's `transforms.json`.
    Transforms,
    /// COLMAP's sparse model, binary or text.
    Colmap,
    /// RealEstate10K's camera txt.
    RealEstate10k,
    /// `poses.txt` with `K.txt`.
    Matrices,
    /// OpenSfM's `reconstruction.json`.
    OpenSfm,
    /// Polycam's raw data.
    Polycam,
    /// Record3D's metadata.
    Record3d,
    /// Bundler's `bundle.out`.
    Bundler,
    /// LLFF's `poses_bounds.npy`.
    Llff,
    /// Metashape's cameras as XML.
    Metashape,
    /// RealityCapture's table of cameras.
    RealityCapture,
    /// A list of poses of `ns-export cameras`, or a path of nerfstudio's viewer.
    Nerfstudio,
    /// OpenMVG's `sfm_data.json`.
    OpenMvg,
    /// Meshroom's scene, `cameras.sfm`.
    Meshroom,
    /// 3D Scanner App's export of all data.
    ScannerApp,
    /// MVSNet's folder `cams`.
    MvsNet,
    /// NeuS's `cameras_sphere.npz`.
    Neus,
    /// A matrix file of each picture: ScanNet, 7-Scenes, NSVF, NeRF++.
    MatrixFiles,
    /// Two pictures with cameras from the command line.
    Pair,
    /// Photographs whose cameras were estimated from the photographs alone.
    Photographs,
}

impl SceneFormat {
    /// Returns the format's name for messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::CamerasJson => "cameras.json",
            Self::Transforms => "transforms.json",
            Self::Colmap => "COLMAP",
            Self::RealEstate10k => "RealEstate10K txt",
            Self::Matrices => "poses.txt with K.txt",
            Self::OpenSfm => "OpenSfM",
            Self::Polycam => "Polycam's raw data",
            Self::Record3d => "Record3D",
            Self::Bundler => "Bundler",
            Self::Llff => "LLFF's poses_bounds.npy",
            Self::Metashape => "Metashape's XML",
            Self::RealityCapture => "RealityCapture's CSV",
            Self::Nerfstudio => "nerfstudio's list of cameras",
            Self::OpenMvg => "OpenMVG",
            Self::Meshroom => "Meshroom",
            Self::ScannerApp => "3D Scanner App",
            Self::MvsNet => "MVSNet's cameras",
            Self::Neus => "NeuS's cameras (.npz)",
            Self::MatrixFiles => "a matrix file of each picture",
            Self::Pair => "two pictures with given cameras",
            Self::Photographs => "photographs with estimated cameras",
        }
    }

    /// Returns whether the cameras come from a file.
    pub fn has_file(self) -> bool {
        !matches!(self, Self::Pair | Self::Photographs)
    }
}

/// The scene's unit of length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Units {
    /// Not known.
    #[default]
    Unknown,
    /// Metres.
    Metres,
    /// The scale of RealEstate10K, used with near 1 and far 100 by convention.
    RealEstate10k,
}

/// The pixels to which a camera refers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pixels {
    /// The file's pixels as they are stored. Pose files refer to these.
    #[default]
    Stored,
    /// The pixels after the EXIF orientation is applied.
    Upright,
}

/// One posed photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Index of the entry in the pose file's order (COLMAP: by name), those that are left out counted.
    pub entry: usize,
    /// Path of the picture in the pose file, without leading `images/` and extension.
    pub name: String,
    /// Path of the picture on disk.
    pub image: PathBuf,
    /// Pixels to which camera, distortion and depth map refer.
    pub pixels: Pixels,
    /// Camera of the picture without [`Frame::distortion`].
    pub camera: Camera,
    /// Lens distortion of the picture.
    pub distortion: Distortion,
    /// The pinhole view of the picture that is this frame; `None` for the whole picture. Several frames may have
    /// one picture, as those of a panorama.
    pub cut: Option<Cut>,
    /// Size of the stored picture where it has another shape than the camera's. Such a frame cannot
    /// be loaded, and [`Scene::usable`] leaves it out.
    pub other_shape: Option<String>,
    /// Time stamp of a video frame, microseconds (RealEstate10K).
    pub timestamp: Option<i64>,
    /// 16-bit depth map of the picture, if the pose file names one.
    pub depth: Option<PathBuf>,
    /// Mask of the picture: a grey picture, 0 is masked. The pose file names it, or it lies in a folder `masks`
    /// ([`Photograph::mask`]). The picture's alpha is a mask as well.
    pub mask: Option<PathBuf>,
    /// Indices into [`Scene::points`] of the points that this frame observes.
    pub visible: Vec<u32>,
}

/// Picture, camera and warnings of a [`Frame`].
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedFrame {
    /// The picture without lens distortion.
    pub picture: Rgb,
    /// Pixels of the picture that count; `None` where all do.
    pub mask: Option<Mask>,
    /// Pinhole camera of the picture.
    pub camera: Camera,
    /// The picture of which this is a view ([`Frame::cut`]); `None` for a whole picture.
    pub view_of: Option<PathBuf>,
    /// Warnings about the file, one line each, with its path.
    pub warnings: Vec<String>,
}

impl Frame {
    /// Returns the camera of [`Frame::load`]'s picture.
    ///
    /// # Errors
    /// A distortion that cannot be removed.
    pub fn pinhole(&self) -> Result<Camera> {
        let intrinsics = pinhole(&self.camera.intrinsics(), &self.distortion).map_err(|got| {
            Error::format(&self.image, "a lens distortion that can be undone", got)
        })?;
        self.camera
            .with_intrinsics(intrinsics)
            .map_err(|e| Error::format(&self.image, "a valid camera", e.to_string()))
    }

    /// Decodes the picture, turns it upright if [`Frame::pixels`] says so, and removes the lens
    /// distortion.
    ///
    /// # Errors
    /// Errors of [`crate::files::photos::image::load`]; a size that is not the camera's.
    pub fn load(&self) -> Result<(Rgb, Camera)> {
        let LoadedFrame { picture, camera, .. } = self.load_with(&LoadOptions::default())?;
        Ok((picture, camera))
    }

    /// Loads the frame as [`Frame::load`] does, with options, and returns the warnings.
    ///
    /// # Errors
    /// Errors of [`crate::files::photos::image::load_with`]; a size that is not the camera's; a mask that cannot
    /// be read, or that masks all pixels.
    pub fn load_with(&self, options: &LoadOptions) -> Result<LoadedFrame> {
        if let Some(got) = &self.other_shape {
            let k = &self.camera.intrinsics();
            let expected = format!("a picture of {}x{}, or of the same shape", k.width, k.height);
            return Err(Error::format(&self.image, expected, got));
        }
        let LoadedPicture { picture, mask, warnings } = match self.pixels {
            Pixels::Stored => {
                let mut loaded = load_with(&self.image, options)?;
                let file = |file| masks::load(file, &probe(&self.image)?);
                let (file, line) = self.mask.as_deref().map(file).transpose()?.unzip();
                let line = line.flatten().map(|line| format!("{}: {line}", self.image.display()));
                loaded.warnings.extend(line);
                let mask = masks::both(loaded.mask, file);
                LoadedPicture { mask: masks::checked(mask, &self.image)?, ..loaded }
            }
            Pixels::Upright => {
                let loaded = match self.cut {
                    Some(_) => load_photograph_or_panorama(&self.image, options)?.0,
                    None => load_photograph(&self.image, options)?,
                };
                let Photograph { image: picture, mask, warnings, .. } = loaded;
                LoadedPicture { picture, mask, warnings }
            }
        };
        let k = &self.cut.map_or(self.camera.intrinsics(), |cut| cut.lens);
        if (picture.width, picture.height) != (k.width, k.height) {
            let got = format!("{}x{}", picture.width, picture.height);
            return Err(Error::format(&self.image, format!("{}x{}", k.width, k.height), got));
        }
        if let Some(cut) = &self.cut {
            let (picture, mask) = cut.apply(&picture, mask.as_ref());
            let mask = masks::checked(mask, &self.image)?;
            let view_of = Some(self.image.clone());
            return Ok(LoadedFrame { picture, mask, camera: self.camera, view_of, warnings });
        }
        let camera = self.pinhole()?;
        let (picture, mask) = match (self.distortion, mask) {
            (Distortion::None, mask) => (picture, mask),
            (lens, None) => (undistort(&picture, k, &lens, &camera.intrinsics()), None),
            (lens, Some(mask)) => {
                let (picture, mask) =
                    undistort_masked(&picture, &mask, k, &lens, &camera.intrinsics());
                (picture, masks::checked(mask, &self.image)?)
            }
        };
        Ok(LoadedFrame { picture, mask, camera, view_of: None, warnings })
    }
}

/// An entry of a pose file that cannot be loaded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Index of the entry, as [`Frame::entry`].
    pub entry: usize,
    /// Path of the picture in the pose file.
    pub name: String,
    /// Reason.
    pub reason: String,
}

impl LeftOut {
    /// A frame that cannot be loaded because of `error`.
    pub fn of_frame(frame: &Frame, error: &Error) -> Self {
        let name = frame.image.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Self { entry: frame.entry, name, reason: error.reason() }
    }
}

/// A set of posed photographs.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Name of the folder.
    pub name: String,
    /// At least one frame, in the pose file's order (COLMAP: by name).
    pub frames: Vec<Frame>,
    /// Sparse points of a reconstruction, world coordinates.
    pub points: Option<Vec<Vec3>>,
    /// Format of the pose file.
    pub source: SceneFormat,
    /// Unit of length.
    pub units: Units,
    /// Nearest and farthest depth of the pose file, camera z in world units.
    pub near_far: Option<NearFar>,
    /// Point of the file's world that is the origin of this scene: zero, or the middle of cameras that lie so
    /// far from their origin that f32 coordinates would be inexact.
    pub origin: DVec3,
    /// Warnings for the user, one line each.
    pub warnings: Vec<String>,
    /// Entries of the pose file that cannot be loaded. They have no frame, but for those of another shape than
    /// their picture's ([`Frame::other_shape`]).
    pub left_out: Vec<LeftOut>,
    /// Other sources of cameras in the scene's folder that can be read, as paths below it for
    /// [`SceneOptions::model`]. Empty where [`SceneOptions::model`] or a path named the source.
    pub other_sources: Vec<String>,
}

impl Scene {
    /// Indices of the frames that can be loaded, as far as the headers of their pictures say.
    pub fn usable(&self) -> Vec<usize> {
        (0..self.frames.len()).filter(|&i| self.frames[i].other_shape.is_none()).collect()
    }

    /// Number of entries of the pose file, those that are left out counted.
    pub fn entries(&self) -> usize {
        let frames = self.frames.iter().map(|frame| frame.entry);
        frames.chain(self.left_out.iter().map(|left| left.entry)).max().map_or(0, |last| last + 1)
    }

    /// Index of the frame of an entry ([`Frame::entry`]); `None` for one that is left out.
    pub fn frame_of_entry(&self, entry: usize) -> Option<usize> {
        self.frames.iter().position(|frame| frame.entry == entry)
    }

    /// Takes a frame that cannot be loaded, because of `error`, from the scene. The indices of those behind it fall by
    /// one.
    pub fn leave_out(&mut self, frame: usize, error: &Error) {
        let frame = self.frames.remove(frame);
        self.left_out.push(LeftOut::of_frame(&frame, error));
        self.left_out.sort_by_key(|left| left.entry);
    }

    /// Makes a scene of two photographs and their cameras. The cameras refer to the
    /// upright pixels ([`Pixels::Upright`]) and have the upright pictures' sizes.
    ///
    /// # Errors
    /// A picture that is missing, malformed or of another size.
    pub fn from_pair(
        a: impl AsRef<Path>,
        b: impl AsRef<Path>,
        camera_a: Camera,
        camera_b: Camera,
    ) -> Result<Self> {
        let (a, b) = (a.as_ref(), b.as_ref());
        let photographs = [(a.to_owned(), camera_a), (b.to_owned(), camera_b)];
        Self::from_photographs(SceneFormat::Pair, a, &photographs)
    }

    /// Makes a scene of photographs and the cameras of their upright pixels. `path` names the
    /// scene in messages.
    ///
    /// # Errors
    /// As [`Scene::from_pair`].
    pub fn from_photographs(
        source: SceneFormat,
        path: impl AsRef<Path>,
        photographs: &[(PathBuf, Camera)],
    ) -> Result<Self> {
        let names = distinct_names(photographs.iter().map(|(path, _)| path.as_path()));
        let drafts = photographs.iter().zip(names).map(|(photo, name)| upright_draft(photo, &name));
        let reading = Reading::new(Pictures::Needed);
        assemble(path.as_ref(), source, &reading, drafts.collect())
    }

    /// [`Scene::from_photographs`] of photographs and of views of them.
    #[cfg(feature = "network")]
    pub(crate) fn from_views(
        source: SceneFormat,
        path: &Path,
        views: &[PosedView],
    ) -> Result<Self> {
        let mut files: Vec<&Path> = views.iter().map(|view| view.photograph.as_path()).collect();
        files.dedup();
        let names = distinct_names(files.iter().copied());
        let named: HashMap<&Path, &Path> =
            files.iter().copied().zip(names.iter().map(PathBuf::as_path)).collect();
        let draft = |view: &PosedView| {
            let name = named.get(view.photograph.as_path()).copied().unwrap_or(Path::new(""));
            let draft = upright_draft(&(view.photograph.clone(), view.camera), name);
            let label = view.label.clone();
            Draft { view: view.cut.map(|cut| DraftView { cut, label }), ..draft }
        };
        let drafts = views.iter().map(draft).collect();
        assemble(path, source, &Reading::new(Pictures::Needed), drafts)
    }
}

/// A photograph, or a view of one, with its camera.
#[cfg(feature = "network")]
#[derive(Clone, Debug)]
pub(crate) struct PosedView {
    /// File.
    pub photograph: PathBuf,
    /// The view; `None` for the whole photograph.
    pub cut: Option<Cut>,
    /// End of the view's name.
    pub label: String,
    /// Camera of the view.
    pub camera: Camera,
}

/// Names of photographs: those of the files where all differ, else the paths below the folder that all have in
/// common.
pub fn distinct_names<'a>(paths: impl Iterator<Item = &'a Path> + Clone) -> Vec<PathBuf> {
    let files: Vec<PathBuf> =
        paths.clone().filter_map(|p| p.file_name().map(PathBuf::from)).collect();
    let distinct: HashSet<&PathBuf> = files.iter().collect();
    let count = paths.clone().count();
    if distinct.len() == count {
        return files;
    }
    let mut common: Option<PathBuf> = None;
    for path in paths.clone() {
        let parent = path.parent().unwrap_or(Path::new(""));
        let shared = common.as_deref().unwrap_or(parent).components().zip(parent.components());
        common = Some(shared.take_while(|(a, b)| a == b).map(|(a, _)| a).collect());
    }
    let common = common.unwrap_or_default();
    paths.map(|path| path.strip_prefix(&common).unwrap_or(path).to_owned()).collect()
}

/// Name of a frame: the path of its picture in a pose file, without `images/` and without the extension of a
/// picture. A name without such an extension may have dots.
pub fn frame_name(file: &str) -> String {
    assemble::frame_name(file)
}

/// Returns a frame of a photograph and the camera of its upright pixels.
fn upright_draft((path, camera): &(PathBuf, Camera), name: &Path) -> Draft {
    let k = camera.intrinsics();
    Draft {
        size: Some((k.width, k.height)),
        pixels: Pixels::Upright,
        image: Some(path.clone()),
        ..Draft::new(
            String::new(),
            name.to_string_lossy().into_owned(),
            Lens::Pixels([k.fx, k.fy, k.cx, k.cy].map(f64::from)),
            camera.world_from_camera().as_dmat4(),
        )
    }
}

/// Reads the scene of a folder or of a pose file.
///
/// # Errors
/// No pose file; a malformed pose file (the error names file and line or byte); no picture;
/// a picture whose size does not match its camera.
pub fn load_scene(path: impl AsRef<Path>) -> Result<Scene> {
    load_at(path.as_ref(), Pictures::Needed, &SceneOptions::default())
}

/// Reads a scene as [`load_scene`] does, with options.
///
/// ```no_run
/// use subsplat::files::poses::reading::SceneOptions;
/// use subsplat::files::poses::scene::load_scene_with;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let options = SceneOptions { model: Some("sparse/1".into()), strict: true, ..Default::default() };
/// let scene = load_scene_with("garden", &options)?;
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Errors of [`load_scene`]; with [`SceneOptions::strict`] an entry that [`load_scene`] leaves out.
pub fn load_scene_with(path: impl AsRef<Path>, options: &SceneOptions) -> Result<Scene> {
    load_at(path.as_ref(), Pictures::Needed, options)
}

/// Reads the cameras of a folder or of a pose file as [`load_scene`] does. Their pictures need not exist:
/// [`Frame::image`] is empty where there is none.
///
/// # Errors
/// No pose file; a malformed pose file; no camera with the size of its picture.
pub fn load_cameras(path: impl AsRef<Path>) -> Result<Scene> {
    load_at(path.as_ref(), Pictures::Unread, &SceneOptions::default())
}

/// Reads cameras as [`load_cameras`] does, with options.
///
/// # Errors
/// Errors of [`load_cameras`]; with [`SceneOptions::strict`] an entry that [`load_cameras`] leaves out.
pub fn load_cameras_with(path: impl AsRef<Path>, options: &SceneOptions) -> Result<Scene> {
    load_at(path.as_ref(), Pictures::Unread, options)
}

/// Reports whether `path` is a folder with a pose file that [`load_scene`] reads.
pub fn is_scene(path: impl AsRef<Path>) -> bool {
    find_in(path.as_ref()).is_ok_and(|found| found.is_some())
}

/// Reports whether [`load_scene`] finds a pose file in the folder `path` or, where it has no photographs, in a
/// folder below it.
pub fn has_scene(path: impl AsRef<Path>) -> bool {
    find(path.as_ref()).is_ok_and(|found| found.is_some())
}
