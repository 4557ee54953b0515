//! Command-line arguments of `subsplat-lab`. Their documentation is the program's manual.

use super::args_eval::EvalArgs;
use super::args_paper::PaperArgs;
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;
use subsplat_cli::commands::values;

/// Exit codes, which scripts rely on.
const EXIT_CODES: &str = "\
Exit codes: 0 success; 1 an error, one line on stderr; 2 wrong usage; 3 a tensor out of tolerance
(compare).

--json: one object and nothing else on stdout; {\"error\": ...} with exit codes 1 and 2.";

/// Trains the network, scores it, and makes the paper's tables.
#[derive(Debug, Parser)]
#[command(name = "subsplat-lab", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Cli {
    /// The command.
    #[command(subcommand)]
    pub command: Command,
    /// Print one JSON object on stdout; everything else goes to stderr.
    #[arg(long, global = true)]
    pub json: bool,
    /// Worker threads (default: RAYON_NUM_THREADS, else one per core). The result does not
    /// depend on it.
    #[arg(long, global = true, value_name = "N", value_parser = values::threads)]
    pub threads: Option<usize>,
}

/// The program's commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Score a model and baselines on photographs that it was not trained on.
    Eval(Box<EvalArgs>),
    /// Make the paper's tables and figures, with the paper's numbers beside.
    Paper(PaperArgs),
    /// Run the encoder, or the rasterizer, on the inputs of a reference file, and compare every
    /// tensor in the file.
    Compare(CompareArgs),
    /// Train weights; the same command continues a training that was stopped.
    Train(TrainArgs),
}

impl Command {
    /// The conflict between two arguments that need no file, if there is one.
    pub fn conflict(&self) -> Option<String> {
        match self {
            Self::Eval(args) => values::depth_conflict(args.near, args.far),
            _ => None,
        }
    }

    /// Returns whether the command may open a GPU.
    pub fn uses_gpu(&self) -> bool {
        match self {
            Self::Compare(args) => !args.device.eq_ignore_ascii_case("cpu"),
            _ => false,
        }
    }
}

/// An instruction set that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SimdArg {
    /// Instructions of every processor of the kind; products and sums round separately.
    Baseline,
    /// x86-64-v3.
    Avx2,
    /// x86-64-v4.
    Avx512,
    /// AArch64.
    Neon,
}

impl From<SimdArg> for subsplat_kernels::cpu::SimdLevel {
    fn from(arg: SimdArg) -> Self {
        match arg {
            SimdArg::Baseline => Self::Baseline,
            SimdArg::Avx2 => Self::Avx2,
            SimdArg::Avx512 => Self::Avx512,
            SimdArg::Neon => Self::Neon,
        }
    }
}

/// Arguments of `compare`.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// Weights (.safetensors) of the encoder, with or without the `encoder.` prefix. A
    /// rasterizer case needs none.
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Reference: `in.*` tensors, and any of the stages and `out.*` tensors; or, without
    /// --weights, a rasterizer case: splats, a camera, and the picture and gradients that
    /// another rasterizer made of them.
    #[arg(long, value_name = "FILE")]
    pub reference: PathBuf,
    /// Instruction set of the rasterizer (default: SUBSPLAT_SIMD, else the widest here).
    #[arg(long, value_enum, conflicts_with = "weights")]
    pub simd: Option<SimdArg>,
    /// Device of the encoder, or of the picture and its gradients: as of `render --device`, but an
    /// error where it fails.
    #[arg(long, default_value = "cpu", value_name = "auto|cpu|gpu|NAME", conflicts_with = "simd")]
    pub device: String,
}

/// Arguments of `train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Configuration of the training: TOML or JSON (examples: tools/lab/train).
    pub config: PathBuf,
    /// Folder of checkpoints, weights, logs and sheets. The training continues from a
    /// checkpoint in it.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Photographs for validation only: scenes with a protocol.json, or one.
    #[arg(long, value_name = "DIR")]
    pub validate: Option<PathBuf>,
    /// Stop after this many minutes, with a checkpoint.
    #[arg(long, value_name = "M", value_parser = values::minutes)]
    pub minutes: Option<f64>,
    /// Stop after this many steps, with a checkpoint.
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
}
