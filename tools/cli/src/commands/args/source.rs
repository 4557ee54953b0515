//! Arguments of a reconstruction from photographs: of `run` and `view`.

use super::cameras::PairArgs;
use super::groups::{CAMERAS, NETWORK, QUALITY, SIZE};
use crate::commands::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use subsplat::{Density, InputSize, Poses, Quality, Refine, TargetSize};

/// Options of a reconstruction: of `run` and `view`.
#[derive(Clone, Debug, Args)]
pub struct SourceArgs {
    /// Photographs to make the scene from: names or numbers.
    ///
    /// Names are those of the files; numbers count from 0. Default: those that protocol.json names, else all photographs
    /// up to twelve (with --quality high or best six), of more as many that overlap.
    #[arg(long, value_delimiter = ',', value_name = "I,J,…", help_heading = CAMERAS)]
    pub context: Vec<String>,
    /// Cameras of photographs without a pose file.
    #[command(flatten)]
    pub pair: PairArgs,
    /// Correct given cameras that are nearly right: auto, always, never [default: auto].
    ///
    /// Phones and headsets give such cameras. They are adjusted by points that the photographs share. auto: where the
    /// comparison of the photographs doubts the cameras. Cameras that agree with the photographs stay. The flag alone:
    /// always.
    #[arg(
        long,
        value_name = "WHEN",
        value_enum,
        num_args = 0..=1,
        require_equals = true,
        default_value = "auto",
        default_missing_value = "always",
        hide_default_value = true,
        hide_possible_values = true,
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub adjust_poses: AdjustPosesArg,
    /// Do not compare the photographs before the reconstruction.
    ///
    /// The comparison finds cameras that disagree with the photographs, differences of exposure, and the
    /// nearest and farthest distance.
    #[arg(long, hide_short_help = true, help_heading = CAMERAS)]
    pub no_check: bool,
    /// Nearest distance at which the scene may lie, in the unit of the cameras' positions.
    ///
    /// Default: the value in the pose file, else an estimate from the photographs. For a finished scene
    /// in `view`: nearer splats are not drawn.
    #[arg(
        long,
        allow_negative_numbers = true,
        value_parser = values::positive,
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub near: Option<f32>,
    /// Farthest distance at which the scene may lie, in the same unit.
    #[arg(
        long,
        allow_negative_numbers = true,
        value_parser = values::positive,
        hide_short_help = true,
        help_heading = CAMERAS
    )]
    pub far: Option<f32>,
    /// Side of the pictures over that of what the network reads, 1 to 8.
    ///
    /// --quality sets the size that the network reads. Each of its pixels becomes R x R splats: 4 for 2,
    /// 16 for 4. A fraction is rounded up for the splats. Default: that of the weights, else 2.
    #[arg(long, value_name = "R", value_parser = values::upscale, help_heading = SIZE)]
    pub upscale: Option<f32>,
    /// Part of the photographs to use.
    #[arg(long, value_enum, default_value = "whole", help_heading = SIZE)]
    pub crop: CropShapeArg,
    /// Higher is sharper and slower.
    ///
    /// Sets --input-size, --gaussians, --fit and --refine. Each of these flags overrides its part. The
    /// program prints the number of pixels that the network reads.
    #[arg(long, value_enum, default_value = "normal", value_name = "LEVEL", help_heading = QUALITY)]
    pub quality: QualityArg,
    /// Most splats (3D Gaussians): auto, 200000, 50% or 3/px.
    ///
    /// Even surfaces keep one splat for each pixel that the network reads, and surfaces with detail get
    /// the rest. A share is one of all splats that --upscale gives. 3/px gives each pixel three. auto:
    /// all splats of two photographs; of more photographs, 2.5 times the splats of one; 950,000 at
    /// most.
    #[arg(
        long,
        value_name = "N",
        value_parser = values::density,
        help_heading = QUALITY
    )]
    pub gaussians: Option<Density>,
    /// Pixels that the network reads of each photograph: N, or WxH.
    ///
    /// N: as many as a square of side N has, in the shape of the photographs; with `--crop square`
    /// that square. Twice the side takes about four times the time and three times the memory.
    #[arg(
        long,
        value_name = "N | WxH",
        value_parser = values::input_size,
        hide_short_help = true,
        help_heading = QUALITY
    )]
    pub input_size: Option<InputSizeArg>,
    /// Steps that match sizes, opacities and colours of the splats to the photographs.
    ///
    /// The network's splats look blurred. Each step compares pictures of them with the photographs,
    /// and changes all splats a little, but not their places. 0 leaves the splats as the
    /// network made them; --refine is then left out too, unless it gives a number. Default: 4; of three
    /// photographs or more none where --refine has 30 steps or more, which do the same.
    #[arg(long, value_name = "STEPS", hide_short_help = true, help_heading = QUALITY)]
    pub fit: Option<usize>,
    /// Steps that move and reshape the splats so that new views become sharper.
    ///
    /// These steps follow those of --fit. Each step draws one photograph from the splats, and changes the
    /// splats towards it. `off`; a number of steps; or a time, such as `20s` or `2m`, in which
    /// each photograph has 48 steps at most: more do not improve new views. `auto`: 16 steps for two photographs,
    /// 40 for three, 75 for four, 24 for each of more, 240 at most. The steps end early where the photographs no
    /// longer improve. Ctrl-C ends them and keeps the scene so far. With a number or a time,
    /// `run` writes the scores of photographs that the scene is not made from, over the seconds (metrics.json).
    #[arg(
        long,
        value_name = "auto | off | STEPS | SECONDSs",
        value_parser = values::refine,
        hide_short_help = true,
        help_heading = QUALITY
    )]
    pub refine: Option<Refine>,
    /// Correction of the network's distances by comparing patches of the photographs.
    ///
    /// Objects then lie where the photographs agree, and new views are sharper and less distorted.
    /// Without --fit and --refine the network's distances stay.
    #[arg(
        long,
        value_enum,
        default_value = "photo",
        hide_short_help = true,
        help_heading = QUALITY
    )]
    pub matching: MatchingArg,
    /// Splats beyond the edges of the photographs.
    ///
    /// Views from beside the photographs then have no empty strips. Not added where --gaussians gives a number.
    #[arg(
        long,
        value_enum,
        default_value = "photo",
        hide_short_help = true,
        help_heading = QUALITY
    )]
    pub surroundings: SurroundingsArg,
    /// Source of fine texture.
    #[arg(
        long,
        value_enum,
        default_value = "photo",
        hide_short_help = true,
        help_heading = QUALITY
    )]
    pub detail: DetailArg,
    /// Weights of the network (.safetensors).
    ///
    /// Default: the small network's, which are part of the program.
    #[arg(long, value_name = "FILE", hide_short_help = true, help_heading = NETWORK)]
    pub weights: Option<PathBuf>,
    /// Random weights of this seed instead: an untrained network, for tests.
    #[arg(
        long,
        value_name = "N",
        conflicts_with = "weights",
        hide_short_help = true,
        help_heading = NETWORK
    )]
    pub seed: Option<u64>,
    /// The model.
    #[command(flatten)]
    pub model: ModelArgs,
}

