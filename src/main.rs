//! The `subsplat` program: arguments in, files and one report out. Everything it
//! does goes through the library's public API.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
