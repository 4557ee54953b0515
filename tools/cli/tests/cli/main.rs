//! The programs, called as a user calls them.

mod cli_errors;
mod cli_photos;
mod command_line;
mod compare_raster;
mod convert;
mod devices;
mod eval_cli;
mod export;
mod loose_photographs;
mod motion;
mod paper;
mod program;
mod readme;
mod readme_snippet;
mod train;
#[cfg(feature = "view")]
mod view;
