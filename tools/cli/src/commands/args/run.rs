//! Arguments of `run`.

use super::files::{ContentArgs, SceneFormatArg};
use super::groups::{CAMERAS, PICTURES, SIZE};
use super::rendering::{MotionArgs, PathArg, RenderingArgs};
use super::source::{QualityArg, SourceArgs};
use crate::commands::values;
use clap::Args;
use std::path::PathBuf;
use subsplat::{Size, TargetSize};

/// Arguments of `run`.
#[derive(Clone, Debug, Args)]
pub struct RunArgs {
    /// Photographs, a folder of them, a video, or a scene with cameras.
    ///
    /// Of photographs alone the cameras are found first. Of a video (ffmpeg reads it) sharp frames are taken where the
    /// camera has moved on, and kept in the folder `frames` of the results. A scene with cameras is a folder or a pose
    /// file: cameras.json, transforms.json, COLMAP's model, RealEstate10K's txt, poses.txt with K.txt, or cameras of
    /// another program or data set (OpenSfM, OpenMVG, Meshroom, Metashape, RealityCapture, Polycam, Record3D, 3D Scanner
    /// App, Bundler, LLFF, MVSNet, NeuS, ScanNet, 7-Scenes, NSVF, NeRF++).
    #[arg(required = true, num_args = 1.., value_name = "IMG… | DIR | VIDEO | SCENE")]
    pub input: Vec<PathBuf>,
    /// Folder for the results.
    ///
    /// A folder that holds the cameras of a scene is refused, because its cameras.json would be
    /// replaced.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Formats of the scene file (default: ply and html).
    ///
    /// The files are named scene.ply and so on. Without this flag the page scene.html has at most 12 MB: of a larger
    /// scene it gets one colour for all views, then fewer splats.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "F,…")]
    pub save: Vec<SceneFormatArg>,
    /// Open the page with the scene in the browser at the end.
    #[arg(long)]
    pub open: bool,
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
    /// Most frames to take from a video, 2 to 100.
    ///
    /// 10 to 60 do best. Default: as many as the camera's motion needs, 12 to 36. --frames says the same where neither
    /// --path nor --video is given.
    #[arg(long, value_name = "N", value_parser = values::taken, hide_short_help = true, help_heading = CAMERAS)]
    pub take: Option<usize>,
    /// Length, radius and animation of a path.
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Options of the rendering.
    #[command(flatten)]
    pub rendering: RenderingArgs,
    /// Options of the reconstruction.
    #[command(flatten)]
    pub source: SourceArgs,
    /// Size of the pictures in pixels: 1920x1080, N for NxN, or `photo`.
    ///
    /// The photographs are cropped to this shape. Without --upscale the scene has as many splats as
    /// these pictures need (at most 64 for each pixel that the network reads). `photo`: the
    /// photographs' own size, at most four megapixels.
    #[arg(
        long,
        value_name = "N | WxH | photo",
        value_parser = values::picture_size,
        display_order = 0,
        help_heading = SIZE
    )]
    pub size: Option<PictureSizeArg>,
}

/// Most pixels of `--size photo`.
const PHOTO_PIXELS: usize = 4_000_000;
/// Most pixels of `--quality best` without a size: twice as many take twice the time.
const BEST_PIXELS: usize = 1920 * 1080;

/// Size of the pictures of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureSizeArg {
    /// Width and height, px.
    Sides(usize, usize),
    /// That of the photographs.
    Photo,
}

impl RunArgs {
    /// Formats of the scene file, each once.
    pub fn formats(&self) -> Vec<SceneFormatArg> {
        let mut formats = Vec::new();
        let asked = match self.save.as_slice() {
            [] => &[SceneFormatArg::Ply, SceneFormatArg::Html],
            asked => asked,
        };
        let page = self.open.then_some(&SceneFormatArg::Html);
        for format in asked.iter().chain(page) {
            if !formats.contains(format) {
                formats.push(*format);
            }
        }
        formats
    }

    /// Returns whether the page was asked for by name, and holds the scene whatever its size.
    pub fn whole_page(&self) -> bool {
        self.save.contains(&SceneFormatArg::Html)
    }

    /// Size of the pictures: --size, else --upscale times the input; with the best quality that of the
    /// photographs.
    pub fn target_size(&self) -> TargetSize {
        let best = self.source.quality == QualityArg::Best && self.source.upscale.is_none();
        match self.size {
            Some(PictureSizeArg::Sides(width, height)) => {
                TargetSize::Exact(Size::new(width, height))
            }
            Some(PictureSizeArg::Photo) => TargetSize::Photographs(PHOTO_PIXELS),
            None if best => TargetSize::Photographs(BEST_PIXELS),
            None => self.source.target_size(),
        }
    }
}
