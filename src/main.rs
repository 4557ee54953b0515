//! The `subsplat` program: arguments in, files and one report out. Everything it
//! does goes through the library's public API.

mod cli;

use std::process::ExitCode;

#[global_allocator]
static PAGES: subsplat::cpu::pages::Pages = subsplat::cpu::pages::Pages;

fn main() -> ExitCode {
    cli::main()
}
