//! The `subsplat-convert` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    subsplat_cli::convert::main()
}
