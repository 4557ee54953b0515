//! The archive of torch 1.6 and later: a zip file of stored entries.
//!
//! PyTorch stores every entry uncompressed. The reader refuses an entry that is deflated or
//! encrypted, has the name of another one, overlaps it, or differs between the directory
//! and its own header. It refuses bytes that belong to no entry, too. General zip crates
//! accept some of these files, hence this reader. Entry names are keys of a map and never
//! become paths.

use super::source::Source;
use super::{check_crc, shown};
use crate::files::{Error, Result};
use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Largest central directory, bytes.
const MAX_DIRECTORY: u64 = 64 << 20;

/// Sentinel of a 32-bit field whose value is in the zip64 extra field.
const IN_ZIP64: u64 = 0xffff_ffff;

/// A stored entry.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    /// Position of its local header.
    header: u64,
    /// Position of its first byte.
    pub(super) at: u64,
    /// Length in bytes.
    pub(super) bytes: u64,
    /// CRC-32 of the data in the directory.
    pub(super) crc: u32,
    flags: u16,
    method: u16,
    compressed: u64,
}

/// The entries of an archive, and their folder.
#[derive(Debug)]
pub(super) struct Archive {
    entries: HashMap<String, Entry>,
    folder: String,
}

/// Reads a little-endian number of 2, 4 or 8 bytes at `at`; 0 past the end (callers check
/// lengths).
fn number(bytes: &[u8], at: usize, size: usize) -> u64 {
    let field = bytes.get(at..at + size).unwrap_or_default();
    field.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b))
}

impl Archive {
    /// Reads the directory and every local header.
    pub(super) fn open(source: &Source, path: &Path) -> Result<Self> {
        let Directory { at, bytes, count } = directory(source, path)?;
        let bytes = source.bytes(at, bytes, path)?;
        let mut entries = listed(&bytes, count, path)?;
        let folder = saved_by_torch(&entries, path)?;
        for (name, entry) in &mut entries {
            plain(name, entry, path)?;
            locate(name, entry, source, path)?;
        }
        contiguous(&entries, at, source, path)?;
        Ok(Self { entries, folder })
    }

    /// Compares the checksums of entries that are neither a pickle nor a storage.
    pub(super) fn check_small(&self, source: &Source, path: &Path) -> Result<()> {
        let pickle = format!("{}/data.pkl", self.folder);
        let storages = format!("{}/data/", self.folder);
        for (name, entry) in &self.entries {
            if *name != pickle && !name.starts_with(&storages) {
                let range = entry.at..entry.at + entry.bytes;
                check_crc(source, path, range, entry.crc, &format!("`{}`", shown(name)))?;
            }
        }
        Ok(())
    }

    /// Returns the entry `name` of the archive's folder.
    pub(super) fn get(&self, name: &str) -> Option<&Entry> {
        self.entries.get(&format!("{}/{name}", self.folder))
    }
}

fn refuse<T>(path: &Path, expected: &str, got: impl Into<String>) -> Result<T> {
    Err(Error::format(path, expected, got))
}

/// The central directory.
struct Directory {
    at: u64,
    bytes: u64,
    /// Number of entries.
    count: u64,
}

/// Finds the central directory by the end record and its zip64 form.
fn directory(source: &Source, path: &Path) -> Result<Directory> {
    // The end record: 22 bytes and a comment of at most 65535.
    let tail_at = source.len().saturating_sub(22 + 65_535);
    let tail = source.bytes(tail_at, source.len() - tail_at, path)?;
    let ends = |i: &usize| {
        tail.get(*i..*i + 4) == Some(b"PK\x05\x06")
            && number(&tail, i + 20, 2) == (tail.len() - i - 22) as u64
    };
    let Some(end) = (0..tail.len().saturating_sub(21)).rev().find(ends) else {
        return refuse(
            path,
            "a zip archive's end record",
            "a file without one (a truncated download?)",
        );
    };
    let end_at = tail_at + end as u64;
    let (mut disks, mut count) = (number(&tail, end + 4, 4), number(&tail, end + 10, 2));
    let (mut size, mut at) = (number(&tail, end + 12, 4), number(&tail, end + 16, 4));
    // Position of the record that follows the directory.
    let mut record_at = end_at;
    let locator = end.checked_sub(20).and_then(|l| tail.get(l..end));
    if let Some(locator) = locator.filter(|l| l.starts_with(b"PK\x06\x07")) {
        record_at = number(locator, 8, 8);
        let record = source.bytes(record_at, 56, path)?;
        let record_bytes = number(&record, 4, 8).saturating_add(12);
        if !record.starts_with(b"PK\x06\x06")
            || record_at.saturating_add(record_bytes) != end_at - 20
        {
            return refuse(
                path,
                "a zip64 end record before its locator",
                "a locator of another place",
            );
        }
        disks = number(&record, 16, 8);
        (count, size, at) =
            (number(&record, 32, 8), number(&record, 40, 8), number(&record, 48, 8));
    }
    if disks != 0 {
        return refuse(path, "an archive in one file", "a part of a split zip archive");
    }
    if at.checked_add(size) != Some(record_at) {
        let got = format!("{size} bytes at byte {at}, for an end record at byte {record_at}");
        return refuse(path, "a central directory that ends where the end record starts", got);
    }
    // An entry of the directory takes 46 bytes and its name.
    if size > MAX_DIRECTORY || count > size / 46 {
        let got = format!("{count} entries in {size} bytes");
        return refuse(path, "a central directory of at most 64 MiB that holds its entries", got);
    }
    Ok(Directory { at, bytes: size, count })
}

