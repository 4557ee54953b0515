//! Programs that convert pictures of formats that this build does not read: HEIC, AVIF, JPEG XL and raw files.
//!
//! A program is searched in `PATH` and started without a shell. It reads a copy of the picture under a name of
//! ours in a folder of its own, so that no name of a user's file reaches its arguments. It is ended after
//! [`TIME_LIMIT`], or when its result exceeds [`OUTPUT_LIMIT`]. A result that a caller does not accept is a failure
//! of the program, and the next one is tried.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Longest run of a program on one picture. A raw file of 100 megapixels takes about a minute.
const TIME_LIMIT: Duration = Duration::from_secs(120);
/// Largest result of a program, bytes: 16-bit RGB of 100 megapixels have 6e8.
const OUTPUT_LIMIT: u64 = 1 << 30;
/// Interval between two looks at a program.
const POLL: Duration = Duration::from_millis(5);
/// Bytes at the end of a program's messages that are read, and characters of the line that an error shows.
const MESSAGES: u64 = 4096;
const LINE: usize = 200;

/// Formats that programs convert.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Heic,
    Avif,
    Jxl,
    /// A DNG or a camera's own raw format.
    Raw,
}

/// Rotation of the pixels that a program writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turned {
    /// They are upright; an orientation tag of the result is not to be applied again.
    Upright,
    /// The orientation tag of the result turns them.
    ByTag,
    /// It depends on the program's version.
    Unknown,
}

/// A program with its arguments. It runs in the folder of `IN` and `OUT`.
struct Program {
    /// The name, and earlier ones.
    names: &'static [&'static str],
    kinds: &'static [Kind],
    arguments: &'static [&'static str],
    /// Names of the result.
    outputs: &'static [&'static str],
    turned: Turned,
}

/// Placeholder of the picture's name in the arguments.
const IN: &str = "<in>";
/// Results; some programs number them where a file has several pictures.
const PNG: &[&str] = &["out.png", "out-1.png"];

/// The programs, the best first.
const PROGRAMS: &[Program] = &[
    // Of libheif; `heif-convert` is the name before version 1.18.
    Program {
        names: &["heif-dec", "heif-convert"],
        kinds: &[Kind::Heic, Kind::Avif],
        arguments: &[IN, "out.png"],
        outputs: PNG,
        turned: Turned::Upright,
    },
    Program {
        names: &["avifdec"],
        kinds: &[Kind::Avif],
        arguments: &[IN, "out.png"],
        outputs: PNG,
        turned: Turned::Unknown,
    },
    Program {
        names: &["djxl"],
        kinds: &[Kind::Jxl],
        arguments: &[IN, "out.png"],
        outputs: PNG,
        turned: Turned::Upright,
    },
    // Of macOS. TIFF: without loss, with the profile and a defined orientation tag.
    Program {
        names: &["sips"],
        kinds: &[Kind::Heic, Kind::Avif, Kind::Jxl, Kind::Raw],
        arguments: &["-s", "format", "tiff", IN, "--out", "out.tif"],
        outputs: &["out.tif"],
        turned: Turned::ByTag,
    },
    // Of LibRaw: white balance of the camera, sRGB, the same brightness for all pictures.
    Program {
        names: &["dcraw_emu"],
        kinds: &[Kind::Raw],
        arguments: &["-w", "-W", "-o", "1", "-T", IN],
        outputs: &["in.raw.tiff", "in.tiff"],
        turned: Turned::Upright,
    },
    Program {
        names: &["dcraw"],
        kinds: &[Kind::Raw],
        arguments: &["-w", "-W", "-o", "1", "-T", IN],
        outputs: &["in.tiff"],
        turned: Turned::Upright,
    },
    // ImageMagick. `convert` is not searched: Windows has another program of this name.
    Program {
        names: &["magick"],
        kinds: &[Kind::Heic, Kind::Avif, Kind::Jxl],
        arguments: &[IN, "out.png"],
        outputs: &["out.png", "out-0.png"],
        turned: Turned::Upright,
    },
    // Versions before 7 know no tiles: the size tells.
    Program {
        names: &["ffmpeg"],
        kinds: &[Kind::Heic, Kind::Avif, Kind::Jxl],
        arguments: &[
            "-nostdin",
            "-loglevel",
            "error",
            "-noautorotate",
            "-i",
            IN,
            "-frames:v",
            "1",
            "-y",
            "out.png",
        ],
        outputs: PNG,
        turned: Turned::Unknown,
    },
];

