//! Errors of the programs: one line on stderr, the same line in the object of `--json`, and an
//! exit code.

use super::report::{Answer, print_line};
use serde_json::json;
use std::process::ExitCode;

/// Exit code of wrong usage.
const USAGE: u8 = 2;

/// Prints an error and returns its exit code.
pub fn report_error(error: &anyhow::Error, answer: Answer) -> ExitCode {
    let line = error_line(error);
    print_line(format!("error: {line}"));
    // The exit code reports the error already; a closed pipe changes nothing.
    let _ = answer.finish(&json!({ "error": line }));
    ExitCode::FAILURE
}

/// Prints help, version, or an error of usage, and returns the exit code.
pub fn report_usage(error: &clap::Error) -> ExitCode {
    // A closed pipe does not change the exit code.
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

/// Joins the error and its causes to one line, without causes that the line already contains.
fn error_line(error: &anyhow::Error) -> String {
    error.chain().map(|cause| one_line(&cause.to_string())).fold(String::new(), |all, cause| {
        match all.as_str() {
            "" => cause,
            _ if all.contains(&cause) => all,
            _ => format!("{all}: {cause}"),
        }
    })
}

/// Removes line breaks, and the backtrace that candle appends to its messages where
/// RUST_BACKTRACE is set.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_lose_their_backtraces() {
        let text = "weight `a`: expected [1], got [2]\n   0: candle_core::bt\n   1: main\n";
        assert_eq!(one_line(text), "weight `a`: expected [1], got [2]");
        assert_eq!(one_line("a: b\n\n  c"), "a: b; c");
        assert_eq!(one_line("3x: no frame"), "3x: no frame");
    }
}