/// Reads the directory's entries without the positions of their data.
fn listed(bytes: &[u8], count: u64, path: &Path) -> Result<HashMap<String, Entry>> {
    let mut entries = HashMap::new();
    let mut rest = bytes;
    for _ in 0..count {
        let lengths = [number(rest, 28, 2), number(rest, 30, 2), number(rest, 32, 2)];
        let [name_end, extra_end, end] = {
            let [name, extra, comment] = lengths.map(|n| n as usize);
            [46 + name, 46 + name + extra, 46 + name + extra + comment]
        };
        if !rest.starts_with(b"PK\x01\x02") || rest.len() < end {
            return refuse(path, "an entry of the central directory", "other bytes");
        }
        let name = checked_name(rest.get(46..name_end).unwrap_or_default(), path)?;
        let extra = rest.get(name_end..extra_end).unwrap_or_default();
        let fields = [number(rest, 24, 4), number(rest, 20, 4), number(rest, 42, 4)];
        let [size, compressed, header] = widened(fields, extra)
            .ok_or_else(|| Error::format(path, "a zip64 field", format!("none in {name}")))?;
        let entry = Entry {
            header,
            at: 0,
            bytes: size,
            crc: number(rest, 16, 4) as u32,
            flags: number(rest, 8, 2) as u16,
            method: number(rest, 10, 2) as u16,
            compressed,
        };
        let shown = shown(&name);
        if entries.insert(name, entry).is_some() {
            return refuse(path, "every entry once", format!("`{shown}` twice"));
        }
        rest = rest.get(end..).unwrap_or_default();
    }
    if !rest.is_empty() {
        let got = format!("{} bytes after the last of {count}", rest.len());
        return refuse(path, "a central directory of its entries alone", got);
    }
    Ok(entries)
}

/// Replaces the fields that hold [`IN_ZIP64`] by those of the zip64 extra field, in its order.
fn widened(mut fields: [u64; 3], mut extra: &[u8]) -> Option<[u64; 3]> {
    if fields.iter().all(|f| *f != IN_ZIP64) {
        return Some(fields);
    }
    while extra.len() >= 4 {
        let id = number(extra, 0, 2);
        let size = number(extra, 2, 2) as usize;
        let mut body = extra.get(4..4 + size)?;
        if id == 1 {
            for field in fields.iter_mut().filter(|f| **f == IN_ZIP64) {
                *field = number(body.get(..8)?, 0, 8);
                body = body.get(8..)?;
            }
            return Some(fields);
        }
        extra = extra.get(4 + size..)?;
    }
    None
}

/// Checks that a name stays inside the archive. No file is written under it, but PyTorch
/// writes no such name.
fn checked_name(bytes: &[u8], path: &Path) -> Result<String> {
    let Ok(name) = std::str::from_utf8(bytes) else {
        return refuse(path, "entry names in UTF-8", shown(&String::from_utf8_lossy(bytes)));
    };
    let drive = name.as_bytes().get(1) == Some(&b':');
    let odd = name.chars().any(|c| c == '\\' || c.is_control());
    if name.is_empty()
        || name.starts_with('/')
        || drive
        || odd
        || name.split('/').any(|p| p == "..")
    {
        let got = format!("`{}`", shown(name));
        return refuse(path, "entry names that stay inside the archive", got);
    }
    Ok(name.to_owned())
}

