//! Arguments about the pictures that are drawn.

use super::groups::PICTURES;
use crate::commands::frames::Loop;
use crate::commands::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// Number of views of a path that is asked for.
const PATH_FRAMES: usize = 30;
/// Seconds of a --video without --frames.
const CLIP_SECONDS: usize = 6;

/// The rules of a rasterizer.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum ConventionArg {
    /// Those of 3D Gaussian Splatting, which viewers follow.
    Standard,
    /// Those that MVSplat's published weights were trained with.
    Mvsplat,
}

impl From<ConventionArg> for subsplat_kernels::layout::Convention {
    fn from(arg: ConventionArg) -> Self {
        match arg {
            ConventionArg::Standard => Self::Standard,
            ConventionArg::Mvsplat => Self::Mvsplat,
        }
    }
}

/// The picture whose pixels are the unit of the low-pass.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum LowpassArg {
    /// The picture that is drawn, as viewers do it.
    Target,
    /// The smaller picture that the network reads.
    Input,
}

/// Cameras to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PathArg {
    /// Single views: those of --target; else photographs that the scene was not made from, or the
    /// cameras of a finished scene.
    Targets,
    /// A path from the first photograph's camera to the last.
    Interpolate,
    /// A circle around the middle of the cameras.
    Orbit,
    /// A spiral of two turns around the middle of the cameras.
    Spiral,
    /// A movement towards the scene and back.
    Dolly,
}

impl PathArg {
    /// The closed path around the cameras that this is, if it is one.
    pub fn closed(self) -> Option<Loop> {
        match self {
            Self::Targets | Self::Interpolate => None,
            Self::Orbit => Some(Loop::Orbit),
            Self::Spiral => Some(Loop::Spiral),
            Self::Dolly => Some(Loop::Dolly),
        }
    }
}

/// Length, radius and animation of a path.
#[derive(Clone, Debug, Args)]
pub struct MotionArgs {
    /// Number of views of a --path.
    ///
    /// Default: 30; with --video 6 seconds, from the first camera to the last and back; 3 for `run` without --path and
    /// without photographs to compare with. Of a video, without --path and --video: the most frames to take from it, as
    /// --take.
    #[arg(long, value_name = "N", value_parser = values::frames, help_heading = PICTURES)]
    pub frames: Option<usize>,
    /// Radius of --path orbit, spiral and dolly, in the unit of the cameras' positions.
    ///
    /// Default: near points move against far ones by 6 % of the picture's width, or half the
    /// distance between the cameras where that is more.
    #[arg(
        long,
        value_name = "R",
        allow_negative_numbers = true,
        value_parser = values::positive,
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub orbit_radius: Option<f32>,
    /// File for the views as an animation: .gif, .webp, .mp4 or .webm.
    ///
    /// Without --frames it takes 6 seconds, and as .mp4 or .webm at most about 2 MB. .gif and .webp need no other
    /// program, .mp4 none in builds with the feature `mp4`; else .mp4 and .webm need ffmpeg.
    #[arg(long, value_name = "FILE", help_heading = PICTURES)]
    pub video: Option<PathBuf>,
    /// Views a second in --video.
    #[arg(
        long,
        default_value_t = 25,
        value_name = "N",
        value_parser = values::rate,
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub fps: u32,
}

impl MotionArgs {
    /// Returns true if these arguments ask for an animation of the default length, which ends where it begins.
    pub fn is_clip(&self) -> bool {
        self.video.is_some() && self.frames.is_none()
    }

    /// Number of views of a path that is asked for.
    pub fn path_frames(&self) -> usize {
        let default = if self.is_clip() { CLIP_SECONDS * self.fps as usize } else { PATH_FRAMES };
        self.frames.unwrap_or(default)
    }
}

/// Rendering options.
#[derive(Clone, Debug, Args)]
pub struct RenderingArgs {
    /// Processor: cpu, auto, gpu, or a part of a GPU's name.
    ///
    /// The processor draws the pictures; with `run` it also does most of the reconstruction. `auto`: a
    /// hardware GPU, else the CPU. `gpu`: any GPU, also one imitated in software. Where the GPU fails, the
    /// CPU does the work, with a warning.
    #[arg(long, default_value = "cpu", value_name = "NAME")]
    pub device: String,
    /// Colour behind the scene: red, green and blue from 0 to 1.
    ///
    /// Default: for photographs their mean colour, or black with `re10k`; for a scene file the colour that
    /// `run` stored in it, else black.
    #[arg(
        long,
        value_parser = values::colour,
        allow_hyphen_values = true,
        value_name = "R,G,B",
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub background: Option<[f32; 3]>,
    /// Rules by which splats are drawn.
    ///
    /// Default: those of the network; for a scene file what `run` wrote into it (.ply, .glb, .sog), else
    /// `standard`.
    #[arg(long, value_enum, hide_short_help = true, help_heading = PICTURES)]
    pub convention: Option<ConventionArg>,
    /// Smallest drawn size of a splat: a pixel of the drawn picture, or of the picture that the network reads.
    ///
    /// A splat smaller than a pixel would flicker. It is therefore drawn blurred by 0.3 square
    /// pixels, of the picture that is drawn or of the smaller one that the network reads.
    #[arg(long, value_enum, hide_short_help = true, help_heading = PICTURES)]
    pub lowpass_ref: Option<LowpassArg>,
}
