//! The commands, one file each.
//!
//! Exit codes: 0 done; 1 an error, told on stderr; 2 wrong usage; 3 the answer is no
//! (`check`: bad poses; `compare`: a tensor out of tolerance).

pub mod args;
mod check;
mod compare;
mod frames;
mod info;
mod pair;
mod render;
mod report;
mod run;

use anyhow::{Context, Result};
use args::{Cli, Command};
use std::process::ExitCode;

/// Exit code where the command worked and its answer is no.
const ANSWER_NO: u8 = 3;

/// Runs the command and turns its result into an exit code.
pub fn main(cli: Cli) -> ExitCode {
    match dispatch(&cli) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(ANSWER_NO),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn dispatch(cli: &Cli) -> Result<bool> {
    if let Some(threads) = cli.threads {
        anyhow::ensure!(threads > 0, "--threads: expected at least 1, got 0");
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("--threads")?;
    }
    match &cli.command {
        Command::Run(args) => run::run(args, cli.json).map(|()| true),
        Command::Render(args) => render::render(args, cli.json).map(|()| true),
        Command::Check(args) => check::check(args, cli.json),
        Command::Info(args) => info::info(args, cli.json).map(|()| true),
        Command::Compare(args) => compare::compare(args, cli.json),
    }
}
