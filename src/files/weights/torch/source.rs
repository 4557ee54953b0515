//! Ranges of bytes of a file or of memory, and a forward stream over a range.

use crate::files::{Error, Result, open_regular};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Bytes per read of a [`Stream`].
const CHUNK: u64 = 64 << 10;

/// A file, or bytes in memory.
#[derive(Debug)]
pub(super) enum Source {
    /// A file and its length when it was opened.
    File(Mutex<File>, u64),
    /// Bytes in memory.
    Memory(Arc<[u8]>),
}

impl Source {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let io = |e| Error::io(path, e);
        let file = open_regular(path).map_err(io)?;
        let data = file.metadata().map_err(io)?;
        if data.is_dir() {
            return Err(Error::format(path, "a file of torch.save", "a folder"));
        }
        Ok(Self::File(Mutex::new(file), data.len()))
    }

    pub(super) fn len(&self) -> u64 {
        match self {
            Self::File(_, length) => *length,
            Self::Memory(bytes) => bytes.len() as u64,
        }
    }

    /// Reads `out.len()` bytes from position `at`.
    pub(super) fn read_at(&self, at: u64, out: &mut [u8]) -> std::io::Result<()> {
        match self {
            Self::File(file, _) => {
                // A poisoned lock is harmless: every read seeks first.
                let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
                file.seek(SeekFrom::Start(at))?;
                file.read_exact(out)
            }
            Self::Memory(bytes) => {
                let from = usize::try_from(at).ok();
                let range = from.and_then(|a| Some(a..a.checked_add(out.len())?));
                match range.and_then(|r| bytes.get(r)) {
                    Some(there) => out.copy_from_slice(there),
                    None => return Err(std::io::ErrorKind::UnexpectedEof.into()),
                }
                Ok(())
            }
        }
    }

    /// Reads `length` bytes from `at`. The range is checked before memory is allocated.
    pub(super) fn bytes(&self, at: u64, length: u64, path: &Path) -> Result<Vec<u8>> {
        let size = usize::try_from(length).ok();
        let end = at.checked_add(length).filter(|end| *end <= self.len());
        let (Some(size), Some(_)) = (size, end) else {
            let got = format!("{} bytes (truncated?)", self.len());
            return Err(Error::format(path, format!("{length} bytes at byte {at}"), got));
        };
        let mut out = vec![0; size];
        self.read_at(at, &mut out).map_err(|e| Error::io(path, e))?;
        Ok(out)
    }
}

/// A forward stream from a position to an end.
pub(super) struct Stream<'a> {
    source: &'a Source,
    pub(super) path: &'a Path,
    /// Position in the file of the byte after the buffer's last.
    next: u64,
    end: u64,
    /// The end is the limit, and the range is longer.
    limited: bool,
    buffer: Vec<u8>,
    used: usize,
}

impl<'a> Stream<'a> {
    /// Makes a stream of the bytes `at..end`, at most `limit` of them.
    pub(super) fn new(source: &'a Source, path: &'a Path, at: u64, end: u64, limit: u64) -> Self {
        let end = end.min(source.len());
        let stop = end.min(at.saturating_add(limit));
        let buffer = Vec::new();
        Self { source, path, next: at, end: stop, limited: stop < end, buffer, used: 0 }
    }

    /// Returns the position in the file of the next byte.
    pub(super) fn position(&self) -> u64 {
        self.next - (self.buffer.len() - self.used) as u64
    }

    /// Returns the number of bytes up to the end.
    pub(super) fn left(&self) -> u64 {
        self.end.saturating_sub(self.position())
    }

    /// Takes the next `n` bytes.
    pub(super) fn take(&mut self, n: usize) -> Result<&[u8]> {
        if self.buffer.len() - self.used < n {
            self.fill(n)?;
        }
        let from = self.used;
        self.used += n;
        self.buffer.get(from..self.used).ok_or_else(|| self.short(n as u64))
    }

    fn fill(&mut self, n: usize) -> Result<()> {
        let left = self.left();
        if (n as u64) > left {
            return Err(self.short(n as u64));
        }
        self.buffer.drain(..self.used);
        self.used = 0;
        let have = self.buffer.len();
        let want = (n as u64).max(CHUNK).min(left) as usize;
        self.buffer.resize(want.max(have), 0);
        let fresh = self.buffer.get_mut(have..).unwrap_or_default();
        self.source.read_at(self.next, fresh).map_err(|e| Error::io(self.path, e))?;
        self.next += fresh.len() as u64;
        Ok(())
    }

    fn short(&self, n: u64) -> Error {
        let position = self.position();
        let left = self.left();
        let got = if self.limited {
            format!("{left} up to the limit on the size of a pickle")
        } else {
            format!("{left} (truncated, or a wrong length)")
        };
        Error::format(self.path, format!("{n} more bytes of pickle"), got)
            .at(format!(" at byte {position}"))
    }

    /// Takes the next byte.
    pub(super) fn byte(&mut self) -> Result<u8> {
        self.array::<1>().map(|[b]| b)
    }

    /// Takes the next `N` bytes.
    pub(super) fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }

    /// Takes at most `limit` bytes up to the next line feed, and the line feed, which is
    /// dropped.
    pub(super) fn line(&mut self, limit: usize) -> Result<Vec<u8>> {
        let mut line = Vec::new();
        loop {
            match self.byte()? {
                b'\n' => return Ok(line),
                _ if line.len() >= limit => {
                    let place = format!(" at byte {}", self.position());
                    let expected = format!("a line of at most {limit} bytes");
                    return Err(Error::format(self.path, expected, "a longer one").at(place));
                }
                byte => line.push(byte),
            }
        }
    }
}
