//! Reader of PyTorch's files (`torch.save`) that executes nothing in them.
//!
//! A `.ckpt`, `.pt` or `.pth` file is a pickle, a program for a machine that can call any
//! function by name, and the tensors' bytes. The machine of this module (`pickle.rs`) makes
//! data only: tensors, parameters and plain containers. Any other name becomes
//! [`Value::Opaque`], and its arguments are dropped. Callbacks and optimizer states of a
//! Lightning checkpoint are therefore harmless; a caller that needs a tensor refuses an
//! opaque value by name.
//!
//! The content decides between two formats: the zip archive of torch 1.6 (`zip.rs`) and the
//! older one (`legacy.rs`). A file is read by ranges: the pickle first, each tensor on
//! demand. The limits of a pickle (64 MiB, two million values) bound the memory of a hostile
//! file to some 200 MB.
//!
//! Refused by name: big-endian files, TorchScript archives, the tar format, deflated or
//! encrypted entries. Opaque values: complex, quantized, sparse, meta and 8-bit float
//! tensors, and views with pending negation or conjugation.

mod foreign;
mod globals;
mod legacy;
mod pickle;
mod read;
mod source;
mod tree;
mod value;
mod zip;

pub use value::{StorageRef, TensorRef, TorchDtype, Value};

use crate::files::{Error, Result};
use source::{Source, Stream};
use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Largest depth of a [`Value`].
pub const MAX_DEPTH: usize = 64;

/// The format of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// A zip archive: torch 1.6 and later.
    Zip,
    /// Consecutive pickles and storages: before torch 1.6, or
    /// `_use_new_zipfile_serialization=False`.
    Legacy,
}

/// An open file: its values and the positions of its storages. Elements are read on demand.
#[derive(Debug)]
pub struct TorchFile {
    path: PathBuf,
    form: Form,
    root: Value,
    opaque: BTreeSet<String>,
    source: Source,
    /// Positions of the storages whose checksum was compared.
    checked: Mutex<HashSet<u64>>,
}

impl TorchFile {
    /// Opens a file; its content decides the format.
    ///
    /// # Errors
    /// Missing, not a file of `torch.save` (the message names the format found), truncated,
    /// a wrong checksum, bytes outside of every entry, a tensor that does not lie in its
    /// storage, more values than the limits.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::from_source(Source::open(path)?, path)
    }

    /// Opens bytes in memory as [`TorchFile::open`] does; `name` is for messages.
    ///
    /// # Errors
    /// As [`TorchFile::open`].
    pub fn parse(bytes: impl Into<Arc<[u8]>>, name: impl AsRef<Path>) -> Result<Self> {
        Self::from_source(Source::Memory(bytes.into()), name.as_ref())
    }

    fn from_source(source: Source, path: &Path) -> Result<Self> {
        let length = source.len();
        let head = source.bytes(0, length.min(foreign::HEAD), path)?;
        let (form, pickle, root) = if head.starts_with(b"PK\x03\x04") {
            let archive = zip::Archive::open(&source, path)?;
            let pickle = archived(&archive, &source, path)?;
            let place = |key: &str| {
                let entry = archive.get(&format!("data/{key}"))?;
                Some(tree::Place { at: entry.at, bytes: entry.bytes, crc: Some(entry.crc) })
            };
            let root = tree::Builder::new(path, &pickle, &place).root()?;
            (Form::Zip, pickle, root)
        } else if legacy::starts(&head) {
            let (pickle, places) = legacy::open(&source, path)?;
            let place = |key: &str| places.get(key).copied();
            let root = tree::Builder::new(path, &pickle, &place).root()?;
            (Form::Legacy, pickle, root)
        } else {
            let got = foreign::name(&head, length);
            return Err(Error::format(path, "a file of torch.save", got));
        };
        let path = path.to_owned();
        let opaque = pickle.opaque;
        let checked = Mutex::default();
        Ok(Self { path, form, root, opaque, source, checked })
    }

    /// Returns the name of the file, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the saved object.
    pub fn root(&self) -> &Value {
        &self.root
    }

    /// Returns the format of the file.
    pub fn form(&self) -> Form {
        self.form
    }

    /// Lists `module.name` of every class and function of the file that is not a part of
    /// tensors and plain containers. None of them is called.
    pub fn opaque_globals(&self) -> &BTreeSet<String> {
        &self.opaque
    }

    /// Reads the elements of a tensor of this file, contiguous and little-endian, in the
    /// order of its shape. Memory: the elements, and for a view with gaps at most four times
    /// them or 16 MiB, whichever is more. The first read of a storage reads it whole, in
    /// pieces, for its checksum.
    ///
    /// # Errors
    /// The file has become shorter, or unreadable; a storage that does not have the
    /// archive's checksum; an expanded tensor (stride 0) of more than 64 MiB beyond its
    /// storage.
    pub fn read(&self, t: &TensorRef) -> Result<Vec<u8>> {
        let bytes = read::read(&self.source, &self.path, t)?;
        let storage = &t.storage;
        let known =
            |at: &u64| self.checked.lock().unwrap_or_else(PoisonError::into_inner).contains(at);
        if let Some(crc) = storage.crc.filter(|_| !bytes.is_empty() && !known(&storage.at)) {
            let range = storage.at..storage.at + storage.stored;
            let name = format!("storage `{}`", shown(&storage.key));
            check_crc(&self.source, &self.path, range, crc, &name)?;
            self.checked.lock().unwrap_or_else(PoisonError::into_inner).insert(storage.at);
        }
        Ok(bytes)
    }
}

