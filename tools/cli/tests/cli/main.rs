//! The programs, called as a user calls them.

mod cli_errors;
mod cli_photos;
mod command_line;
mod convert;
mod devices;
mod export;
mod interrupted;
mod motion;
mod photographs_without_cameras;
mod program;
mod readme;
mod readme_snippet;
mod scene_options;
mod video_input;
#[cfg(feature = "view")]
mod view;
