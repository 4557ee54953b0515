//! Command-line arguments. Their documentation is the program's manual.

use crate::convert::numbers::Float;
use clap::{Parser, ValueEnum};
use std::path::PathBuf;
use subsplat::network::config::Preset;
use subsplat::network::model::architecture::Kind;

/// Exit codes, which scripts rely on.
const EXIT_CODES: &str = "\
Exit codes: 0 success; 1 an error, one line on stderr and no file; 2 wrong usage.

--json: one object and nothing else on stdout; {\"error\": ...} with exit codes 1 and 2.";

/// Converts PyTorch checkpoints to .safetensors weights of subsplat.
///
/// The program reads files of torch.save and .safetensors: Lightning checkpoints, state dicts,
/// {"model": ...}. It executes nothing in a checkpoint. It checks every tensor by name and shape, and
/// leaves out and counts tensors that the model does not have (optimizer state, classifiers).
#[derive(Debug, Parser)]
#[command(name = "subsplat-convert", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Args {
    /// Checkpoint (.ckpt, .pth, .pt) or .safetensors.
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    /// Weights to write (.safetensors).
    #[arg(value_name = "OUT")]
    pub output: PathBuf,
    /// Kind of the weights.
    #[arg(long, value_enum, default_value = "auto")]
    pub kind: KindArg,
    /// Element type to write. Numbers out of its range are rejected.
    #[arg(long, value_enum, default_value = "f32")]
    pub dtype: DtypeArg,
    /// Take only tensors whose names begin with this prefix, and remove it (`module.`).
    /// `encoder.` is removed in any case.
    #[arg(long, default_value = "", hide_default_value = true, value_name = "PREFIX")]
    pub prefix: String,
    /// LPIPS' linear weights (the lpips package's weights/v0.1/vgg.pth), where IN is the
    /// VGG16 trunk alone.
    #[arg(long, value_name = "FILE")]
    pub lpips_linear: Option<PathBuf>,
    /// Write incomplete weights too. An MVSplat checkpoint needs this for `--kind subsplat`.
    #[arg(long)]
    pub allow_missing: bool,
    /// Reject names that the architecture does not have, instead of leaving them out.
    #[arg(long)]
    pub strict: bool,
    /// Replace OUT if it exists.
    #[arg(long)]
    pub force: bool,
    /// SubSplat's equations, for the configuration in OUT (mvsplat, subsplat). Default: those of
    /// IN's configuration or tensors, else `tuned`.
    #[arg(long, value_name = "paper | tuned")]
    pub preset: Option<Preset>,
    /// Target over input, side over side, for the configuration in OUT. Default: likewise,
    /// else 2.
    #[arg(long, value_name = "R")]
    pub upscale: Option<usize>,
    /// A whole configuration (JSON) for OUT instead of the two above.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "upscale"])]
    pub config: Option<PathBuf>,
    /// Print one JSON object on stdout; everything else goes to stderr.
    #[arg(long)]
    pub json: bool,
}

/// Kind of the weights.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum KindArg {
    /// Recognised by the names.
    Auto,
    /// MVSplat's encoder (471 tensors in the re10k configuration).
    Mvsplat,
    /// A whole model: MVSplat or the small backbone, and SubSplat's tensors.
    Subsplat,
    /// GMDepth (UniMatch), from which MVSplat's CNN and transformer start.
    Gmdepth,
    /// LPIPS with VGG16: torchvision's VGG16 and --lpips-linear, or the lpips package's
    /// whole state dict.
    Lpips,
}

impl KindArg {
    /// `None` for `auto`.
    pub fn kind(self) -> Option<Kind> {
        match self {
            Self::Auto => None,
            Self::Mvsplat => Some(Kind::Mvsplat),
            Self::Subsplat => Some(Kind::Subsplat),
            Self::Gmdepth => Some(Kind::Gmdepth),
            Self::Lpips => Some(Kind::Lpips),
        }
    }
}

/// Element type to write.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum DtypeArg {
    /// The same numbers as in PyTorch.
    F32,
    /// Half the size, 11 bits of precision, at most 65504.
    F16,
    /// Half the size, 8 bits of precision, the range of f32.
    Bf16,
}

impl From<DtypeArg> for Float {
    fn from(arg: DtypeArg) -> Self {
        match arg {
            DtypeArg::F32 => Self::F32,
            DtypeArg::F16 => Self::F16,
            DtypeArg::Bf16 => Self::Bf16,
        }
    }
}