impl SourceArgs {
    /// Side of the children's grid that --upscale names.
    pub fn children_side(&self) -> Option<usize> {
        self.upscale.map(|r| r.ceil() as usize)
    }

    /// Size of the target pictures that --upscale names.
    pub fn target_size(&self) -> TargetSize {
        match self.upscale {
            Some(r) if r.fract() > 0.0 => TargetSize::Times(r),
            _ => TargetSize::Upscaled,
        }
    }

    /// Size of the network's input: --input-size with --crop, else that of --quality.
    pub fn input_size(&self) -> InputSize {
        match self.input_size {
            None => Quality::from(self.quality).settings().input_size,
            Some(InputSizeArg::Sides(width, height)) => InputSize::exact(width, height),
            Some(InputSizeArg::Side(side)) if self.crop == CropShapeArg::Square => {
                InputSize::exact(side, side)
            }
            Some(InputSizeArg::Side(side)) => InputSize::Area(side * side),
        }
    }

    /// Most photographs of a scene where none are named. The levels above `normal` read four times the pixels of
    /// each. Seventeen photographs of `../shared/photos/fox` take 2.7 minutes at 256 → 512 on two cores.
    pub fn photographs_max(&self) -> usize {
        match self.quality {
            QualityArg::Fast | QualityArg::Normal => 12,
            QualityArg::High | QualityArg::Best => 6,
        }
    }

    /// Number of Gaussians: --gaussians, else that of --quality.
    pub fn density(&self) -> Density {
        self.gaussians.unwrap_or_else(|| Quality::from(self.quality).settings().density)
    }
}

/// Quality by one word.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum QualityArg {
    /// A draft, in a third of the time: 192 x 192 pixels are read, at most 150,000 splats, half of
    /// the steps of --refine.
    Fast,
    /// 256 x 256 pixels are read, and --gaussians and --refine are `auto`.
    Normal,
    /// Up to 512 x 512 pixels are read. Small photographs or little memory reduce this.
    High,
    /// As `high`, with twice the steps of --refine, and pictures of the photographs' own size, at most
    /// two megapixels, where neither --size nor --upscale is given.
    Best,
}

