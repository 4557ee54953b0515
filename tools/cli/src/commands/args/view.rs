//! Arguments of `view`, and its keys.

use super::groups::{PICTURES, SIZE};
use super::{
    AdjustPosesArg, ConventionArg, CropShapeArg, DetailArg, MatchingArg, QualityArg, RenderingArgs,
    SourceArgs, SurroundingsArg,
};
use crate::commands::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
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
  1 2 4                    resolution of the scene: x1, x2, x4 (of photographs)
  L                        all splats, or fewer where they are far away
  P                        save the picture
  H                        this list
  Esc                      quit";

/// Gaussians that the window draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LevelsArg {
    /// Splats far smaller than a pixel are replaced by fewer, merged ones: faster.
    Auto,
    /// All splats.
    Off,
}

/// Arguments of `view`.
#[derive(Clone, Debug, Args)]
pub struct ViewArgs {
    /// A finished scene, or photographs, a folder of them, or a scene with cameras.
    ///
    /// A finished scene is a .ply, .compressed.ply, .splat, .spz, .sog, .ksplat or .glb. From
    /// other input the program makes a scene first, as `run` does. Of a folder that `run` wrote, name the
    /// file: out/scene.ply.
    #[arg(required = true, num_args = 1.., value_name = "SPLATS | SCENE | IMG… | DIR")]
    pub input: Vec<PathBuf>,
    /// Folder for the pictures that the key P saves, as NAME-0001.png and so on.
    #[arg(short, long, default_value = ".", value_name = "DIR")]
    pub out: PathBuf,
    /// GPU that draws: gpu, auto, or a part of its name.
    ///
    /// `gpu` takes any GPU, `auto` only a hardware GPU.
    #[arg(long, default_value = "gpu", value_name = "NAME")]
    pub device: String,
    /// Cameras of a finished scene: a pose file of any kind, or a scene folder.
    ///
    /// The first one is the initial view. Default: cameras.json beside the scene, else a view of the
    /// whole.
    #[arg(long, value_name = "SCENE", help_heading = PICTURES)]
    pub cameras: Option<PathBuf>,
    /// Draw this many pictures and quit.
    #[arg(
        long,
        value_name = "N",
        value_parser = values::frames,
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub frames: Option<usize>,
    /// Save the last of --frames (PNG).
    #[arg(
        long,
        value_name = "FILE",
        requires = "frames",
        hide_short_help = true,
        help_heading = PICTURES
    )]
    pub save: Option<PathBuf>,
    /// Splats far away: auto merges them (faster), off draws all; the key L switches.
    #[arg(long, value_enum, default_value_t = LevelsArg::Auto, help_heading = PICTURES)]
    pub levels: LevelsArg,
    /// Rules by which splats are drawn.
    ///
    /// Default: those of the network; for a scene file what `run` wrote into it (.ply, .glb, .sog), else
    /// `standard`.
    #[arg(long, value_enum, hide_short_help = true, help_heading = PICTURES)]
    pub convention: Option<ConventionArg>,
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
    /// Options of the reconstruction.
    #[command(flatten)]
    pub source: SourceArgs,
    /// Size of the window in pixels: 1280x960, or N for NxN.
    ///
    /// Default: that of the first camera's picture, at most 1280x960.
    #[arg(
        long,
        value_name = "N | WxH",
        value_parser = values::size,
        display_order = 0,
        help_heading = SIZE
    )]
    pub size: Option<(usize, usize)>,
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
            (source.quality != QualityArg::Normal, "--quality"),
            (source.input_size.is_some(), "--input-size"),
            (source.gaussians.is_some(), "--gaussians"),
            (source.crop != CropShapeArg::Whole, "--crop"),
            (source.matching != MatchingArg::Photo, "--matching"),
            (source.surroundings != SurroundingsArg::Photo, "--surroundings"),
            (source.detail != DetailArg::Photo, "--detail"),
            (source.fit.is_some(), "--fit"),
            (source.refine.is_some(), "--refine"),
            (source.model.backbone.is_some(), "--backbone"),
            (source.model.preset.is_some(), "--preset"),
            (source.model.config.is_some(), "--config"),
            (source.no_check, "--no-check"),
            (source.adjust_poses != AdjustPosesArg::Auto, "--adjust-poses"),
            (source.pair.pose_convention.is_some(), "--pose-convention"),
        ];
        flags.into_iter().find(|f| f.0).map(|f| f.1).or(source.pair.first_flag())
    }
}
