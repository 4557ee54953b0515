//! Arguments of `eval`. Their documentation is the program's manual.

use crate::eval::{Disturbance, Method};
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use subsplat::{Density, Refine};
use subsplat_cli::commands::args::{AdjustPosesArg, DetailArg, ModelArgs};
use subsplat_cli::commands::values;

const NOTES: &str = "\
Methods: subsplat (the model), detail (the model with detail from the photographs), fit (the same, \
fitted to the photographs), refine (what `run` gives: depth matched, parents refined at the input's \
size, then their children), unmatched (refine without the match), direct (fit, refined: without both), \
enlarged and half (what `run` gives for pictures of the input's size, and of half the target's sides, \
enlarged by Lanczos), pair (refine, of the two inputs nearest to the target alone), backbone (its \
backbone's Gaussians alone, rendered at the target's size: spgr=off), lowpass (the same, low-pass \
scaled to the input), bilinear (the same rendered at the input's size and enlarged), uniform (K equal \
Gaussians a pixel, untrained), copy (the input nearest to the target), mean (of the inputs).

Figures: PSNR (dB), SSIM, LPIPS (VGG16; needs --lpips), sharpness (mean absolute gradient over the \
photograph's), GMSD (gradient magnitude similarity deviation; 0 is best). Means are over a case's \
targets first, then over cases; a case is one set of inputs. At the inputs' own cameras: the same \
figures of the inputs, the number of Gaussians, the 10, 50 and 90 % quantiles of sigma (target px) \
and opacity, and the coverage (mean alpha).

Photographs too small for a target of R times --input-size: that case's input is halved until they \
are large enough.";

/// Arguments of `eval`.
#[derive(Debug, Args)]
#[command(after_long_help = NOTES)]
pub struct EvalArgs {
    /// Chunks of pixelSplat's form (RealEstate10K, ACID; a folder with index.json or
    /// test/index.json), a scene, or a folder of scenes. Without protocol.json and --index, the
    /// inputs of a scene are the pair that `run` chooses, and every k-th frame between the two is a
    /// target.
    #[arg(value_name = "DATA")]
    pub data: PathBuf,
    /// Evaluation index of MVSplat's form, {scene: {context, target} or null}. Scenes may have
    /// a protocol.json instead.
    #[arg(long, value_name = "FILE")]
    pub index: Option<PathBuf>,
    /// Take N frames spread over each scene as inputs, and the frames in the middle between two of
    /// them as targets, instead of the protocol's.
    #[arg(long, value_name = "N", value_parser = values::at_least_one, conflicts_with = "index")]
    pub contexts: Option<usize>,
    /// With --contexts: every K-th frame is a target, whatever the number of inputs, and none of them an input.
    #[arg(long, value_name = "K", value_parser = values::at_least_one, requires = "contexts")]
    pub holdout: Option<usize>,
    /// Folder for eval.json, targets.csv, means.csv, index.html and the pictures
    /// (pictures/METHOD/SCENE/INPUTS/FRAME.png). Default: no files are written.
    #[arg(short, long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Target over input, side over side, 1 to 8, as in `run`. Default: the weights' own, else 2.
    #[arg(long, value_name = "R", value_parser = values::upscale)]
    pub upscale: Option<f32>,
    /// Side of the network's input, px: N, or WxH (default: protocol.json's, else 256).
    #[arg(long, value_name = "N | WxH", value_parser = values::size)]
    pub input_size: Option<(usize, usize)>,
    /// Methods to compare, in this order (default: all that differ at this --upscale, without
    /// detail and pair).
    #[arg(long, value_delimiter = ',', value_name = "M,…")]
    pub methods: Vec<Method>,
    /// Number of Gaussians, as in `run`; `opaque` and `random` remove others of all instead.
    #[arg(long, value_name = "auto | N | P% | K/px", value_parser = values::density, default_value = "auto")]
    pub gaussians: Density,
    /// Length of the refinement, as in `run`: of refine, enlarged, half and pair.
    #[arg(long, value_name = "auto | off | N | 20s | 2m", value_parser = values::refine, default_value = "auto")]
    pub refine: Refine,
    /// Score also PNG pictures of another program: DIR/SCENE/INPUTS/NNNNNN.png, or
    /// SCENE/color/NNNNNN.png, SCENE/NNNNNN.png, SCENE/FRAMENAME.png.
    #[arg(long, value_name = "NAME=DIR")]
    pub pred: Vec<Method>,
    /// `photo` adds the method detail after subsplat.
    #[arg(long, value_enum, default_value = "off")]
    pub detail: DetailArg,
    /// Disturb the inputs before the model receives them: rotation (0.5 degrees, all but the
    /// first), position (1 % of the depth, all but the first), focal (3 % too large), dark (one
    /// stop, all but the first), blur (1.5 target px, all but the first), jpeg (quality 30). Scores
    /// at the inputs' cameras are then those of the disturbed inputs.
    #[arg(long, value_delimiter = ',', value_name = "D,…", value_parser = disturbance)]
    pub disturb: Vec<Disturbance>,
    /// Adjust the inputs' cameras by points matched between them: never, auto (where `run` does), always. Targets are then
    /// located by points that they share with the inputs; without enough, they follow by one similarity.
    #[arg(
        long,
        value_name = "WHEN",
        value_enum,
        num_args = 0..=1,
        require_equals = true,
        default_value = "never",
        default_missing_value = "always"
    )]
    pub adjust_poses: AdjustPosesArg,
    /// Give the inputs the exposure and white balance of one of them, as `run` does. Of two inputs it
    /// is the first.
    #[arg(long)]
    pub equal_exposure: bool,
    /// VGG16 and LPIPS weights (.safetensors, made by subsplat-convert).
    #[arg(long, value_name = "FILE")]
    pub lpips: Option<PathBuf>,
    /// Weights (.safetensors). Default: the shipped ones.
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Untrained weights, drawn from this seed.
    #[arg(long, value_name = "N", conflicts_with = "weights")]
    pub seed: Option<u64>,
    /// Nearest depth candidate, world units (default: as `run`; chunks 1).
    #[arg(long, allow_negative_numbers = true, value_parser = values::positive)]
    pub near: Option<f32>,
    /// Farthest depth candidate, world units (default: as `run`; chunks 100).
    #[arg(long, allow_negative_numbers = true, value_parser = values::positive)]
    pub far: Option<f32>,
    /// Only the first N scenes.
    #[arg(long, value_name = "N", value_parser = values::at_least_one)]
    pub limit: Option<usize>,
    /// Only part I of N equal parts of the cases, I from 0: N processes share an evaluation. The lines
    /// of their targets.csv, one after the other, are those of one process.
    #[arg(long, value_name = "I/N", value_parser = values::part)]
    pub shard: Option<(usize, usize)>,
    /// Principal point after a crop (default: mvsplat for chunks with the re10k backbone, else
    /// exact).
    #[arg(long, value_enum)]
    pub crop: Option<CropArg>,
    /// Source of the network's input.
    #[arg(long, value_enum, default_value = "hr-crop")]
    pub lr_from: LrFromArg,
    /// The model.
    #[command(flatten)]
    pub model: ModelArgs,
}

/// Principal point after a crop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CropArg {
    /// It moves with the pixels.
    Exact,
    /// Its fraction of the width and height stays (MVSplat's published numbers).
    Mvsplat,
}

/// Source of the network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LrFromArg {
    /// The target's crop, reduced: aligned with it to the pixel.
    HrCrop,
    /// The photograph, resized and cropped independently, as in MVSplat.
    Independent,
}

/// Parses the name of a disturbance.
fn disturbance(text: &str) -> Result<Disturbance, String> {
    let found = Disturbance::NAMED.iter().find(|(name, _)| *name == text);
    found.map(|(_, d)| *d).ok_or_else(|| {
        let names = Disturbance::NAMED.map(|(name, _)| name).join(", ");
        format!("expected one of {names}, got `{text}`")
    })
}
