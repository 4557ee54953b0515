//! Arguments about scene files.

use crate::commands::values;
use clap::{Args, ValueEnum};

/// Formats of the reconstructed scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SceneFormatArg {
    /// The layout that nearly all viewers of splats read, with colours that change with the view.
    Ply,
    /// glTF, with the extension KHR_gaussian_splatting.
    Glb,
    /// Small and simple: 32 bytes a splat, one colour for all views.
    Splat,
    /// Compressed: Niantic's format, version 3.
    Spz,
    /// Compressed for the web: PlayCanvas' format, version 2.
    Sog,
    /// One page that shows the scene in any browser, offline too.
    Html,
}

impl SceneFormatArg {
    /// Name of the file in the output folder of `run`.
    pub fn file_name(self) -> &'static str {
        match self {
            Self::Ply => "scene.ply",
            Self::Glb => "scene.glb",
            Self::Splat => "scene.splat",
            Self::Spz => "scene.spz",
            Self::Sog => "scene.sog",
            Self::Html => "scene.html",
        }
    }
}

/// Content of a scene file.
#[derive(Clone, Copy, Debug, Args)]
pub struct ContentArgs {
    /// Variation of a splat's colour with the viewing direction: degree of the spherical harmonics, 0 to 3.
    ///
    /// 0 gives a splat one colour for all views and the smallest file. A .ply holds 0, 9, 24 or 45
    /// values `f_rest` accordingly. Default: 3, which some viewers expect, and the scene's own degree
    /// where the .ply is larger than 150 MB with 3.
    #[arg(
        long,
        value_name = "0…3",
        value_parser = values::file_sh_degree,
        hide_short_help = true
    )]
    pub sh: Option<usize>,
    /// Leave out splats that are more transparent than this: 0 keeps all, 1 is opaque.
    #[arg(
        long,
        default_value_t = 0.0,
        value_name = "ALPHA",
        allow_negative_numbers = true,
        value_parser = values::opacity,
        hide_short_help = true
    )]
    pub min_opacity: f32,
}
