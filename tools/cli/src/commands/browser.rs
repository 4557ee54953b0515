//! Opens a page in the browser of the desktop.

use crate::report::print_warning;
use std::path::Path;
use std::process::{Command, Stdio};

/// The program that opens a file as the desktop would.
const OPENER: &[&str] = if cfg!(target_os = "macos") {
    &["open"]
} else if cfg!(target_os = "windows") {
    // `start` takes its first quoted argument for a title.
    &["cmd", "/C", "start", ""]
} else {
    &["xdg-open"]
};

/// Opens `page`, and prints a warning where that fails.
pub fn open(page: &Path) {
    // A relative path may begin with a dash.
    let whole = std::path::absolute(page).unwrap_or_else(|_| page.to_owned());
    let (program, rest) = (OPENER[0], &OPENER[1..]);
    let mut command = Command::new(program);
    command.args(rest).arg(whole).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let failed = match command.status() {
        Ok(status) if status.success() => return,
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    };
    print_warning(format!("--open: {program}: {failed}; open {} in a browser", page.display()));
}