impl Kind {
    /// Name of the picture's copy. LibRaw recognises a raw file by its content.
    fn copy(self) -> &'static str {
        match self {
            Self::Heic => "in.heic",
            Self::Avif => "in.avif",
            Self::Jxl => "in.jxl",
            Self::Raw => "in.raw",
        }
    }
}

/// Result of a program.
pub(super) struct Output {
    /// A PNG or TIFF file.
    pub bytes: Vec<u8>,
    pub program: &'static str,
    pub turned: Turned,
}

/// Programs of this computer that convert `kind`.
pub(super) struct Installed {
    kind: Kind,
    /// Programs with the names under which they were found.
    found: Vec<(&'static Program, &'static str, PathBuf)>,
    time_limit: Duration,
}

/// Searches for the programs in the folders of `PATH`.
pub(super) fn installed(kind: Kind) -> Installed {
    #[cfg(test)]
    if let Some(path) = TEST_PATH.with_borrow(Clone::clone) {
        return installed_in(kind, &path);
    }
    installed_in(kind, &std::env::var_os("PATH").unwrap_or_default())
}

#[cfg(test)]
thread_local! {
    /// `PATH` of the tests of a thread.
    pub(super) static TEST_PATH: std::cell::RefCell<Option<std::ffi::OsString>> =
        const { std::cell::RefCell::new(None) };
}

/// Searches for the programs in the folders of `path`. Relative folders are skipped: what they name depends on
/// where the photographs are.
fn installed_in(kind: Kind, path: &OsStr) -> Installed {
    let of_kind = PROGRAMS.iter().filter(|program| program.kinds.contains(&kind));
    let named = of_kind.flat_map(|program| program.names.iter().map(move |name| (program, *name)));
    let file = |(program, name): (&'static Program, &'static str)| {
        let file = format!("{name}{}", std::env::consts::EXE_SUFFIX);
        let folders = std::env::split_paths(path).filter(|folder| folder.is_absolute());
        let place = folders.map(|folder| folder.join(&file)).find(|file| is_program(file))?;
        Some((program, name, place))
    };
    Installed { kind, found: named.filter_map(file).collect(), time_limit: TIME_LIMIT }
}

#[cfg(unix)]
fn is_program(file: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    file.metadata().is_ok_and(|m| m.is_file() && m.permissions().mode() & 0o111 != 0)
}

#[cfg(not(unix))]
fn is_program(file: &Path) -> bool {
    file.is_file()
}

impl Installed {
    /// Returns whether there is none.
    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// Converts a picture with the first program whose result `accept` takes.
    ///
    /// # Errors
    /// The reason of each program.
    pub fn convert<T>(
        &self,
        picture: &[u8],
        mut accept: impl FnMut(Output) -> Result<T, String>,
    ) -> Result<T, String> {
        let mut reasons = Vec::new();
        for (program, name, file) in &self.found {
            let made = self.run(program, file, picture);
            let output = made.map(|bytes| Output { bytes, program: name, turned: program.turned });
            match output.and_then(&mut accept) {
                Ok(accepted) => return Ok(accepted),
                Err(reason) => reasons.push(format!("{name}: {reason}")),
            }
        }
        Err(reasons.join("; "))
    }

    /// The picture that a program writes.
    fn run(&self, program: &Program, file: &Path, picture: &[u8]) -> Result<Vec<u8>, String> {
        let system = |error: std::io::Error| error.to_string();
        // Readable for the user alone, and removed at the end.
        let folder = tempfile::tempdir().map_err(system)?;
        let copy = self.kind.copy();
        std::fs::write(folder.path().join(copy), picture).map_err(system)?;
        let messages = tempfile::tempfile().map_err(system)?;
        let arguments = program.arguments.iter().map(|a| if *a == IN { copy } else { a });
        let mut command = Command::new(file);
        command.args(arguments).current_dir(folder.path()).stdin(Stdio::null());
        command.stdout(messages.try_clone().map_err(system)?);
        command.stderr(messages.try_clone().map_err(system)?);
        let outputs: Vec<PathBuf> = program.outputs.iter().map(|n| folder.path().join(n)).collect();
        let success = watch(&mut command, &outputs, self.time_limit)?;
        let output = outputs.iter().find(|file| file.is_file());
        let Some(output) = output.filter(|_| success) else {
            return Err(last_line(messages).unwrap_or_else(|| "it wrote no picture".to_owned()));
        };
        std::fs::read(output).map_err(system)
    }
}

