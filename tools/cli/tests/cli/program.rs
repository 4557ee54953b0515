//! The program under test.

use serde_json::Value;
use std::path::Path;
use std::process::Command;
pub use subsplat_test_support::scene_folder::{SIDE, files, named, workplace};

/// Exit code and output of one call of the program.
pub struct Called {
    /// Exit code; −1 where a signal ended it.
    pub code: i32,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl Called {
    /// The one JSON object on stdout.
    #[track_caller]
    pub fn json(&self) -> Value {
        assert_eq!(self.stdout.trim_end().lines().count(), 1, "{}\n{}", self.stdout, self.stderr);
        serde_json::from_str(&self.stdout).unwrap()
    }

    /// The one line that tells the error.
    #[track_caller]
    pub fn error(&self) -> &str {
        let told: Vec<&str> = self.stderr.lines().filter(|l| l.starts_with("error:")).collect();
        assert!(told.len() == 1, "{}", self.stderr);
        told[0]
    }
}

/// Calls the program with arguments separated by spaces, in `folder`.
pub fn call_in(folder: &Path, arguments: &str) -> Called {
    call_with(folder, &arguments.split_whitespace().collect::<Vec<_>>(), &[])
}

/// Calls the program with these arguments and environment, in `folder`.
pub fn call_with(folder: &Path, arguments: &[&str], environment: &[(&str, &str)]) -> Called {
    let mut command = Command::new(env!("CARGO_BIN_EXE_subsplat"));
    command.args(arguments).current_dir(folder).envs(environment.iter().copied());
    called(&mut command)
}

/// Runs `command` and returns its exit code and output.
pub fn called(command: &mut Command) -> Called {
    let output = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Called {
        code: output.status.code().unwrap_or(-1),
        stdout: text(output.stdout),
        stderr: text(output.stderr),
    }
}

/// The bytes of a .ply file without the lines of its header that name the photographs, which a caller of the library
/// does not name.
pub fn without_photographs(file: &Path) -> Vec<u8> {
    const END: &[u8] = b"end_header\n";
    let bytes = std::fs::read(file).unwrap();
    let Some(at) = bytes.windows(END.len()).position(|w| w == END) else { return bytes };
    let header = std::str::from_utf8(&bytes[..at]).unwrap();
    let kept = header.split_inclusive('\n').filter(|l| !l.contains("subsplat photograph:"));
    [kept.collect::<String>().as_bytes(), &bytes[at..]].concat()
}
