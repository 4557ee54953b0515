//! Arguments of `info`.

use clap::Args;
use std::path::PathBuf;

/// Arguments of `info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// A scene file, a photograph, a pose file, a scene folder, or weights.
    pub file: PathBuf,
}