/// Runs the pickle of an archive, which must be little-endian.
fn archived(archive: &zip::Archive, source: &Source, path: &Path) -> Result<pickle::Pickle> {
    archive.check_small(source, path)?;
    if let Some(order) = archive.get("byteorder") {
        let order = source.bytes(order.at, order.bytes.min(16), path)?;
        if order != b"little" {
            let got = format!("byte order `{}`", shown(&String::from_utf8_lossy(&order)));
            return Err(Error::format(path, "little-endian storages", got));
        }
    }
    let Some(entry) = archive.get("data.pkl") else {
        return Err(Error::format(path, "data.pkl in the archive", "none"));
    };
    let end = entry.at + entry.bytes;
    if entry.bytes <= pickle::MAX_PICKLE {
        check_crc(source, path, entry.at..end, entry.crc, "data.pkl")?;
    }
    let mut stream = Stream::new(source, path, entry.at, end, pickle::MAX_PICKLE);
    let pickle = pickle::run(&mut stream)?;
    let more = end - stream.position();
    if more > 0 {
        let expected = "the end of the pickle at the end of data.pkl";
        return Err(Error::format(path, expected, format!("{more} more bytes")));
    }
    Ok(pickle)
}

/// Compares the CRC-32 of a range of the file with an archive's. PyTorch writes 0 where it
/// was told to compute none; such a range is not read.
fn check_crc(
    source: &Source,
    path: &Path,
    range: std::ops::Range<u64>,
    expected: u32,
    name: &str,
) -> Result<()> {
    if expected == 0 {
        return Ok(());
    }
    let mut sum = flate2::Crc::new();
    let mut stream = Stream::new(source, path, range.start, range.end, u64::MAX);
    while stream.left() > 0 {
        sum.update(stream.take(stream.left().min(1 << 16) as usize)?);
    }
    if sum.sum() == expected {
        return Ok(());
    }
    let got = format!("{:08x} (a damaged file)", sum.sum());
    Err(Error::format(path, format!("CRC-32 {expected:08x} of {name}"), got))
}

/// Escapes a name of the file for a message and cuts it after 120 characters.
fn shown(text: &str) -> String {
    let mut shown: String = text.chars().take(120).flat_map(char::escape_debug).collect();
    if text.chars().nth(120).is_some() {
        shown.push('…');
    }
    shown
}
