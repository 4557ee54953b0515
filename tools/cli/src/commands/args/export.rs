//! Arguments of `export`.

use super::files::ContentArgs;
use crate::commands::values;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use subsplat::Density;
use subsplat::files::splats::spz::SpzVersion;

/// The up direction of a written file.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum UpArg {
    /// The scene's own axes: up is −y, as photogrammetry programs write it.
    Keep,
    /// Up is +y (OpenGL, game engines).
    Y,
    /// Up is +z (Blender, CAD).
    Z,
}

impl From<UpArg> for subsplat::Up {
    fn from(arg: UpArg) -> Self {
        match arg {
            UpArg::Keep => Self::Keep,
            UpArg::Y => Self::Y,
            UpArg::Z => Self::Z,
        }
    }
}

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// The scene: .ply, .splat, .spz, .sog, .ksplat or .glb; or a folder that `run` wrote.
    ///
    /// A .compressed.ply is read too, and the meta.json of a .sog in a folder.
    #[arg(value_name = "SPLATS | DIR")]
    pub scene: PathBuf,
    /// The file to write; its extension decides the format: .html, .ply, .glb, .spz, .sog or .splat.
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
    /// Most splats (3D Gaussians), or their share: 200000, or 50%.
    ///
    /// Splats that no camera shows are removed, then neighbours of one colour are merged. In the example's
    /// room, half of the splats give equal pictures; a tenth changes them by 0.3 dB (PSNR).
    #[arg(long, value_name = "N", value_parser = values::reduced)]
    pub gaussians: Option<Density>,
    /// Cameras of the scene: the .html starts from them, and --gaussians keeps what they show.
    ///
    /// A pose file of any kind or a scene folder. Default: for .html the photographs' cameras, where the file holds them
    /// (.ply and .glb of `run`); else cameras.json beside the scene, else the camera that the file holds, else none.
    #[arg(long, value_name = "SCENE")]
    pub cameras: Option<PathBuf>,
    /// Up direction of a .ply, .sog or .splat (default: keep).
    ///
    /// A .glb and a .spz have +y up by their formats, and a .html is upright.
    #[arg(long, value_enum)]
    pub up: Option<UpArg>,
    /// Version of a .spz: 4 is the newest, which fewer viewers read.
    #[arg(long, value_name = "3 | 4", value_parser = values::spz_version, hide_short_help = true)]
    pub spz_version: Option<SpzVersion>,
    /// Content of the scene files.
    #[command(flatten)]
    pub content: ContentArgs,
}
