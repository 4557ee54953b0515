//! The `subsplat-convert` program.

use std::process::ExitCode;

#[global_allocator]
static PAGES: subsplat_cli::pages::Pages = subsplat_cli::pages::Pages;

fn main() -> ExitCode {
    subsplat_cli::convert::main()
}