impl QualityArg {
    /// The word on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Normal => "normal",
            Self::High => "high",
            Self::Best => "best",
        }
    }
}

impl From<QualityArg> for Quality {
    fn from(arg: QualityArg) -> Self {
        match arg {
            QualityArg::Fast => Self::Fast,
            QualityArg::Normal => Self::Normal,
            QualityArg::High => Self::High,
            QualityArg::Best => Self::Best,
        }
    }
}

/// Size of the network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputSizeArg {
    /// Side of the square of the same area, px.
    Side(usize),
    /// Width and height, px.
    Sides(usize, usize),
}

/// Part of the photographs that the network reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CropShapeArg {
    /// The whole photograph; rounding may cut a few percent at the edges.
    Whole,
    /// The square in the middle.
    Square,
}

/// Correction of given cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum AdjustPosesArg {
    /// Of cameras that the comparison of the photographs doubts.
    Auto,
    /// Of all cameras that points of the photographs contradict.
    Always,
    /// None.
    Never,
}

impl From<AdjustPosesArg> for Poses {
    fn from(when: AdjustPosesArg) -> Self {
        match when {
            AdjustPosesArg::Auto => Self::Auto,
            AdjustPosesArg::Always => Self::Adjusted,
            AdjustPosesArg::Never => Self::Given,
        }
    }
}

/// Correction of the network's distances.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum MatchingArg {
    /// None: the network's own distances.
    Off,
    /// Each pixel moves to the distance at which the photographs agree, where they do.
    Photo,
}

/// Splats beyond the edges of the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SurroundingsArg {
    /// None.
    Off,
    /// In the colours at the edges.
    Photo,
}

/// Source of colour detail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DetailArg {
    /// The network alone: blurred, because it reads few pixels.
    Off,
    /// The photographs too, where they have more pixels than the network reads.
    Photo,
}

/// The model, where the weights do not state it.
#[derive(Clone, Debug, Args)]
pub struct ModelArgs {
    /// Network that estimates distances: MVSplat's, or this project's small one.
    ///
    /// Default: that of the weights, and `re10k` for a bare MVSplat checkpoint. `re10k` without
    /// weights is untrained.
    #[arg(long, value_enum, hide_short_help = true, help_heading = NETWORK)]
    pub backbone: Option<BackboneArg>,
    /// Form of the equations that divide a splat into smaller ones.
    ///
    /// Default: that of the weights, and `tuned` for weights that do not divide splats.
    #[arg(long, value_enum, hide_short_help = true, help_heading = NETWORK)]
    pub preset: Option<PresetArg>,
    /// A whole configuration of the network (JSON) instead of the two above.
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with_all = ["backbone", "preset"],
        hide_short_help = true,
        help_heading = NETWORK
    )]
    pub config: Option<PathBuf>,
}

/// The network that predicts the primary Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackboneArg {
    /// MVSplat (12 M parameters).
    Re10k,
    /// This project's own light network.
    Small,
}

/// Form of the modules that SubSplat adds to the backbone.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum PresetArg {
    /// The paper's equations as written.
    Paper,
    /// The paper's equations with this project's corrections.
    Tuned,
}

impl From<PresetArg> for subsplat::network::config::Preset {
    fn from(arg: PresetArg) -> Self {
        match arg {
            PresetArg::Paper => Self::Paper,
            PresetArg::Tuned => Self::Tuned,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        source: SourceArgs,
    }

    #[test]
    fn single_flags_override_the_quality() {
        let source = |flags: &str| Line::parse_from(flags.split(' ')).source;
        let plain = source("run");
        assert_eq!(plain.input_size(), InputSize::default());
        assert_eq!(plain.density(), Density::default());
        let best = source("run --quality best");
        let settings = Quality::Best.settings();
        assert_eq!((best.input_size(), best.density()), (settings.input_size, settings.density));
        let mixed = source("run --quality best --input-size 192 --gaussians 9");
        assert_eq!(mixed.input_size(), InputSize::Area(192 * 192));
        assert_eq!(mixed.density(), Density::Count(9));
        let square = source("run --quality fast --input-size 192 --crop square");
        assert_eq!(square.input_size(), InputSize::exact(192, 192));
        assert_eq!(
            source("run --input-size 64x32 --crop square").input_size(),
            InputSize::exact(64, 32)
        );
    }
}
