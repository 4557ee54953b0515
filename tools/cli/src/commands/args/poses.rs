//! Arguments of `poses`.

use super::cameras::{FOV_HELP, INTRINSICS_HELP, LENS_HELP};
use crate::commands::values;
use clap::Args;
use std::path::PathBuf;
use subsplat::reconstruct::Projection;

/// Arguments of `poses`.
#[derive(Clone, Debug, Args)]
pub struct PosesArgs {
    /// Photographs of one scene in any order, a folder of them, or a video.
    ///
    /// Of a video (ffmpeg reads it) sharp frames are taken where the camera has moved on, and kept in the folder
    /// `frames` beside cameras.json.
    #[arg(required = true, num_args = 1.., value_name = "IMG… | DIR | VIDEO")]
    pub input: Vec<PathBuf>,
    /// A .json file for the cameras, or a folder for cameras.json and COLMAP's model.
    ///
    /// The folder gets cameras.json, and COLMAP's text model in sparse/0.
    #[arg(short, long, default_value = "poses", value_name = "FILE | DIR")]
    pub out: PathBuf,
    /// Most frames to take from a video, 2 to 100.
    ///
    /// 10 to 60 do best. Default: as many as the camera's motion needs, 12 to 36.
    #[arg(long, value_name = "N", value_parser = values::taken)]
    pub frames: Option<usize>,
    /// See `FOV_HELP`.
    #[arg(
        long,
        help = FOV_HELP[0],
        long_help = FOV_HELP[1],
        value_name = "DEG",
        conflicts_with = "intrinsics",
        value_parser = values::fov
    )]
    pub fov: Option<f32>,
    /// See `INTRINSICS_HELP`.
    #[arg(long, help = INTRINSICS_HELP, value_name = "K")]
    pub intrinsics: Option<String>,
    /// See `LENS_HELP`.
    #[arg(
        long,
        help = LENS_HELP[0],
        long_help = LENS_HELP[1],
        value_name = "LENS",
        value_parser = values::projection
    )]
    pub lens: Option<Projection>,
    /// Accept doubtful cameras and truncated JPEG files.
    #[arg(long)]
    pub force: bool,
    /// Refuse pictures that cannot be read; the error names the first, and their number.
    ///
    /// Default: they are left out, and a line names them.
    #[arg(long)]
    pub strict: bool,
}
