//! Writes the man pages and the shell completions of both programs: `subsplat-manual FOLDER`.
//!
//! `tools/release/build.sh` runs it; the feature `release` builds it.

use anyhow::{Context, Result};
use clap::{Command, CommandFactory, ValueEnum};
use clap_complete::Shell;
use std::fs::create_dir_all;
use std::path::{Path, PathBuf};
use subsplat_cli::commands::args::Cli;

fn main() -> Result<()> {
    let folder = std::env::args_os().nth(1).context("expected a folder, got no argument")?;
    for program in [Cli::command(), subsplat_cli::convert::command()] {
        // No pages for `help run` and the like.
        write(program.disable_help_subcommand(true), &PathBuf::from(folder.clone()))?;
    }
    Ok(())
}

/// Writes `man/` (a page for the program and for each command) and `completions/` (a file for each shell).
fn write(mut program: Command, folder: &Path) -> Result<()> {
    let name = program.get_name().to_owned();
    let completions = folder.join("completions");
    create_dir_all(&completions)?;
    for shell in Shell::value_variants() {
        clap_complete::generate_to(*shell, &mut program, &name, &completions)?;
    }
    let man = folder.join("man");
    create_dir_all(&man)?;
    Ok(clap_mangen::generate_to(program, &man)?)
}
