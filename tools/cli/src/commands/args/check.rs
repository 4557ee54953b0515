//! Arguments of `check`.

use super::cameras::PairArgs;
use super::groups::CAMERAS;
use clap::Args;
use std::path::PathBuf;

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// A scene folder or pose file; or photographs, or a folder of them.
    #[arg(required = true, num_args = 1.., value_name = "SCENE | IMG… | DIR")]
    pub input: Vec<PathBuf>,
    /// Folder for the pictures of matched points.
    ///
    /// Each shows two photographs, points that both show, and the lines on which the cameras expect
    /// the points.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Photographs to check, each with the next: names or numbers.
    ///
    /// Default: those that protocol.json names for the reconstruction, else the two that `run` would
    /// choose.
    #[arg(long, value_delimiter = ',', value_name = "I,J,…", help_heading = CAMERAS)]
    pub context: Vec<String>,
    /// Cameras of photographs without a pose file.
    #[command(flatten)]
    pub pair: PairArgs,
}
