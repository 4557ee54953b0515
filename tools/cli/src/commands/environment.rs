//! Environment variables that libraries of the program read.

#[cfg(unix)]
use std::os::unix::process::CommandExt;

/// Restarts the program with the variable `name`, unless the environment states it.
///
/// A process cannot change its own environment without `unsafe`. The restart keeps the process's
/// number, arguments and streams. Elsewhere than on Unix, and where it fails, nothing changes.
pub fn restart_with(name: &str, value: impl FnOnce() -> std::ffi::OsString) {
    if !cfg!(unix) || std::env::var_os(name).is_some() {
        return;
    }
    #[cfg(unix)]
    if let Ok(program) = std::env::current_exe() {
        let mut again = std::process::Command::new(program);
        // Returns only on failure.
        let _ = again.args(std::env::args_os().skip(1)).env(name, value()).exec();
    }
    #[cfg(not(unix))]
    let _ = value;
}

/// Restarts the program with a folder for sockets, if it opens a GPU and the environment has none.
///
/// Mesa's driver looks for a Wayland server in that folder, and prints an error where the variable
/// is absent, though the driver works.
pub fn restart_for_gpu() {
    restart_with("XDG_RUNTIME_DIR", || std::env::temp_dir().into_os_string());
}
