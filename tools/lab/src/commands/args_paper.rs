//! Arguments of `paper`. Their documentation is the program's manual.

use super::paper::TABLES;
use crate::eval::Method;
use clap::Args;
use std::path::PathBuf;
use subsplat_cli::commands::values;

const NOTES: &str = "\
t1 scalability, t2 cost and quality, t3 upsamplers x2, t4 modules, t5 stages of the aggregation, tA \
depth residual, tB scale factor, tC colour gain, tD uniform density, tE efficiency, tF upsamplers x4; \
f3, f4, f5, f6, fA, fC, fD: pictures side by side; fB: a video. Figures 1 and 2 are drawings; no \
specification of a Table 6 exists.

--data ROOT holds re10k-720 or re10k, re10k-1080, acid-720 or acid, and acid-1080: each what `eval` \
reads, with the evaluation index of chunks beside it (ROOT/re10k.json). A ROOT without these folders is \
itself the data of every column. Where a data set is absent, generated rooms, and shapes in place of \
ACID, stand in for it at half of the paper's sizes, and the output says so.

--ckpts DIR holds NAME-xR.safetensors or NAME.safetensors: mvsplat, subsplat, and the ablations full, \
no-aggregation, stages-1, stages-2, beta-z-50, beta-z-75, beta-z-100, lambda-s-50, -55, -65, -70, \
gain-50, gain-0. Without them the first two are the weights that ship, and the ablations are trained: \
SubSplat's heads on the small backbone. A second call continues a training that was stopped.

Files: OUT/ID/ID.csv, OUT/ID/ID.md and pictures; OUT/models and OUT/generated serve all tables.";

/// Arguments of `paper`.
#[derive(Debug, Args)]
#[command(after_long_help = NOTES)]
pub struct PaperArgs {
    /// Tables and figures, or `all`.
    #[arg(required = true, num_args = 1.., value_name = "ID", value_parser = id)]
    pub ids: Vec<String>,
    /// Output folder.
    #[arg(short, long, default_value = "out/paper", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of data sets. Default: generated scenes.
    #[arg(long, value_name = "ROOT")]
    pub data: Option<PathBuf>,
    /// Folder of weights. Default: the weights that ship, and trainings.
    #[arg(long, value_name = "DIR")]
    pub ckpts: Option<PathBuf>,
    /// Pictures of another program for the row NAME (pixelsplat, transplat, depthsplat, hisplat,
    /// mvsplat-hit-sr), or for a further row; as in `eval`, in DIR or DIR/SETTING (DIR/re10k-512).
    #[arg(long, value_name = "NAME=DIR")]
    pub pred: Vec<Method>,
    /// VGG16 and LPIPS weights (.safetensors, made by subsplat-convert).
    #[arg(long, value_name = "FILE")]
    pub lpips: Option<PathBuf>,
    /// Only the first N scenes.
    #[arg(long, default_value_t = 4, value_name = "N", value_parser = values::at_least_one)]
    pub limit: usize,
    /// Steps of each training.
    #[arg(long, default_value_t = 40, value_name = "N")]
    pub steps: u64,
    /// Trainings of each row, with different initial weights and rooms.
    #[arg(long, default_value_t = 2, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub seeds: u64,
    /// Side of the network's input, px (default: 256; 128 on generated scenes).
    #[arg(long, value_name = "N", value_parser = values::at_least_one)]
    pub input_size: Option<usize>,
    /// Frames of the video of fB.
    #[arg(long, default_value_t = 120, value_name = "N", value_parser = values::frames)]
    pub frames: usize,
}

/// Parses the name of a table.
fn id(text: &str) -> Result<String, String> {
    let known = || TABLES.iter().map(|t| t.id).chain(["all"]);
    if known().any(|id| id == text) {
        return Ok(text.to_owned());
    }
    Err(format!("expected one of {}, got `{text}`", known().collect::<Vec<_>>().join(", ")))
}
