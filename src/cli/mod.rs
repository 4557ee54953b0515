//! The commands, one file each.
//!
//! Exit codes: 0 done; 1 an error, told on stderr; 2 wrong usage; 3 the answer is no
//! (`check`: bad poses; `compare`: a tensor out of tolerance). With `--json` stdout
//! holds one object whatever the code is: the report, or `{"error": …}`.

pub mod args;
mod check;
mod compare;
mod compare_raster;
mod frames;
mod info;
mod memory;
mod model;
mod output;
mod pair;
mod range;
mod raster_case;
mod render;
mod report;
mod run;

use anyhow::{Context, Result, ensure};
use args::{Cli, Command};
use clap::Parser;
use report::Answer;
use serde_json::json;
use std::process::ExitCode;

/// Exit code of wrong usage.
const USAGE: u8 = 2;
/// Exit code where the command worked and its answer is no.
const ANSWER_NO: u8 = 3;
/// More threads than any machine that this is meant for; starting millions would hang.
const THREADS_MAX: usize = 1024;

/// Runs the command of the process's arguments; its result as an exit code.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return refuse(&error),
    };
    let answer = Answer::new(cli.json);
    match dispatch(&cli, answer) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(ANSWER_NO),
        Err(error) => {
            let line = told(&error);
            report::say(format!("error: {line}"));
            // The exit code tells of the error; a closed pipe here adds nothing to it.
            let _ = answer.finish(&json!({ "error": line }));
            ExitCode::FAILURE
        }
    }
}

/// Help, version, or wrong usage.
fn refuse(error: &clap::Error) -> ExitCode {
    // A closed pipe is no reason for another exit code.
    let _ = error.print();
    if !error.use_stderr() {
        return ExitCode::SUCCESS;
    }
    let text = error.to_string();
    // Usage and hints follow after an empty line.
    let line = one_line(text.split("\n\n").next().unwrap_or_default());
    let line = line.strip_prefix("error: ").unwrap_or(&line);
    let json = std::env::args_os().any(|a| a == "--json");
    let _ = Answer::new(json).finish(&json!({ "error": line }));
    ExitCode::from(USAGE)
}

/// The error and its causes in one line. A cause that the error's own words repeat is
/// left out.
fn told(error: &anyhow::Error) -> String {
    error.chain().map(|cause| one_line(&cause.to_string())).fold(String::new(), |all, cause| {
        match all.as_str() {
            "" => cause,
            _ if all.contains(&cause) => all,
            _ => format!("{all}: {cause}"),
        }
    })
}

/// `text` without line breaks, and without the backtrace that candle appends to its
/// messages where RUST_BACKTRACE is set.
fn one_line(text: &str) -> String {
    let is_frame = |line: &&str| {
        let line = line.trim_start();
        let number = line.trim_start_matches(|c: char| c.is_ascii_digit());
        number.len() < line.len() && number.starts_with(": ")
    };
    let lines: Vec<&str> = text
        .lines()
        .take_while(|l| !is_frame(l))
        .map(str::trim)
        .filter(|l| !l.is_empty())
        .collect();
    lines.join("; ")
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
        Command::Check(args) => check::check(args, answer),
        Command::Info(args) => info::info(args, answer).map(|()| true),
        Command::Compare(args) => compare::compare(args, answer),
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

    #[test]
    fn errors_lose_their_backtraces() {
        let text = "weight `a`: expected [1], got [2]\n   0: candle_core::bt\n   1: main\n";
        assert_eq!(one_line(text), "weight `a`: expected [1], got [2]");
        assert_eq!(one_line("a: b\n\n  c"), "a: b; c");
        assert_eq!(one_line("3x: no frame"), "3x: no frame");
    }
}
