//! Arguments of `run`.

use super::files::{ContentArgs, SceneFormatArg};
use super::groups::{PICTURES, SIZE};
use super::rendering::{MotionArgs, PathArg, RenderingArgs};
use super::source::SourceArgs;
use crate::commands::values;
use clap::Args;
use std::path::PathBuf;
use subsplat::{Size, TargetSize};

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Photographs, a folder of them, or a scene with cameras.
    ///
    /// Of photographs alone the cameras are found first. A scene with cameras is a folder or a pose
    /// file: cameras.json, transforms.json, COLMAP's model, RealEstate10K's txt, or poses.txt with
    /// K.txt.
    #[arg(required = true, num_args = 1.., value_name = "IMG… | DIR | SCENE")]
    pub input: Vec<PathBuf>,
    /// Folder for the results.
    ///
    /// A folder that holds the cameras of a scene is refused, because its cameras.json would be
    /// replaced.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Formats of the scene file.
    ///
    /// The files are named scene.ply and so on.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ply", value_name = "F,…")]
    pub save: Vec<SceneFormatArg>,
    /// Content of the scene files.
    #[command(flatten)]
    pub content: ContentArgs,
    /// Views to draw.
    #[arg(long, value_enum, default_value = "targets", help_heading = PICTURES)]
    pub path: PathArg,
    /// Photographs to draw again and compare with: names or numbers.
    ///
    /// Names are those of the files; numbers count from 0. Default: those that protocol.json names, else those taken between the ones that the scene is
    /// made from, else none.
    #[arg(long, value_delimiter = ',', value_name = "I,J,…", help_heading = PICTURES)]
    pub target: Vec<String>,
    /// Length, radius and animation of a path.
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Options of the rendering.
    #[command(flatten)]
    pub rendering: RenderingArgs,
    /// Options of the reconstruction.
    #[command(flatten)]
    pub source: SourceArgs,
    /// Size of the pictures in pixels: 1920x1080, or N for NxN.
    ///
    /// The photographs are cropped to this shape. Without --upscale the scene has as many splats as
    /// these pictures need (at most 64 for each pixel that the network reads).
    #[arg(
        long,
        value_name = "N | WxH",
        value_parser = values::size,
        display_order = 0,
        help_heading = SIZE
    )]
    pub size: Option<(usize, usize)>,
}

impl RunArgs {
    /// Size of the pictures: --size, else --upscale times the input.
    pub fn target_size(&self) -> TargetSize {
        match self.size {
            Some((width, height)) => TargetSize::Exact(Size::new(width, height)),
            None => self.source.target_size(),
        }
    }
}
