//! The commands, one file each. The public modules are those that a second program shares:
//! arguments and their values, frames, memory, the model of the arguments, animations, pages, and the
//! environment; beside [`crate::report`] and [`crate::failure`].
//!
//! Exit codes: 0 success; 1 an error, reported on stderr; 2 wrong usage; 3 a negative answer
//! (`check`: bad poses; photographs that do not determine their cameras). With `--json` stdout always holds
//! one object: the report, or `{"error": …}`.

pub mod args;
mod browser;
mod check;
mod clip;
mod convention;
mod curve;
pub mod depth_colour;
pub mod environment;
mod export;
pub mod frames;
pub mod html;
mod info;
mod inputs;
pub mod memory;
pub mod model;
mod output;
mod pair;
mod poses;
mod reconstruct;
mod render;
mod run;
mod trained;
pub mod values;
pub mod video;
#[cfg(feature = "view")]
mod view;
mod whole;

use crate::failure;
use crate::report::Answer;
use anyhow::{Context, Result};
use args::{Cli, Command};
use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};
use std::process::ExitCode;
use subsplat_kernels::cpu::SimdLevel;

/// Exit code of a negative answer.
const ANSWER_NO: u8 = 3;

/// Runs the command of the process's arguments and returns the exit code.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return failure::report_usage(&error),
    };
    if let Some(conflict) = cli.command.conflict() {
        let error = Cli::command().error(ErrorKind::ArgumentConflict, conflict);
        return failure::report_usage(&error);
    }
    if cli.quiet {
        crate::report::be_quiet();
    }
    if cli.command.uses_gpu() {
        environment::restart_for_gpu();
    }
    let answer = Answer::new(cli.json);
    match dispatch(&cli, answer) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(ANSWER_NO),
        Err(error) => {
            let code = failure::report_error(&error, answer);
            let refused = error.downcast_ref::<subsplat::Error>();
            match refused {
                Some(subsplat::Error::NoPoses { .. }) => ExitCode::from(ANSWER_NO),
                _ => code,
            }
        }
    }
}

fn dispatch(cli: &Cli, answer: Answer) -> Result<bool> {
    SimdLevel::requested()?;
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("--threads")?;
    }
    match &cli.command {
        Command::Run(args) => run::run(args, answer).map(|()| true),
        Command::Export(args) => export::export(args, answer).map(|()| true),
        Command::Render(args) => render::render(args, answer).map(|()| true),
        #[cfg(feature = "view")]
        Command::View(args) => view::view(args, answer).map(|()| true),
        #[cfg(not(feature = "view"))]
        Command::View(_) => anyhow::bail!(
            "view: this build has no window; `cargo install --path tools/cli --features view` builds \
             one, and `subsplat export SCENE -o scene.html` writes a page for a browser"
        ),
        Command::Poses(args) => poses::poses(args, answer).map(|()| true),
        Command::Check(args) => check::check(args, answer),
        Command::Info(args) => info::info(args, answer).map(|()| true),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_consistent() {
        Cli::command().debug_assert();
    }
}
