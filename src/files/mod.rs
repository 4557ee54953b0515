//! Readers and writers of every file format. Readers convert to the conventions of
//! [`subsplat_kernels::camera`]; writers convert from them.
//!
//! Writers write a temporary file and rename it at the end ([`write_atomic`]), so that no
//! reader sees a partial file. Readers compare every declared size with the bytes that
//! exist before they allocate. They check the checksums of a container and refuse bytes
//! after its end (a .ply is read with a note on them).
//!
//! Foreign conventions end here and in the network's `model/primaries.rs`. Every binary reader has a `parse_*` of
//! bytes, which tests and fuzz targets call.

mod archive;
pub mod photos;
pub mod poses;
pub mod splats;
pub mod weights;

pub use splats::{
    SaveOptions, SaveReport, SplatFile, SplatFormat, SplatInfo, Up, encode_splats,
    encode_splats_with, is_splat_file, load_splat_file, load_splats, load_with_comments,
    parse_splats, save_splats, splat_info,
};

use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use thiserror::Error;

/// Reason for which a file is refused or cannot be written.
#[derive(Debug, Error)]
pub enum Error {
    /// The operating system reports an error: missing file, no permission, full disk.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The content is malformed.
    #[error("{}{at}: expected {expected}, got {got}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Place in the file: `:12` (a line), ` at byte 96`, ` frame 3`, or empty.
        at: String,
        /// The accepted content.
        expected: String,
        /// The content found.
        got: String,
    },
}

/// Result of the functions of this module.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// Makes an [`Error::Io`] for `path`.
    pub fn io(path: impl Into<PathBuf>, source: std::io::Error) -> Self {
        Self::Io { path: path.into(), source }
    }

    /// Makes an [`Error::Format`] for the whole of `path`.
    pub fn format(
        path: impl Into<PathBuf>,
        expected: impl Into<String>,
        got: impl Into<String>,
    ) -> Self {
        let (expected, got) = (expected.into(), got.into());
        Self::Format { path: path.into(), at: String::new(), expected, got }
    }

    /// The same error, for another thing that it concerns.
    pub(crate) fn copy(&self) -> Self {
        match self {
            Self::Io { path, source } => Self::io(path, source.kind().into()),
            Self::Format { path, at, expected, got } => {
                Self::format(path, expected, got).at(at.clone())
            }
        }
    }

    /// The message without the path of the file, where a sentence names it.
    #[must_use]
    pub fn reason(&self) -> String {
        match self {
            Self::Io { source, .. } => source.to_string(),
            Self::Format { at, expected, got, .. } => {
                let place = at.trim_start();
                let place = if place.is_empty() { String::new() } else { format!("{place}: ") };
                format!("{place}expected {expected}, got {got}")
            }
        }
    }

    /// Returns the same error at a place in the file: `:12`, ` at byte 96`, ` frame 3`.
    #[must_use]
    pub fn at(mut self, place: impl Into<String>) -> Self {
        if let Self::Format { at, .. } = &mut self {
            *at = place.into();
        }
        self
    }
}

/// Reads a whole file.
///
/// # Errors
/// [`Error::Io`]: missing, unreadable, a directory, a pipe or device.
pub fn read(path: impl AsRef<Path>) -> Result<Vec<u8>> {
    let path = path.as_ref();
    check_regular(path).and_then(|()| std::fs::read(path)).map_err(|e| Error::io(path, e))
}

/// Opens a file for reading.
///
/// # Errors
/// Missing, unreadable; those of [`check_regular`].
fn open_regular(path: &Path) -> std::io::Result<File> {
    check_regular(path)?;
    File::open(path)
}

/// Refuses what is no file: the opening of a pipe waits for a writer, and a device need not end.
///
/// # Errors
/// Missing; a pipe, a socket or a device. A folder is an error of the system when it is read.
fn check_regular(path: &Path) -> std::io::Result<()> {
    let kind = std::fs::metadata(path)?.file_type();
    if kind.is_file() || kind.is_dir() {
        return Ok(());
    }
    let got =
        "expected a regular file, got a pipe, socket or device: save its content to a file first";
    Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, got))
}

/// The first `count` bytes of a file, or all of a shorter one.
fn first_bytes(path: &Path, count: usize) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(count);
    open_regular(path)?.take(count as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The extension of a path in lower case; empty without one.
fn lower_extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_lowercase()
}

/// Number of the next temporary file of this process.
static TEMPORARY: AtomicU64 = AtomicU64::new(0);

/// Writes `path` through `body`: to a temporary file in the same folder, which is flushed to
/// the disk and renamed. An error removes the temporary file and leaves the old file as it
/// was. Each call has a temporary file of its own: of several at once the last one that ends stays.
///
/// # Errors
/// No such folder, no permission, full disk; the error of `body`.
pub fn write_atomic(
    path: impl AsRef<Path>,
    body: impl FnOnce(&mut BufWriter<File>) -> std::io::Result<()>,
) -> Result<()> {
    let path = path.as_ref();
    let name = path.file_name().ok_or_else(|| Error::format(path, "a file name", "a folder"))?;
    let mut temporary = name.to_owned();
    let number = TEMPORARY.fetch_add(1, Ordering::Relaxed);
    temporary.push(format!(".{}-{number}.part", std::process::id()));
    let temporary = path.with_file_name(temporary);
    let attempt = || -> std::io::Result<()> {
        let mut file = BufWriter::new(File::create(&temporary)?);
        body(&mut file)?;
        file.flush()?;
        file.get_ref().sync_all()?;
        drop(file);
        std::fs::rename(&temporary, path)
    };
    attempt().map_err(|e| {
        // The first error is reported; this one is not.

        let _ = std::fs::remove_file(&temporary);
        Error::io(path, e)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_writes_at_once_are_both_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_atomic(&path, |f| {
            f.write_all(b"outer ")?;
            f.flush()?;
            write_atomic(&path, |f| f.write_all(b"inner")).unwrap();
            assert_eq!(read(&path).unwrap(), b"inner");
            f.write_all(b"file")
        })
        .unwrap();
        assert_eq!(read(&path).unwrap(), b"outer file");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_atomic(&path, |f| f.write_all(b"old")).unwrap();
        let failed = write_atomic(&path, |f| {
            f.write_all(b"half")?;
            Err(std::io::Error::other("disk full"))
        });
        assert!(failed.unwrap_err().to_string().contains("disk full"));
        assert_eq!(read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
