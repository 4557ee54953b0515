//! Arguments of `render`.

use super::groups::{CAMERAS, PICTURES, SIZE};
use super::rendering::{MotionArgs, PathArg, RenderingArgs};
use crate::commands::values;
use clap::Args;
use std::path::PathBuf;

/// Arguments of `render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// The scene: .ply, .splat, .spz, .sog, .ksplat or .glb; or a folder that `run` wrote.
    ///
    /// A .compressed.ply is read too.
    #[arg(value_name = "SPLATS | DIR")]
    pub scene: PathBuf,
    /// Folder for the pictures.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Views to draw.
    #[arg(long, value_enum, default_value = "targets", help_heading = PICTURES)]
    pub path: PathArg,
    /// Length, radius and animation of a path.
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Distances as pictures too.
    ///
    /// The folder depth/ gets them with 16 bits, and depth_colour/ in colours with a legend.
    #[arg(long, help_heading = PICTURES)]
    pub depth: bool,
    /// Options of the rendering.
    #[command(flatten)]
    pub rendering: RenderingArgs,
    /// Variation of a splat's colour with the viewing direction: degree of the spherical harmonics, 0 to 4.
    ///
    /// 0 draws every splat in one colour from all sides.
    #[arg(
        long,
        default_value_t = 4,
        value_name = "0…4",
        value_parser = values::sh_degree,
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub sh_degree: usize,
    /// Distance below which splats are not drawn, in the scene's unit.
    ///
    /// Under `--convention mvsplat` a fifth of it.
    #[arg(
        long,
        allow_negative_numbers = true,
        value_parser = values::positive,
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub near: Option<f32>,
    /// Cameras to draw from: a pose file or a scene folder.
    ///
    /// Default: cameras.json beside the scene; else the camera that the file holds; else a view of
    /// the whole.
    #[arg(long, value_name = "SCENE", help_heading = CAMERAS)]
    pub cameras: Option<PathBuf>,
    /// Cameras of --cameras to read, where that scene has several: a pose file, or the folder of a COLMAP model.
    #[arg(long, value_name = "PATH", requires = "cameras", help_heading = CAMERAS)]
    pub model: Option<PathBuf>,
    /// Refuse what would be left out: splats that are no numbers, cameras that are broken.
    ///
    /// The error names the first, and their number.
    #[arg(long, hide_short_help = true, help_heading = CAMERAS)]
    pub strict: bool,
    /// Cameras to draw from, among those of --cameras: names or numbers from 0 (default: all).
    #[arg(long, value_delimiter = ',', value_name = "I,J,…", help_heading = CAMERAS)]
    pub target: Vec<String>,
    /// Size of the pictures in pixels: 1920x1080, or N for NxN.
    ///
    /// Default: the cameras' own.
    #[arg(long, value_name = "N | WxH", value_parser = values::size, help_heading = SIZE)]
    pub size: Option<(usize, usize)>,
}
