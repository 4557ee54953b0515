//! Command-line arguments. Their documentation is the program's manual.
//!
//! The first paragraph of a flag is what `-h` prints: one line, without words of the method. `--help`
//! prints the whole. Flags of experts are in `--help` alone, and explain the words that they use.

mod cameras;
mod check;
mod export;
mod files;
pub mod groups;
mod info;
mod poses;
mod render;
mod rendering;
mod run;
mod source;
#[cfg(feature = "view")]
pub mod view;

pub use cameras::{PairArgs, PoseConventionArg, ReadArgs};
pub use check::CheckArgs;
pub use export::{ExportArgs, UpArg};
pub use files::{ContentArgs, SceneFormatArg};
pub use info::InfoArgs;
pub use poses::PosesArgs;
pub use render::RenderArgs;
pub use rendering::{ConventionArg, LowpassArg, MotionArgs, PathArg, RenderingArgs};
pub use run::{PictureSizeArg, RunArgs};
pub use source::{
    AdjustPosesArg, BackboneArg, CropShapeArg, DetailArg, InputSizeArg, MatchingArg, ModelArgs,
    PresetArg, QualityArg, SourceArgs, SurroundingsArg,
};

use super::values;
use clap::{Parser, Subcommand};
#[cfg(feature = "view")]
use view::{KEYS, ViewArgs};

/// Exit codes, which scripts rely on.
const EXIT_CODES: &str = "\
Exit codes: 0 success; 1 an error, one line on stderr; 2 wrong usage; 3 a negative answer (cameras
that disagree with their photographs, photographs whose cameras cannot be estimated).

--json: one object and nothing else on stdout; {\"error\": ...} with exit codes 1 and 2.";

/// Makes a 3D scene from photographs, and draws sharp new views of it.
///
/// A scene is a set of splats (3D Gaussians): soft spots of colour in space, a few for each pixel of
/// the photographs.
///
/// Conventions everywhere: camera axes are OpenCV's (+x right, +y down, +z forward), poses are
/// camera-to-world, pixel centres lie at +0.5. Readers convert from each format's own convention.
#[derive(Debug, Parser)]
#[command(name = "subsplat", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Cli {
    /// The command.
    #[command(subcommand)]
    pub command: Command,
    /// Print one JSON object on stdout.
    ///
    /// All else goes to stderr.
    #[arg(long, global = true)]
    pub json: bool,
    /// Print warnings, errors and the answer alone.
    #[arg(short, long, global = true, hide_short_help = true)]
    pub quiet: bool,
    /// Number of threads (default: one for each core).
    ///
    /// The result does not depend on it. The environment variable RAYON_NUM_THREADS sets it too.
    #[arg(
        long,
        global = true,
        hide_short_help = true,
        value_name = "N",
        value_parser = values::threads
    )]
    pub threads: Option<usize>,
}

/// The program's commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Make a 3D scene from photographs, and draw new views of it.
    ///
    /// Two photographs of one place, taken a step apart, are enough. Up to twelve are all used (with --quality high or
    /// best six). Of more, as many that overlap are used; --context names others. The output folder gets the scene
    /// (scene.ply), the views (images/, depth/), their cameras (cameras.json) and metrics.json.
    Run(Box<RunArgs>),
    /// Draw pictures or an animation of a finished scene.
    Render(RenderArgs),
    /// Write a finished scene in another format, or with fewer splats.
    Export(ExportArgs),
    /// Show a scene in a window: a finished one, or photographs.
    #[cfg(feature = "view")]
    #[command(after_help = KEYS)]
    View(Box<ViewArgs>),
    /// Show a scene in a window: only in builds with the feature `view`.
    #[cfg(not(feature = "view"))]
    View(NoViewArgs),
    /// Estimate the cameras of photographs: position, direction and focal length.
    Poses(PosesArgs),
    /// Check whether cameras agree with their photographs.
    ///
    /// The program matches points that two photographs share. For each point, the cameras predict a line
    /// in the other photograph. Correct cameras predict lines through the points.
    Check(CheckArgs),
    /// Describe a scene file, a photograph, a scene folder or weights.
    Info(InfoArgs),
}

