//! Arguments of `view`, and its keys.

use super::args::{ConventionArg, CropShapeArg, DetailArg, RenderingArgs, SourceArgs};
use super::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use subsplat::{FitOptions, Refine};
use subsplat_kernels::gpu::DeviceChoice;

/// The window's keys, which `--help` and the H key show.
pub const KEYS: &str = "\
In the window:
  left drag                turn around the scene (orbit), look around (fly)
  right or shift drag      pan
  wheel                    nearer or farther (orbit), faster or slower (fly)
  W A S D Q E              forward, left, back, right, down, up; with shift four times as fast
  F                        orbit or fly
  R                        back to the first camera
  1 2 4                    children a side of a pixel: x1, x2, x4 (of photographs)
  L                        all Gaussians, or fewer where they are far
  P                        save the picture
  H                        this list
  Esc                      quit";

/// Gaussians that the window draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LevelsArg {
    /// Gaussians far below a pixel are replaced by fewer, merged ones.
    Auto,
    /// All Gaussians.
    Off,
}

/// Arguments of `view`.
#[derive(Clone, Debug, Args)]
pub struct ViewArgs {
    /// A finished scene (.ply, .compressed.ply, .splat, .spz, .ksplat, .glb); or a scene folder,
    /// a pose file, photographs or a folder of them, which are reconstructed first.
    #[arg(required = true, num_args = 1.., value_name = "SPLATS | SCENE | IMG… | DIR")]
    pub input: Vec<PathBuf>,
    /// Initial size of the window, px: N, or WxH (default: the first camera's picture, at most
    /// 1280x960).
    #[arg(long, value_name = "N | WxH", value_parser = values::size)]
    pub size: Option<(usize, usize)>,
    /// Device for rendering: gpu (any adapter), auto (no software adapter), or an adapter by a
    /// part of its name.
    #[arg(long, default_value = "gpu", value_name = "auto|gpu|NAME")]
    pub device: String,
    /// Draw this many frames and quit.
    #[arg(long, value_name = "N", value_parser = values::frames)]
    pub frames: Option<usize>,
    /// Save the last of `--frames` (PNG).
    #[arg(long, value_name = "FILE", requires = "frames")]
    pub save: Option<PathBuf>,
    /// Folder for the pictures that P saves, as NAME-0001.png and so on.
    #[arg(short, long, default_value = ".", value_name = "DIR")]
    pub out: PathBuf,
    /// Cameras of a finished scene: any pose file or scene folder; the first one is the initial
    /// view. Default: cameras.json beside the scene, else a view of the whole.
    #[arg(long, value_name = "SCENE")]
    pub cameras: Option<PathBuf>,
    /// Level of detail by the distance; L switches it in the window.
    #[arg(long, value_enum, default_value_t = LevelsArg::Auto)]
    pub levels: LevelsArg,
    /// Options of the reconstruction.
    #[command(flatten)]
    pub source: SourceArgs,
    /// Rules of the rasterizer. Default: the model's own; for scene files those that `run` wrote
    /// into them (.ply, .glb), else `standard`.
    #[arg(long, value_enum)]
    pub convention: Option<ConventionArg>,
    /// Background colour, R,G,B in [0, 1]. Default: the model's own (the inputs' mean
    /// colour, or black); for scene files the one that `run` wrote into them, else black.
    #[arg(
        long,
        value_parser = values::colour,
        allow_hyphen_values = true,
        value_name = "R,G,B"
    )]
    pub background: Option<[f32; 3]>,
}

impl ViewArgs {
    /// Options of the rendering, in the form of the other commands.
    pub fn rendering(&self) -> RenderingArgs {
        RenderingArgs {
            convention: self.convention,
            lowpass_ref: None,
            background: self.background,
            device: self.device.clone(),
        }
    }

    /// The conflict between arguments that need no file, if there is one.
    pub fn conflict(&self) -> Option<String> {
        let cpu = self.device.parse() == Ok(DeviceChoice::Cpu);
        let device =
            || "--device: expected auto, gpu or an adapter's name, as a window needs one; got cpu";
        values::depth_conflict(self.source.near, self.source.far)
            .or_else(|| cpu.then(|| device().to_owned()))
    }

    /// The first flag on the command line that applies to photographs only.
    pub fn photograph_flag(&self) -> Option<&'static str> {
        let source = &self.source;
        let flags = [
            (!source.context.is_empty(), "--context"),
            (source.upscale.is_some(), "--upscale"),
            (source.weights.is_some(), "--weights"),
            (source.seed.is_some(), "--seed"),
            (source.far.is_some(), "--far"),
            (source.quality.is_some(), "--quality"),
            (source.crop != CropShapeArg::Whole, "--crop"),
            (source.detail != DetailArg::Photo, "--detail"),
            (source.fit != FitOptions::default().steps, "--fit"),
            (source.refine != Refine::Auto, "--refine"),
            (source.model.backbone.is_some(), "--backbone"),
            (source.model.preset.is_some(), "--preset"),
            (source.model.config.is_some(), "--config"),
            (source.no_check, "--no-check"),
            (source.adjust_poses, "--adjust-poses"),
            (source.pair.pose_convention.is_some(), "--pose-convention"),
        ];
        flags.into_iter().find(|f| f.0).map(|f| f.1).or(source.pair.first_flag())
    }
}
