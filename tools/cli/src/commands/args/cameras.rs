//! Arguments about the cameras of photographs that come without a pose file.

use super::groups::CAMERAS;
use crate::commands::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use subsplat::files::poses::matrices::PoseConvention;
use subsplat::files::poses::reading::SceneOptions;
use subsplat::reconstruct::Projection;

/// Help of `--fov`: in short and whole.
pub(super) const FOV_HELP: [&str; 2] = [
    "Angle of view across, degrees; replaces EXIF's",
    "Angle of view across, degrees; replaces EXIF's.\n\n\
     It holds for all photographs; a warning says where the points of three or more contradict it. Without it, \
     the focal length comes from EXIF, else it is estimated, for each photograph of a zoom lens. The estimate \
     from two photographs alone is often wrong.",
];
/// Help of `--intrinsics`.
pub(super) const INTRINSICS_HELP: &str =
    "Focal lengths and centre, pixels: FX,FY,CX,CY or 3x3 numbers";
/// Help of `--lens`: in short and whole.
pub(super) const LENS_HELP: [&str; 2] = [
    "Lens of the photographs: pinhole, panorama, or `fisheye[:DEG][:CURVE]`",
    "Lens of the photographs: pinhole, panorama, or `fisheye[:DEG][:CURVE]`.\n\n\
     By default a picture is a panorama where the file says so, or where it is twice as wide as high and its \
     left and right edges continue each other; else a photograph. Six views of 90 degrees are made of a \
     panorama, one of at most 90 degrees of a fisheye picture. Three or more photographs show whether their \
     lens bends straight lines, as those of action cameras do, and are then straightened; pinhole reads them \
     as they are. DEG: angle across the circle (180). CURVE: \
     equidistant (the default), equisolid or stereographic.",
];

/// Parts of a scene with cameras that are read.
#[derive(Clone, Debug, Default, Args)]
pub struct ReadArgs {
    /// Cameras to read, where a scene has several: a pose file, or the folder of a COLMAP model.
    ///
    /// The path is one below the scene's folder, such as sparse/1 or transforms_test.json, or any other.
    /// Default: of several models the largest; a line names the others.
    #[arg(long = "model", value_name = "PATH", hide_short_help = true, help_heading = CAMERAS)]
    pub model_path: Option<PathBuf>,
    /// Folder of the scene's pictures.
    ///
    /// Default: the folders in which the program that wrote the cameras has them, such as images beside
    /// transforms.json.
    #[arg(long = "images", value_name = "DIR", hide_short_help = true, help_heading = CAMERAS)]
    pub images: Option<PathBuf>,
    /// Refuse what would be left out: broken cameras, pictures that cannot be read, unused masks.
    ///
    /// The error names the first, and their number. Default: what is not needed is left out, and a line
    /// names it.
    #[arg(long, hide_short_help = true, help_heading = CAMERAS)]
    pub strict: bool,
}

impl ReadArgs {
    /// Options of the scene's loader.
    pub fn options(&self, convention: Option<PoseConvention>) -> SceneOptions {
        let Self { model_path, images, strict } = self.clone();
        SceneOptions { model: model_path, images, strict, convention }
    }
}

/// Cameras of photographs that come without a pose file.
///
/// Without --move and --pose-b the poses are estimated. Without --fov and --intrinsics the focal
/// length comes from EXIF, else it is estimated too. With a pose of the second of two photographs,
/// the first camera is the world unless --pose-a is given.
#[derive(Clone, Debug, Args)]
pub struct PairArgs {
    /// See `FOV_HELP`.
    #[arg(
        long,
        help = FOV_HELP[0],
        long_help = FOV_HELP[1],
        value_name = "DEG",
        conflicts_with = "intrinsics",
        allow_negative_numbers = true,
        value_parser = values::fov,
        help_heading = CAMERAS
    )]
    pub fov: Option<f32>,
    /// See `INTRINSICS_HELP`.
    #[arg(
        long,
        help = INTRINSICS_HELP,
        value_name = "K",
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub intrinsics: Option<String>,
    /// See `LENS_HELP`.
    #[arg(
        long,
        help = LENS_HELP[0],
        long_help = LENS_HELP[1],
        value_name = "LENS",
        value_parser = values::projection,
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub lens: Option<Projection>,
    /// Position of the second of two cameras as seen from the first: right, down, forward.
    ///
    /// Its unit becomes that of the scene.
    #[arg(
        long = "move",
        value_parser = values::triple,
        allow_hyphen_values = true,
        value_name = "X,Y,Z",
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub translation: Option<[f32; 3]>,
    /// Rotation of the second of two cameras against the first: degrees about x, then y, then z.
    #[arg(
        long,
        value_parser = values::triple,
        allow_hyphen_values = true,
        value_name = "RX,RY,RZ",
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub turn: Option<[f32; 3]>,
    /// Pose matrix of the first photograph: 12 or 16 numbers, row by row.
    #[arg(
        long,
        allow_hyphen_values = true,
        value_name = "M",
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub pose_a: Option<String>,
    /// Pose matrix of the second photograph: 12 or 16 numbers, row by row.
    #[arg(
        long,
        allow_hyphen_values = true,
        value_name = "M",
        conflicts_with_all = ["translation", "turn"],
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub pose_b: Option<String>,
    /// Axes and direction of --pose-a and --pose-b, or of a scene's matrices.
    ///
    /// A scene with poses.txt, transforms.json, a matrix file of each picture, or cameras of Polycam, 3D Scanner App or
    /// MVSNet: where a program wrote other axes than the format's. Default: opengl-c2w for transforms.json, Polycam and 3D
    /// Scanner App, opencv-w2c for MVSNet, else opencv-c2w; where the photographs contradict it and one other fits them,
    /// that one, and a line says so.
    #[arg(long, value_enum, hide_short_help = true, help_heading = CAMERAS)]
    pub pose_convention: Option<PoseConventionArg>,
    /// Cameras and pictures of a scene.
    #[command(flatten)]
    pub read: ReadArgs,
    /// Accept doubtful cameras and truncated JPEG files.
    #[arg(long, help_heading = CAMERAS)]
    pub force: bool,
}

/// Axes and direction of a pose matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PoseConventionArg {
    /// Camera-to-world, x right, y down, z forward.
    OpencvC2w,
    /// World-to-camera, x right, y down, z forward.
    OpencvW2c,
    /// Camera-to-world, x right, y up, z backward (NeRF, Blender).
    OpenglC2w,
}