/// Finds the folder of `data.pkl`; an error names the kind of another archive.
fn saved_by_torch(entries: &HashMap<String, Entry>, path: &Path) -> Result<String> {
    let inside = |wanted: &str| {
        entries.keys().any(|n| n.split_once('/').is_some_and(|(_, rest)| rest.starts_with(wanted)))
    };
    const EXPECTED: &str = "a file of torch.save (a zip archive with data.pkl)";
    if inside("constants.pkl") || inside("code/") {
        let got = "a TorchScript archive (torch.jit.save): save its state_dict() instead";
        return refuse(path, EXPECTED, got);
    }
    let mut folders =
        entries.keys().filter_map(|n| n.split_once('/')).filter(|(_, rest)| *rest == "data.pkl");
    match (folders.next(), folders.next()) {
        (Some((folder, _)), None) => Ok(folder.to_owned()),
        (Some(_), Some(_)) => refuse(path, "one data.pkl", "several in one archive"),
        _ if entries.keys().any(|n| n.ends_with(".npy")) => {
            refuse(path, EXPECTED, "NumPy's .npz archive")
        }
        _ => refuse(path, EXPECTED, "a zip archive without data.pkl"),
    }
}

/// Checks that an entry is stored, neither encrypted nor compressed.
fn plain(name: &str, entry: &Entry, path: &Path) -> Result<()> {
    let name = shown(name);
    // Bits 0, 6 and 13: encryption, strong encryption, masked headers.
    if entry.flags & 0x2041 != 0 {
        return refuse(path, "plain entries", format!("`{name}`, which is encrypted"));
    }
    let how = match entry.method {
        0 if entry.compressed == entry.bytes => return Ok(()),
        0 => {
            let got = format!("{} for {} in `{name}`", entry.compressed, entry.bytes);
            return refuse(path, "a stored entry of one size", got);
        }
        8 => "deflated".to_owned(),
        other => format!("compressed by method {other}"),
    };
    let got = format!("`{name}`, which is {how} (unpack the archive and store it, zip -0)");
    refuse(path, "stored entries, as torch.save writes them", got)
}

/// Finds the entry's data after its local header, which must agree with the directory.
fn locate(name: &str, entry: &mut Entry, source: &Source, path: &Path) -> Result<()> {
    let differs = || {
        let got = format!("another header for `{}` at byte {}", shown(name), entry.header);
        Error::format(path, "a local header that agrees with the central directory", got)
    };
    let head = source.bytes(entry.header, 30, path).map_err(|_| differs())?;
    let own_name = source.bytes(entry.header + 30, number(&head, 26, 2), path);
    let same_size = |at: usize, size: u64| {
        let own = number(&head, at, 4);
        // Bit 3: a descriptor after the data has the sizes.
        own == size || own == IN_ZIP64 || entry.flags & 8 != 0
    };
    if !head.starts_with(b"PK\x03\x04")
        || number(&head, 6, 2) != u64::from(entry.flags)
        || number(&head, 8, 2) != u64::from(entry.method)
        || !same_size(18, entry.compressed)
        || !same_size(22, entry.bytes)
        || own_name.map_err(|_| differs())? != name.as_bytes()
    {
        return Err(differs());
    }

    entry.at = entry.header + 30 + number(&head, 26, 2) + number(&head, 28, 2);
    Ok(())
}

/// Checks that entries follow one another without overlap up to the directory at
/// `directory`, with nothing between them but data descriptors that repeat it.
fn contiguous(
    entries: &HashMap<String, Entry>,
    directory: u64,
    source: &Source,
    path: &Path,
) -> Result<()> {
    let mut order: Vec<(&String, &Entry)> = entries.iter().collect();
    order.sort_by_key(|(_, e)| e.header);
    let next = order.iter().skip(1).map(|(_, e)| e.header).chain([directory]);
    for ((name, entry), next) in order.iter().zip(next) {
        let Some(end) = entry.at.checked_add(entry.bytes).filter(|end| *end <= next) else {
            let (name, bytes) = (shown(name), entry.bytes);
            let got = format!("`{name}`, {bytes} bytes at {}, over byte {next}", entry.at);
            return refuse(path, "entries that do not overlap", got);
        };
        if !is_descriptor(entry, end..next, source, path)? {
            let got = format!("{} other bytes after `{}`", next - end, shown(name));
            return refuse(path, "a data descriptor, or nothing, after an entry", got);
        }
    }
    Ok(())
}

/// Reports whether `range` is empty or holds a data descriptor of `entry`: a signature
/// (which may be absent), CRC-32, and two sizes of 4 or 8 bytes.
fn is_descriptor(entry: &Entry, range: Range<u64>, source: &Source, path: &Path) -> Result<bool> {
    let length = range.end - range.start;
    if length == 0 {
        return Ok(true);
    }
    if length > 24 || entry.flags & 8 == 0 {
        return Ok(false);
    }
    let bytes = source.bytes(range.start, length, path)?;
    let fields = bytes.strip_prefix(b"PK\x07\x08").unwrap_or(&bytes);
    let size = match fields.len() {
        12 => 4,
        20 => 8,
        _ => return Ok(false),
    };
    Ok(number(fields, 0, 4) == u64::from(entry.crc)
        && number(fields, 4, size) == entry.compressed
        && number(fields, 4 + size, size) == entry.bytes)
}
