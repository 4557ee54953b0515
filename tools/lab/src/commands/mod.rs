//! The commands of `subsplat-lab`, one file or folder each.

pub mod args;
mod args_eval;
mod args_paper;
mod compare;
mod compare_raster;
mod eval;
mod paper;
mod raster_case;
mod tensorboard;
mod train;

use anyhow::{Context, Result};
use args::{Cli, Command};
use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};
use std::process::ExitCode;
use subsplat_cli::commands::environment;
use subsplat_cli::failure;
use subsplat_cli::report::Answer;
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
    if cli.command.uses_gpu() {
        environment::restart_for_gpu();
    }
    let answer = Answer::new(cli.json);
    match dispatch(&cli, answer) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(ANSWER_NO),
        Err(error) => failure::report_error(&error, answer),
    }
}

fn dispatch(cli: &Cli, answer: Answer) -> Result<bool> {
    SimdLevel::requested()?;
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("--threads")?;
    }
    match &cli.command {
        Command::Eval(args) => eval::eval(args, answer).map(|()| true),
        Command::Paper(args) => paper::paper(args, answer).map(|()| true),
        Command::Compare(args) => compare::compare(args, answer),
        Command::Train(args) => train::train(args, answer).map(|()| true),
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