/// Runs a program to its end, or ends it at a limit. Returns whether it reports success.
fn watch(command: &mut Command, outputs: &[PathBuf], limit: Duration) -> Result<bool, String> {
    let mut child = command.spawn().map_err(|e| e.to_string())?;
    let start = Instant::now();
    let reason = loop {
        match child.try_wait() {
            Ok(Some(status)) => return Ok(status.success()),
            Ok(None) => {}
            Err(error) => break error.to_string(),
        }
        if start.elapsed() > limit {
            break format!("it did not end within {} seconds", limit.as_secs_f64());
        }
        let size = |file: &PathBuf| file.metadata().map_or(0, |m| m.len());
        if outputs.iter().any(|file| size(file) > OUTPUT_LIMIT) {
            break format!("it wrote more than {} MiB", OUTPUT_LIMIT >> 20);
        }
        std::thread::sleep(POLL);
    };
    // The reason is reported; errors of the ending are not.
    let _ = child.kill();
    let _ = child.wait();
    Err(reason)
}

/// The last line of a program's messages that is not empty.
fn last_line(mut messages: File) -> Option<String> {
    let end = messages.seek(SeekFrom::End(0)).ok()?;
    messages.seek(SeekFrom::Start(end.saturating_sub(MESSAGES))).ok()?;
    let mut text = Vec::new();
    messages.take(MESSAGES).read_to_end(&mut text).ok()?;
    let text = String::from_utf8_lossy(&text);
    let line = text.lines().rev().map(str::trim).find(|line| !line.is_empty())?;
    Some(line.chars().filter(|c| !c.is_control()).take(LINE).collect())
}

#[cfg(all(test, unix))]
pub(super) mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A folder with shell scripts as programs.
    pub fn folder(programs: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, script) in programs {
            let file = folder.path().join(name);
            std::fs::write(&file, format!("#!/bin/sh\n{script}\n")).unwrap();
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
        }
        folder
    }

    fn bytes(output: Output) -> Result<(&'static str, Vec<u8>), String> {
        Ok((output.program, output.bytes))
    }

    #[test]
    fn the_first_program_that_succeeds_converts() {
        let folder = folder(&[
            ("heif-dec", "echo; echo Could not read; echo; exit 1"),
            ("heif-convert", "echo File contains 1 image"),
            // `cat` and `cp` are found in the test's own PATH.
            ("ffmpeg", "[ $# = 10 ] && cat in.heic in.heic > out.png"),
            ("avifdec", "cp in.heic out.png"),
        ]);
        let programs = installed_in(Kind::Heic, folder.path().as_os_str());
        let (program, found) = programs.convert(b"ab", bytes).unwrap();
        assert_eq!((program, &found[..]), ("ffmpeg", &b"abab"[..]));
        let error = programs.convert(b"ab", |_| Err::<(), _>("512x512".to_owned())).unwrap_err();
        assert_eq!(
            error,
            "heif-dec: Could not read; heif-convert: File contains 1 image; ffmpeg: 512x512"
        );
    }

    #[test]
    fn programs_are_executable_files_of_absolute_folders() {
        let folder = folder(&[("heif-dec", "exit 0")]);
        let file = folder.path().join("heif-dec");
        assert!(!installed_in(Kind::Heic, folder.path().as_os_str()).is_empty());
        assert!(installed_in(Kind::Raw, folder.path().as_os_str()).is_empty());
        assert!(installed_in(Kind::Heic, OsStr::new(".:bin:")).is_empty());
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(installed_in(Kind::Heic, folder.path().as_os_str()).is_empty());
    }

    #[test]
    fn a_program_that_does_not_end_is_ended() {
        let folder = folder(&[("djxl", "exec sleep 30"), ("sips", "exit 0")]);
        let mut programs = installed_in(Kind::Jxl, folder.path().as_os_str());
        programs.time_limit = Duration::from_millis(200);
        let start = Instant::now();
        let error = programs.convert(b"x", bytes).unwrap_err();
        assert!(start.elapsed() < Duration::from_secs(10));
        assert_eq!(error, "djxl: it did not end within 0.2 seconds; sips: it wrote no picture");
    }
}
