//! The commands, one file each.
//!
//! Exit codes: 0 success; 1 an error, reported on stderr; 2 wrong usage; 3 a negative answer
//! (`check`: bad poses; `compare`: a tensor out of tolerance). With `--json` stdout always holds
//! one object: the report, or `{"error": …}`.

pub mod args;
mod args_eval;
#[cfg(feature = "view")]
mod args_view;
mod check;
mod compare;
mod compare_raster;
mod eval;
mod frames;
mod info;
mod memory;
mod model;
mod output;
mod pair;
mod raster_case;
mod reconstruct;
mod render;
mod run;
mod tensorboard;
mod train;
#[cfg(feature = "view")]
mod view;

use crate::failure;
use crate::report::Answer;
use anyhow::{Context, Result, ensure};
use args::{Cli, Command};
use clap::Parser;
use std::process::ExitCode;

/// Exit code of a negative answer.
const ANSWER_NO: u8 = 3;
/// Largest number of threads; to start millions would hang the machine.
const THREADS_MAX: usize = 1024;

/// Runs the command of the process's arguments and returns the exit code.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return failure::report_usage(&error),
    };
    let answer = Answer::new(cli.json);
    match dispatch(&cli, answer) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(ANSWER_NO),
        Err(error) => failure::report_error(&error, answer),
    }
}

fn dispatch(cli: &Cli, answer: Answer) -> Result<bool> {
    if let Some(threads) = cli.threads {
        ensure!(
            (1..=THREADS_MAX).contains(&threads),
            "--threads: expected 1 to {THREADS_MAX}, got {threads}"
        );
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("--threads")?;
    }
    match &cli.command {
        Command::Run(args) => run::run(args, answer).map(|()| true),
        Command::Render(args) => render::render(args, answer).map(|()| true),
        #[cfg(feature = "view")]
        Command::View(args) => view::view(args, answer).map(|()| true),
        Command::Check(args) => check::check(args, answer),
        Command::Info(args) => info::info(args, answer).map(|()| true),
        Command::Eval(args) => eval::eval(args, answer).map(|()| true),
        Command::Compare(args) => compare::compare(args, answer),
        Command::Train(args) => train::train(args, answer).map(|()| true),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        Cli::command().debug_assert();
    }
}