impl Command {
    /// The conflict between two arguments that need no file, if there is one.
    pub fn conflict(&self) -> Option<String> {
        match self {
            Self::Run(args) => {
                let targets = args.path == PathArg::Targets || args.target.is_empty();
                let conflict = || Some("--target: only with --path targets".to_owned());
                let source = &args.source;
                values::depth_conflict(source.near, source.far)
                    .or_else(|| radius_conflict(args.path, &args.motion))
                    .or_else(|| if targets { None } else { conflict() })
            }
            #[cfg(feature = "view")]
            Self::View(args) => args.conflict(),
            Self::Render(args) => radius_conflict(args.path, &args.motion),
            _ => None,
        }
    }

    /// Returns whether the command may open a GPU.
    pub fn uses_gpu(&self) -> bool {
        let named = |device: &str| !device.eq_ignore_ascii_case("cpu");
        match self {
            Self::Run(args) => named(&args.rendering.device),
            Self::Render(args) => named(&args.rendering.device),
            Self::View(_) => cfg!(feature = "view"),
            _ => false,
        }
    }
}

/// The conflict of `--orbit-radius` with a path without one.
fn radius_conflict(path: PathArg, motion: &MotionArgs) -> Option<String> {
    (motion.orbit_radius.is_some() && path.closed().is_none())
        .then(|| "--orbit-radius: only with --path orbit, spiral or dolly".to_owned())
}

/// Arguments of `view` in a build without it.
#[cfg(not(feature = "view"))]
#[derive(Debug, clap::Args)]
pub struct NoViewArgs {
    /// Any arguments; the command prints an error that names the feature.
    #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _ignored: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// The commands of this program that make, show and convert scenes.
    const FOR_PEOPLE: [&str; 7] = ["run", "render", "export", "view", "poses", "check", "info"];

    /// `-h` and `--help` of a command, as a terminal of `columns` shows it.
    fn help(command: &str, columns: usize) -> (String, String) {
        let mut program = Cli::command().term_width(columns);
        program.build();
        let command = program.find_subcommand_mut(command).unwrap();
        (command.render_help().to_string(), command.render_long_help().to_string())
    }

    #[test]
    fn the_short_help_of_run_fits_a_screen_in_groups() {
        for columns in [80, 100] {
            let (short, _) = help("run", columns);
            assert!(short.lines().count() <= 45, "{columns}: {}\n{short}", short.lines().count());
            for heading in [groups::PICTURES, groups::CAMERAS, groups::SIZE, groups::QUALITY] {
                assert!(short.contains(&format!("\n{heading}:\n")), "{heading}\n{short}");
            }
            for hidden in ["Network:", "--weights", "--refine", "--pose-b"] {
                assert!(!short.contains(hidden), "{hidden}");
            }
        }
        let (_, long) = help("run", 100);
        let flags = ["\nNetwork:\n", "--weights", "--refine", "--fit", "--pose-b", "--lowpass-ref"];
        assert!(flags.iter().all(|flag| long.contains(flag)), "{long}");
    }

    #[test]
    fn short_help_has_no_words_of_the_method() {
        const METHOD: [&str; 12] = [
            "fit",
            "fitted",
            "refine",
            "refinement",
            "children",
            "child",
            "primary",
            "primaries",
            "heads",
            "backbone",
            "epipolar",
            "baseline",
        ];
        for command in FOR_PEOPLE {
            let (short, _) = help(command, 100);
            let words = short.split(|c: char| !c.is_ascii_alphabetic());
            for word in words {
                assert!(
                    !METHOD.contains(&word.to_lowercase().as_str()),
                    "{command}: {word}\n{short}"
                );
            }
        }
    }
}
