//! PyTorch's files (`torch.save`), read without running anything in them.

mod value;

pub use value::{StorageRef, TensorRef, TorchDtype, Value};

use super::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Deepest nesting of a [`Value`].
pub const MAX_DEPTH: usize = 64;

/// How the file is laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// A zip archive: torch 1.6 and later.
    Zip,
    /// Pickles and storages one after the other: earlier, or
    /// `_use_new_zipfile_serialization=False`.
    Legacy,
}

/// An open file: its values, and where its storages lie. Elements are read on demand.
#[derive(Debug)]
pub struct TorchFile {
    path: PathBuf,
    form: Form,
    root: Value,
    opaque: BTreeSet<String>,
}

impl TorchFile {
    /// Opens a file; its content decides which form it has.
    ///
    /// # Errors
    /// Missing, not a file of `torch.save` (the message says what it is instead),
    /// truncated, a tensor that does not lie in its storage, more values than the limits.
    pub fn open(path: &Path) -> Result<Self> {
        Err(Error::format(path, "a reader", "none"))
    }

    /// [`TorchFile::open`] of bytes in memory; `name` stands in messages.
    ///
    /// # Errors
    /// As [`TorchFile::open`].
    pub fn parse(bytes: impl Into<Arc<[u8]>>, name: &Path) -> Result<Self> {
        let _: Arc<[u8]> = bytes.into();
        Err(Error::format(name, "a reader", "none"))
    }

    /// Name of the file, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What was saved.
    pub fn root(&self) -> &Value {
        &self.root
    }

    /// Layout of the file.
    pub fn form(&self) -> Form {
        self.form
    }

    /// `module.name` of every class and function that the file names and that is not a
    /// part of tensors and plain containers. Nothing of them was called.
    pub fn opaque_globals(&self) -> &BTreeSet<String> {
        &self.opaque
    }

    /// Elements of a tensor of this file, contiguous and little-endian, in the order of
    /// its shape.
    ///
    /// # Errors
    /// The file has become shorter, or unreadable; an expanded tensor (stride 0) of more
    /// than 64 MiB beyond its storage.
    pub fn read(&self, t: &TensorRef) -> Result<Vec<u8>> {
        let _ = t;
        Err(Error::format(&self.path, "a reader", "none"))
    }
}
