//! The format before torch 1.6, an option of later versions: five pickles (magic number,
//! protocol, system, object, keys of the storages), then each storage as its number of
//! elements (int64) and its bytes. It has no checksums.

use super::pickle::{self, MAX_PICKLE, Node, Pickle};
use super::shown;
use super::source::{Source, Stream};
use super::tree::{Place, bytes_of};
use crate::files::{Error, Result};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

/// The magic number 0x1950a86a20f9469cfc6c in the encoding of pickles.
pub(super) const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];

/// Reports whether a file with this start has the format: a protocol, perhaps a frame, and
/// the magic number.
pub(super) fn starts(head: &[u8]) -> bool {
    let body = match head {
        [0x80, _, 0x95, rest @ ..] => rest.get(8..).unwrap_or_default(),
        [0x80, _, rest @ ..] => rest,
        _ => &[],
    };
    body.strip_prefix(&[0x8a, 10]).is_some_and(|n| n.starts_with(&MAGIC))
}

/// Positions of the storages by key.
pub(super) type Storages = HashMap<Arc<str>, Place>;

/// Reads the object's pickle and the positions of the storages.
pub(super) fn open(source: &Source, path: &Path) -> Result<(Pickle, Storages)> {
    let end = source.len();
    let next = |at: u64| -> Result<(Pickle, u64)> {
        let mut stream = Stream::new(source, path, at, end, MAX_PICKLE);
        let pickle = pickle::run(&mut stream)?;
        Ok((pickle, stream.position()))
    };
    let (_, at) = next(0)?;
    let (protocol, at) = next(at)?;
    if !matches!(root(&protocol), Node::Int(1001)) {
        return Err(Error::format(path, "protocol 1001 of torch.save", "another one"));
    }
    let (system, at) = next(at)?;
    if let Node::Dict(pairs) = root(&system) {
        let node = |id: &u32| system.nodes.get(*id as usize);
        let big = pairs.iter().any(|(k, v)| {
            matches!(node(k), Some(Node::Str(k)) if &**k == "little_endian")
                && matches!(node(v), Some(Node::Bool(false)))
        });
        if big {
            return Err(Error::format(path, "little-endian storages", "a big-endian file"));
        }
    }
    let (object, at) = next(at)?;
    let (keys, at) = next(at)?;
    let places = storages(source, path, &object, &keys, at)?;
    Ok((object, places))
}

fn root(pickle: &Pickle) -> &Node {
    pickle.nodes.get(pickle.root as usize).unwrap_or(&Node::None)
}

/// Reads the headers of the storages in the order of their keys.
fn storages(
    source: &Source,
    path: &Path,
    object: &Pickle,
    keys: &Pickle,
    mut at: u64,
) -> Result<Storages> {
    let bad = |expected: String, got: String| Err(Error::format(path, expected, got));
    let Node::List(ids) = root(keys) else {
        return bad("a list of the storages' keys".to_owned(), "another value".to_owned());
    };
    let mut places = HashMap::new();
    for id in ids {
        let Some(Node::Str(key)) = keys.nodes.get(*id as usize) else {
            return bad("a list of the storages' keys".to_owned(), "other values".to_owned());
        };
        let name = shown(key);
        let Some(storage) = object.storages.get(key) else {
            return bad(format!("a tensor of storage `{name}`"), "none".to_owned());
        };
        let count = source.bytes(at, 8, path)?;
        let count = count.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
        if count != storage.elements {
            let expected = format!("{} elements in storage `{name}`", storage.elements);
            return bad(expected, format!("{count} before its bytes"));
        }
        at += 8;
        let bytes = bytes_of(&storage.kind, count);
        let end = bytes.and_then(|b| at.checked_add(b)).filter(|end| *end <= source.len());
        let (Some(bytes), Some(end)) = (bytes, end) else {
            let got = format!("{} bytes of file after byte {at} (truncated?)", source.len() - at);
            return bad(format!("{count} elements in storage `{name}`"), got);
        };
        if places.insert(key.clone(), Place { at, bytes, crc: None }).is_some() {
            return bad("every storage once".to_owned(), format!("`{name}` twice"));
        }
        at = end;
    }
    let more = source.len() - at;
    if more > 0 {
        let expected = "the end of the file after the last storage".to_owned();
        return bad(expected, format!("{more} more bytes"));
    }
    Ok(places)
}
